"""The parameters of the paper, and its tables: by the modal analysis, and end to end."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.end_to_end import load_setup

import lbt_synth as lbt
from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.studies import paper as given
from lbt_synth.studies.paper import (
    TABLE_III,
    all_cases,
    make_entries,
    plan_cases,
    rms_differences,
)


def test_parameters_that_are_called_derived(air):
    assert given.VIBRATION_NM == pytest.approx(797, abs=0.5)
    noise = lbt.models.pyramid_tilt_noise_nm(
        photons=50,
        read_noise_electrons=8,
        modulation_lambda_over_d=4,
        subapertures=704,
        wavelength_um=0.75,
        diameter_m=given.DIAMETER_M,
    )
    assert pytest.approx(noise, abs=0.05) == given.NOISE_NM
    assert given.turbulence_model().rms_nm == pytest.approx(air.tilt_rms_nm)
    assert given.ATMOSPHERE == air


@pytest.fixture(scope="module")
def setup():
    return load_setup()


@pytest.fixture(scope="module")
def rows(setup):
    fixed = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    return plan_cases(setup, {"slow": fixed}, seeds=(0, 1), row_seeds=(0,))


def test_the_tables_of_the_paper(rows):
    """The filters are those of the end-to-end runs; these have other integrators."""
    second = [given.table_entry(r, given.modal_row(r)) for r in given.plan_rows(tables=["II"])]
    assert len(second) == 6
    assert max(abs(entry.difference) for entry in second) < 1.0
    for method in ("kalman", "hinf"):
        third = [row for row, _ in rows if (row.table, row.method) == ("III", method)]
        assert len(third) == 15
        entries = [given.table_entry(row, given.modal_row(row)) for row in third]
        assert rms_differences(entries, "ours", "paper")[method] < 1.0


def test_the_tables_as_planned(rows):
    second = [row for row, _ in rows if row.table == "II"]
    third = [row for row, _ in rows if row.table == "III"]
    assert [(r.method, r.paper) for r in second[:3]] == [
        ("classical", 84.1),
        ("kalman", 80.7),
        ("hinf", 80.4),
    ]
    assert len(second) == 8
    assert len(third) == 3 * 15
    cases = all_cases(rows)
    # the 20 Hz row of Table III is the row with vibration of Table II
    assert len(cases) == 8 * 2 + 3 * 14

    def frequencies(start):
        names = [name for name in cases if name.startswith(start) and "none" not in name]
        return {cases[name]["setup"].vibrations[0].frequency_hz for name in names}

    assert frequencies("slow-v") == {40 - row.model_hz for row in TABLE_III}
    assert frequencies("kal") == {20.0}
    for row, cases in rows:
        seeds = [case["setup"].seed for case in cases.values()]
        expected = [0, 1] if row.table == "II" or row.error_hz == 0 else [0]
        assert seeds == expected


def entries_of(rows, setup, gain):
    """Entries from runs that all measured one gain, and a Strehl ratio by the seed."""
    runs = {
        name: {
            "strehl": 0.7 + 0.01 * case["setup"].seed,
            "other_modes_strehl": 0.85,
            "tip_rms_nm": 30.0,
            "tilt_rms_nm": 40.0,
            "tip_tilt_gain": gain,
        }
        for name, case in all_cases(rows).items()
    }
    return make_entries(rows, runs, setup)


def test_entries_are_means_over_seeds_beside_the_modal_analysis(setup, rows, air):
    ends = [pair for pair in rows if pair[0].error_hz in (None, -3.5, 0.0, 3.5)]
    table = entries_of(ends, setup, 0.6)
    first = table[0]
    assert first.strehl == pytest.approx(70.5)
    assert first.scatter == pytest.approx(100 * 0.01 / np.sqrt(2))
    # the modal analysis by hand
    path = lbt.LoopHardware(frame_rate_hz=800)
    truth = lbt.Truth(turbulence=air, noise_nm=15.5, sensor_gain=0.6)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.5).controller, sensor_gain=0.6)
    camera = lbt.Imaging(diameter_m=8.22, obstruction=0.11, wavelength_um=2.2, other_modes=0.85)
    expected = 100 * lbt.strehl(lbt.residual_budget(loop, truth, frame_means=True), camera)
    assert first.modal == pytest.approx(expected, abs=1e-9)
    third = [e for e in table if (e.table, e.method) == ("III", "kalman")]
    squares = [(e.strehl - e.modal) ** 2 for e in third]
    points = rms_differences([e for e in table if e.table == "III"], "strehl", "modal")
    assert points["kalman"] == pytest.approx(np.sqrt(sum(squares) / 3))
    # a filter for 20 Hz meets a line that moved: as bad as the model that moved
    slow = {e.error_hz: e.modal for e in table if e.method == "slow" and e.table == "III"}
    assert slow[3.5] < slow[-3.5]  # an integrator rejects 23.5 Hz less than 16.5 Hz


@pytest.mark.parametrize("gain", [-0.1, 5.0])
def test_a_loop_that_is_unstable_at_the_measured_gain_predicts_nothing(setup, rows, gain):
    assert {e.modal for e in entries_of(rows[:3], setup, gain)} == {0.0}


def test_another_loop_and_a_name_of_the_papers_are_refused(setup):
    other = replace(setup, hardware=lbt.LoopHardware(frame_rate_hz=1000))
    with pytest.raises(ProblemError, match="800 Hz with a delay of 2 frames"):
        plan_cases(other)
    design = lbt.integrator(setup.hardware, gain=0.5)
    with pytest.raises(ProblemError, match="the name kalman is taken"):
        plan_cases(setup, {"kalman": design})


@pytest.fixture
def runs(monkeypatch):
    """Set-ups that were run, by what stands in for SPECULA."""
    seen = []

    def run(setup, controller, calibration):
        seen.append(setup)
        numbers = dict.fromkeys(("tip_tilt_gain", "other_modes_strehl"), 0.6)
        numbers |= {"strehl": 0.7 + 0.01 * setup.seed, "tip_rms_nm": 3.0, "tilt_rms_nm": 4.0}
        return SimpleNamespace(summary=lambda: numbers)

    monkeypatch.setattr(given, "calibrate", lambda *_, **__: None)
    monkeypatch.setattr(given, "specula_version", lambda: "1.1")
    monkeypatch.setattr(given, "run_end_to_end", run)
    return seen


def test_only_what_is_missing_runs_again(tmp_path, setup, runs):
    counted = []
    planned = plan_cases(setup, seeds=[0, 1], tables=["II"])
    first = given.end_to_end_tables(setup, planned, tmp_path, progress=counted.append)
    assert len(runs) == len(list(tmp_path.glob("*.npz"))) == sum(counted) == 12
    assert (first[0].strehl, first[0].seeds) == (pytest.approx(70.5), 2)
    for path in sorted(tmp_path.glob("*.npz"))[3:5]:
        path.unlink()
    again = given.end_to_end_tables(setup, planned, tmp_path, progress=counted.append)
    assert (len(runs), sum(counted)) == (14, 24)
    assert [entry.values for entry in again] == [entry.values for entry in first]
    other = replace(setup, gain=0.4)
    planned = plan_cases(other, seeds=[0], tables=["II"])
    with pytest.raises(OutputError, match="is of another study"):
        given.end_to_end_tables(other, planned, tmp_path)
