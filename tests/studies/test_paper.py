"""The parameters of the paper, and its tables: by the modal analysis, and end to end."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.end_to_end import fake_results, load_setup, make_table, plan_rows

import lbt_synth as lbt
from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.studies import paper as given
from lbt_synth.studies.paper import (
    TABLE_III,
    all_cases,
    make_entries,
    plan_cases,
    rms_modal_difference,
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
def entries():
    return [(row.table, given.table_entry(row, given.modal_row(row))) for row in given.plan_rows()]


@pytest.mark.parametrize("method", ["kalman", "hinf"])
def test_table_iii(entries, method):
    column = [e for table, e in entries if (table, e.method) == ("III", method)]
    assert len(column) == 15
    assert given.rms_difference(column) < 1.0


def test_table_ii(entries):
    second = [e for table, e in entries if table == "II"]
    assert len(second) == 6
    for entry in second:
        assert abs(entry.difference) < 1.0, entry


@pytest.fixture(scope="module")
def setup():
    return load_setup()


@pytest.fixture(scope="module")
def rows():
    return plan_rows()


def test_the_tables_as_planned(rows):
    second = [row for row, _ in rows if row.table == "II"]
    third = [row for row, _ in rows if row.table == "III"]
    assert [(r.label, r.method, r.paper) for r in second[:3]] == [
        ("no vibration", "classical", 84.1),
        ("no vibration", "kalman", 80.7),
        ("no vibration", "hinf", 80.4),
    ]
    assert len(second) == 8
    assert len(third) == 3 * 15
    cases = all_cases(rows)
    # the 20 Hz row of Table III is the row with vibration of Table II
    assert len(cases) == 8 * 2 + 3 * 14
    moved = [
        c["setup"].vibrations[0].frequency_hz
        for n, c in cases.items()
        if n.startswith("slow-v") and "none" not in n
    ]
    assert sorted(set(moved)) == sorted(40 - row.model_hz for row in TABLE_III)
    still = {
        c["setup"].vibrations[0].frequency_hz
        for n, c in cases.items()
        if n.startswith("kal") and "none" not in n
    }
    assert still == {20.0}


def test_seeds_are_shared_by_the_controllers(rows):
    for row, cases in rows:
        seeds = [case["setup"].seed for case in cases.values()]
        expected = [0, 1] if row.table == "II" or row.error_hz == 0 else [0]
        assert seeds == expected


@pytest.fixture(scope="module")
def table():
    return make_table()


def test_entries_are_means_over_seeds_beside_the_modal_analysis(table):
    first = table[0]
    assert first.strehl == pytest.approx(70.5)
    assert first.scatter == pytest.approx(100 * 0.01 / np.sqrt(2))
    # the modal analysis by hand
    path = lbt.LoopHardware(frame_rate_hz=800)
    air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
    truth = lbt.Truth(turbulence=air, noise_nm=15.5, sensor_gain=0.6)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.5).controller, sensor_gain=0.6)
    camera = lbt.Imaging(diameter_m=8.22, obstruction=0.11, wavelength_um=2.2, other_modes=0.85)
    expected = 100 * lbt.strehl(lbt.residual_budget(loop, truth, frame_means=True), camera)
    assert first.modal == pytest.approx(expected, abs=1e-9)
    assert rms_modal_difference(table, "kalman") > 0
    # a filter for 20 Hz meets a line that moved: as bad as the model that moved
    slow = {e.error_hz: e.modal for e in table if e.method == "slow" and e.table == "III"}
    assert slow[3.5] < slow[-3.5]  # an integrator rejects 23.5 Hz less than 16.5 Hz


@pytest.mark.parametrize("gain", [-0.1, 5.0])
def test_a_loop_that_is_unstable_at_the_measured_gain_predicts_nothing(setup, rows, gain):
    table = make_entries(rows, fake_results(rows, gain=gain), setup)
    assert {e.modal for e in table} == {0.0}


def test_tables_of_another_loop_are_refused(setup):
    hardware = lbt.LoopHardware(frame_rate_hz=1000)
    other = replace(setup, hardware=hardware)
    with pytest.raises(ProblemError, match="800 Hz with a delay of 2 frames"):
        plan_cases(other)


def test_a_design_cannot_take_the_name_of_the_papers(setup):
    design = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
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
    options = {"seeds": [0, 1], "tables": ["II"], "progress": counted.append}
    first = given.end_to_end_tables(setup, tmp_path, **options)
    assert len(runs) == len(list(tmp_path.glob("*.npz"))) == sum(counted) == 12
    assert (first[0].strehl, first[0].seeds) == (pytest.approx(70.5), 2)
    for path in sorted(tmp_path.glob("*.npz"))[3:5]:
        path.unlink()
    again = given.end_to_end_tables(setup, tmp_path, **options)
    assert (len(runs), sum(counted)) == (14, 24)
    assert [entry.values for entry in again] == [entry.values for entry in first]


def test_runs_of_other_settings_are_not_mixed_in(tmp_path, setup, runs):
    given.end_to_end_tables(setup, tmp_path, seeds=[0], tables=["II"])
    with pytest.raises(OutputError, match="is of another study"):
        given.end_to_end_tables(replace(setup, gain=0.4), tmp_path, seeds=[0], tables=["II"])
