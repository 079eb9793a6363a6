"""Processes of finite order in the place of a drift and turbulence that falls as tilt does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.recorded_loops import RATE, expected_periodogram

import lbt_synth as lbt
from lbt_synth.identification.fit.finite_order import nearest_processes
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.order_search import search_model
from lbt_synth.identification.fit.physical_parameters import describe_axis
from lbt_synth.identification.fit.whittle import FittedModel, density

GAIN, NOISE_NM = 0.6, 5.0


def disturbance(wind: float, pole: float, rms_nm: float) -> lbt.models.SumSpectrum:
    """Return frozen flow with a drift of first order on top."""
    air = lbt.Atmosphere(seeing_arcsec=1.0, outer_scale_m=25, wind_speed_m_s=wind, diameter_m=8.22)
    driving = rms_nm * float(np.sqrt(1 - pole**2))
    drift = lbt.models.ARModel(coefficients=[pole], driving_rms_nm=driving, frame_rate_hz=RATE)
    return lbt.models.SumSpectrum(parts=[air, drift])


def fit(total: lbt.models.SumSpectrum, gain: float | None = None) -> tuple[Search, FittedModel]:
    """Return the fit to what a minute of an integrator's loop scatters about."""
    search = Search(data=expected_periodogram(total, NOISE_NM, GAIN), gain=gain)
    return search, search_model(search)


@pytest.mark.parametrize("wind", [8.0, 20.0])
def test_a_drift_over_frozen_flow_does_not_shift_the_gain(wind: float) -> None:
    """Without a roll-off beside the drift it was a quarter too low: 13 standard errors."""
    _, model = fit(disturbance(wind, 0.999, 30.0))
    assert [c.kind for c in model.spectrum.components] == ["drift", "slow"]
    assert model.spectrum.rolls_off
    assert model.spectrum.gain == pytest.approx(GAIN, rel=0.02)


@pytest.mark.parametrize(
    ("wind", "pole", "rms_nm", "first"),
    [(20.0, 0.999, 30.0, "turbulence"), (8.0, 0.9995, 100.0, "drift")],
)
def test_the_filter_of_the_nearest_processes(wind, pole, rms_nm, first) -> None:
    """A weak drift is a resonance beside turbulence; a strong one has the first place."""
    total = disturbance(wind, pole, rms_nm)
    search, model = fit(total, GAIN)
    near = nearest_processes(search, model)
    assert near.spectrum.components[0].kind == first
    axis = describe_axis(search, model, None, "")
    found = lbt.identification.IdentifiedModel(axes=(axis,), frame_rate_hz=RATE, delay_frames=2.0)
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    truth = lbt.Truth(turbulence=total, noise_nm=NOISE_NM, sensor_gain=GAIN)
    loop = lbt.close_loop(path, lbt.kalman(found.plant()).controller, sensor_gain=GAIN)
    least = lbt.loop.least_residual(path, truth).rms_nm
    assert lbt.residual_budget(loop, truth).rms_nm < 1.01 * least


def test_errors_follow_the_processes_that_change_places() -> None:
    search, model = fit(disturbance(20.0, 0.999, 30.0), GAIN)
    near = nearest_processes(search, model)
    own = np.diag(model.information)[-6:]
    np.testing.assert_array_equal(np.diag(near.information)[-6:], np.roll(own, 3))
    assert np.all(np.isfinite(density(search.data, near.spectrum)))


def test_what_two_axes_share_stays() -> None:
    search, model = fit(disturbance(20.0, 0.999, 30.0), GAIN)
    drift, slow = model.spectrum.components
    near = nearest_processes(search, model, [1]).spectrum
    assert near.components[1] == slow
    assert near.components[0].kind == "drift"
    assert near.components[0] != drift
    assert not near.rolls_off


def test_turbulence_without_a_roll_off_is_left_alone() -> None:
    search, model = fit(disturbance(20.0, 0.999, 30.0), GAIN)
    plain = replace(model, spectrum=model.spectrum.without_roll_off())
    assert nearest_processes(search, plain) is plain
