"""Robustness to frequency errors."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt


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
