"""The paper's tables and the robustness study."""

from __future__ import annotations

import csv

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.report.paper import write_paper
from lbt_synth.studies.paper import parameters as given
from lbt_synth.studies.paper import tables as compute


@pytest.fixture(scope="module")
def table_iii():
    return list(compute.table_iii())


def test_table_iii_kalman_column(table_iii):
    entries = [e for e in compute.compare_with_paper(table_iii) if e.method == "kalman"]
    assert len(entries) == 15
    assert compute.rms_difference(entries) < 1.0


def test_table_iii_hinf_column(table_iii):
    entries = [e for e in compute.compare_with_paper(table_iii) if e.method == "hinf"]
    assert len(entries) == 15
    assert compute.rms_difference(entries) < 1.0


def test_table_ii():
    entries = compute.table_ii()
    assert len(entries) == 6
    for entry in entries:
        assert abs(entry.difference) < 1.0, entry


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


def test_written_files(tmp_path, table_iii):
    result = write_paper(tmp_path, table_iii)
    assert {p.name for p in result.files} == {
        "table_ii.csv",
        "table_iii.csv",
        "parameters.csv",
        "robustness.png",
        "robustness.pdf",
        "sigma.png",
        "sigma.pdf",
        "paper_kalman.fits",
        "paper_hinf.fits",
    }
    with (tmp_path / "table_iii.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 30
    assert float(rows[0]["paper_strehl_percent"]) == 22.4
    assert lbt.load_gain(tmp_path / "paper_hinf.fits").recertified().passed


def test_sigma_of_the_paper_kalman_peaks_where_hinf_is_flatter():
    kalman, hinf = compute.paper_filters()
    peaks = [
        float(
            lbt.linear.largest_singular_values(
                d.problem.with_unit_weights().error_system(d.gain_predictor), [20.0]
            )[0]
        )
        for d in (kalman, hinf)
    ]
    assert peaks[1] < 0.8 * peaks[0]


def test_robustness_rows(config):
    rows = list(
        lbt.studies.robustness(
            config.plant, config.truth, config.imaging, errors_hz=[-3, 0, 3], gamma_ratio=1.2
        )
    )
    assert [(r.error_hz, r.method) for r in rows] == [
        (e, m) for e in (-3, 0, 3) for m in ("kalman", "hinf")
    ]
    kalman = {r.error_hz: r for r in rows if r.method == "kalman"}
    assert kalman[0].strehl > max(kalman[-3].strehl, kalman[3].strehl)
    for row in rows:
        parts = row.vibration_nm**2 + row.turbulence_nm**2 + row.noise_nm**2
        assert row.residual_nm**2 == pytest.approx(parts)
    # the same as designing and evaluating by hand
    moved = lbt.kalman(lbt.models.retuned_plant(config.plant, 3, hold="driving"))
    budget = lbt.residual_budget(lbt.close_loop(moved.hardware, moved.controller), config.truth)
    assert kalman[3].residual_nm == pytest.approx(budget.rms_nm, rel=1e-9)


def test_unstable_rows_say_so(config):
    from dataclasses import replace

    truth = replace(config.truth, sensor_gain=0.3)
    (row,) = lbt.studies.robustness(
        config.plant, truth, config.imaging, errors_hz=[0], methods=["hinf"], gamma_ratio=1.05
    )
    assert not row.stable
    assert np.isnan(row.strehl)


def test_the_study_refuses_what_it_cannot_do(config):
    turbulence = config.plant.turbulence[0]
    still = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=turbulence, noise_nm=10)
    with pytest.raises(lbt.errors.ProblemError, match="needs a vibration in the model"):
        list(lbt.studies.robustness(still, config.truth, config.imaging, errors_hz=[0]))
    with pytest.raises(lbt.errors.ProblemError, match="method must be one of"):
        list(
            lbt.studies.robustness(
                config.plant, config.truth, config.imaging, errors_hz=[0], methods=["magic"]
            )
        )
    with pytest.raises(lbt.errors.ProblemError, match="above 0"):
        list(lbt.studies.robustness(config.plant, config.truth, config.imaging, errors_hz=[-25]))
