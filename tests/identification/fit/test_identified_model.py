"""Whiteness, errors at a held gain, and the processes of turbulence and of a drift."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.recorded_loops import RATE, expected_periodogram, identify_series, integrator_loop

import lbt_synth as lbt
from lbt_synth.identification.fit import identified_model
from lbt_synth.identification.fit.fitting import Search, add_evidence, cost, fit
from lbt_synth.identification.fit.order_search import find_components
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.models import ARModel, Spectrum, SumSpectrum

GAIN, NOISE_NM = 0.6, 5.0


def test_whiteness_of_white_noise_in_segments() -> None:
    rng = np.random.default_rng(0)
    for pieces in ([(0, 8192)], [(i * 1024, (i + 1) * 1024) for i in range(4)]):
        p_values = np.zeros(120)
        for k, white in enumerate(rng.standard_normal((120, 8192))):
            data = loop_periodogram(white, None, frame_rate_hz=RATE, stretches=pieces)
            model = np.full(data.frequency_hz.size, 2 / RATE)
            p_values[k] = identified_model.whiteness(data, data.power(1.0), model).p_value
        # 120 trials: at most 6 below 1 %, and 16 below 5 %, with a probability of 0.999
        assert np.sum(p_values < 0.01) <= 6
        assert np.sum(p_values < 0.05) <= 16


def frozen_flow(wind_speed_m_s: float) -> lbt.Atmosphere:
    return lbt.Atmosphere(
        seeing_arcsec=1.0, outer_scale_m=25, wind_speed_m_s=wind_speed_m_s, diameter_m=8.22
    )


def found_axis(spectrum: Spectrum, noise_nm: float = NOISE_NM) -> identified_model.IdentifiedAxis:
    """Return what is found in periodograms without chance: only the model can shift the gain."""
    search = Search(data=expected_periodogram(spectrum, noise_nm, GAIN))
    model = add_evidence(search, find_components(search))
    return identified_model.describe_axis(search, model, float(np.sqrt(model.covariance[0, 0])), "")


def test_frozen_flow_does_not_shift_the_gain() -> None:
    """The process of the design is near to what was fitted, down to the noise."""
    air = frozen_flow(20)
    axis = found_axis(air)
    assert abs(np.log(axis.sensor_gain / GAIN)) < 0.2 * axis.sensor_gain_error / axis.sensor_gain
    process = axis.turbulence.psd(axis.frequency_hz) + 2 / RATE * (axis.noise_nm / GAIN) ** 2
    log_ratio = np.log(process / axis.fitted_nm2_hz)
    assert np.max(np.abs(log_ratio[axis.frequency_hz > 0.3])) < 0.25
    assert axis.turbulence.order == 3
    assert axis.turbulence.rms_nm == pytest.approx(air.tilt_rms_nm, rel=0.05)


@pytest.mark.parametrize(
    ("wind", "noise_nm", "pole", "drift_nm"),
    [(8.0, NOISE_NM, 0.999, 30.0), (20.0, 1.0, 0.999, 30.0), (8.0, NOISE_NM, 0.9995, 100.0)],
)
def test_a_drift_over_frozen_flow_does_not_shift_the_gain(wind, noise_nm, pole, drift_nm) -> None:
    """Without a roll-off beside the drift it was 13 errors off, with two free poles a fifth.

    A plant has the drift as an overdamped resonance.
    """
    driving = drift_nm * float(np.sqrt(1 - pole**2))
    drift = ARModel(coefficients=[pole], driving_rms_nm=driving, frame_rate_hz=RATE)
    total = SumSpectrum(parts=[frozen_flow(wind), drift])
    axis = found_axis(total, noise_nm)
    spectrum = axis.fitted_model.spectrum
    assert [c.kind for c in spectrum.components] == ["turbulence", "drift"]
    assert spectrum.background.rolls_off
    assert axis.sensor_gain == pytest.approx(GAIN, rel=0.01)
    assert axis.noise_nm == pytest.approx(noise_nm, rel=0.02)
    (part,) = axis.parts
    assert part.kind == "turbulence"
    assert part.damping > 30
    model = identified_model.IdentifiedModel(axes=(axis,), frame_rate_hz=RATE, delay_frames=2.0)
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    truth = lbt.Truth(turbulence=total, noise_nm=noise_nm, sensor_gain=GAIN)
    loop = lbt.close_loop(path, lbt.kalman(model.plant()).controller, sensor_gain=GAIN)
    least = lbt.loop.least_residual(path, truth).rms_nm
    assert lbt.residual_budget(loop, truth).rms_nm < 1.01 * least


def test_errors_at_a_held_gain_are_those_of_a_free_one() -> None:
    """An ambiguous gain has its error, and moves the rest."""
    y, c = integrator_loop(lines=((45, 0.02, 25),), gain=0.2, frames=12_000)
    free = identify_series(y[:, 0], c[:, 0])
    gain = {name: getattr(free, name) for name in ("sensor_gain", "sensor_gain_error")}
    held = identify_series(y[:, 0], c[:, 0], **gain)
    assert held.noise_error_nm == pytest.approx(free.noise_error_nm, rel=0.01)
    (one,), (other,) = free.lines, held.lines
    assert other.rms_error_nm == pytest.approx(one.rms_error_nm, rel=0.01)
    assert held.sensor_gain_error == pytest.approx(free.sensor_gain_error)
    model = free.fitted_model
    wider = identified_model.hold_gain(Search(data=free.data), model, [([0], 0.2)]).errors
    assert wider.background.log_gain == pytest.approx(0.2, rel=1e-6)
    assert wider.components[1].log_power > model.errors.components[1].log_power


def test_white_noise_says_how_well_its_colour_shows() -> None:
    frames = 8192
    axis = identify_series(np.random.default_rng(1).standard_normal(frames))
    assert axis.noise_correlation == 0
    assert axis.noise_correlation_error == pytest.approx(1 / np.sqrt(frames), rel=0.25)


@cache
def weakest_lines(seed: int) -> tuple[Search, identified_model.IdentifiedAxis]:
    """Return an axis with lines of 30, 4 and some 2 nm, and what it was found by."""
    lines = ((25.0, 0.01, 30.0), (60.0, 0.02, 4.0), (120.0, 0.02, 2.0 + seed))
    y, c = integrator_loop(lines=lines, seed=seed)
    axis = identify_series(y[:, 0], c[:, 0], sensor_gain=GAIN)
    return Search(data=axis.data, gain=GAIN), axis


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.study) for k in (1, 2))])
def test_the_number_of_components_is_as_sure_as_other_fits_say(seed: int) -> None:
    """Without each in turn, and with one more at many places, all parameters are fitted again."""
    search, axis = weakest_lines(seed)
    model = axis.fitted_model
    spectrum, least = model.spectrum, cost(search, model)
    fewer = min(cost(search, fit(search, spectrum.exchange(i))) for i in (1, 2, 3)) - least
    assert 0.8 * axis.over_fewer < fewer < axis.over_fewer + 0.1
    places = np.geomspace(5.0, 450.0, 40)
    trials = (spectrum.add(search.component("line", f, 0.02, 1.0)) for f in places)
    more = min(cost(search, model) for trial in trials if (model := fit(search, trial))) - least
    assert axis.over_more == pytest.approx(more, abs=3.0)
    assert 0 < axis.over_more < search.price
    # of a component that the model lacks the record does not tell
    lacking = add_evidence(search, fit(search, spectrum.exchange(3)))
    assert identified_model.describe_axis(search, lacking, None, "").over_more == 0.0


def test_a_part_of_the_turbulence_without_power_is_none() -> None:
    """A configuration refuses it, and a design has a state for it."""
    search, axis = weakest_lines(0)
    model, places = axis.fitted_model, [part.frequency_hz for part in axis.parts]
    wider = {"information": np.pad(model.information, (0, 3)), "evidence": (*model.evidence, 0.0)}
    for power, slow in ((1e-12, []), (100.0, [1.0])):
        spectrum = model.spectrum.add(search.component("slow", 1.0, 0.5, power))
        wide = identified_model.describe_axis(
            search, replace(model, spectrum=spectrum, **wider), None, ""
        )
        frequencies = sorted(part.frequency_hz for part in wide.parts)
        assert frequencies == pytest.approx(sorted(places + slow))


def test_the_number_of_components_is_said_of_the_axis_that_tells_it_least() -> None:
    sure = replace(weakest_lines(0)[1], over_fewer=38.4, over_more=7.2)
    unsure = replace(sure, parts=(), over_fewer=np.inf, over_more=2.9)
    both = identified_model.IdentifiedModel(
        axes=(sure, unsure), frame_rate_hz=RATE, delay_frames=2.0
    )
    assert identified_model.say_count(both) == (
        "The record tells 3 components from 2 by at most 38 and from 4 by about 3 units of the "
        "log-likelihood beyond the price."
    )
    alone = identified_model.say_count(replace(both, axes=(unsure,)))
    assert alone.startswith("The record tells 0 components from 1 by about 3 units")
