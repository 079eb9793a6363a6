"""Whiteness, errors at a held gain, and the process of turbulence that falls as tilt does.

Lines that may be two, against the exact likelihood of the pair that is there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.recorded_loops import RATE, expected_periodogram, identify_series, integrator_loop

import lbt_synth as lbt
from lbt_synth.identification.fit.fitting import Search, fit
from lbt_synth.identification.fit.order_search import search_models
from lbt_synth.identification.fit.periodogram import LoopPeriodogram, loop_periodogram
from lbt_synth.identification.fit.physical_parameters import (
    describe_axis,
    describe_close_lines,
    hold_gain,
    nearest_processes,
    split_gain,
    standard_errors,
    whiteness,
)
from lbt_synth.identification.fit.spectrum_model import Spectra, SpectrumModel
from lbt_synth.identification.fit.whittle import FittedModel, contrast, density

GAIN, NOISE_NM = 0.6, 5.0
SPECTRUM_RATE, DURATION_S = 500.0, 60.0
DAMPING = 0.005


def test_what_is_left_out_is_not_white() -> None:
    y, c = integrator_loop(lines=((40, 0.01, 30),))
    found = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE, sensor_gain=0.6, most_lines=0)
    assert not found.lines
    assert not found.whiteness.white
    assert found.whiteness.p_value < 1e-6


def test_whiteness_of_white_noise_in_segments() -> None:
    rng = np.random.default_rng(0)
    for pieces in ([(0, 8192)], [(i * 1024, (i + 1) * 1024) for i in range(4)]):
        p_values = []
        for _ in range(120):
            white = rng.standard_normal(8192)
            data = loop_periodogram(white, None, frame_rate_hz=RATE, stretches=pieces)
            model = np.full(data.frequency_hz.size, 2 / RATE)
            test = whiteness(data, data.power(1.0), model)
            p_values.append((test.p_value, test.correlation_p_value))
        # 120 trials: at most 6 below 1 %, and 16 below 5 %, with a probability of 0.999
        assert np.all(np.sum(np.array(p_values) < 0.01, axis=0) <= 6)
        assert np.all(np.sum(np.array(p_values) < 0.05, axis=0) <= 16)


@pytest.mark.parametrize("wind", [8.0, 20.0])
def test_frozen_flow_does_not_shift_the_gain(wind: float) -> None:
    """Without chance in the data only the model can."""
    air = lbt.Atmosphere(seeing_arcsec=1.0, outer_scale_m=25, wind_speed_m_s=wind, diameter_m=8.22)
    search = Search(data=expected_periodogram(air, 5.0, 0.6))
    model = search_models(search)[0]
    error = float(np.sqrt(model.covariance[0, 0]))
    assert abs(model.spectrum.log_gain - np.log(0.6)) < 0.2 * error
    # the process of the design is near to what was fitted, down to the noise
    axis = describe_axis(search, model, error, "")
    process = axis.turbulence.psd(axis.frequency_hz) + 2 / RATE * (axis.noise_nm / 0.6) ** 2
    log_ratio = np.log(process / axis.fitted_nm2_hz)
    assert np.max(np.abs(log_ratio[axis.frequency_hz > 0.3])) < 0.25
    assert axis.turbulence.order == 3
    assert axis.turbulence.rms_nm == pytest.approx(air.tilt_rms_nm, rel=0.05)


def test_a_part_of_the_turbulence_without_power_is_none() -> None:
    """A configuration refuses it, and a design has a state for it."""
    y, c = integrator_loop(lines=((40, 0.01, 30),), frames=8192)
    data = loop_periodogram(y[:, 0], c[:, 0], frame_rate_hz=RATE, stretches=[(0, len(y))])
    search = Search(data=data, gain=0.6)
    model = search_models(search)[0]
    for power, count in ((1e-12, 0), (100.0, 1)):
        slow = search.component("slow", 1.0, 0.5, power)
        more = replace(
            model,
            spectra=Spectra((model.spectrum.add(slow),)),
            information=np.pad(model.information, (0, 3)),
            evidence=(*model.evidence, 0.0),
        )
        axis = describe_axis(search, more, None, "")
        found = [part.frequency_hz for part in axis.parts]
        assert sum(f == pytest.approx(1.0) for f in found) == count
        assert len(found) == len(describe_axis(search, model, None, "").parts) + count


def test_errors_at_a_held_gain_are_those_of_a_free_one() -> None:
    y, c = integrator_loop(lines=((45, 0.02, 25),), gain=0.2, frames=12_000)
    free = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    held = identify_series(
        y[:, 0],
        c[:, 0],
        frame_rate_hz=RATE,
        sensor_gain=free.sensor_gain,
        sensor_gain_error=free.sensor_gain_error,
    )
    assert held.noise_error_nm == pytest.approx(free.noise_error_nm, rel=0.01)
    (one,), (other,) = free.lines, held.lines
    assert other.rms_error_nm == pytest.approx(one.rms_error_nm, rel=0.01)
    assert held.sensor_gain_error == pytest.approx(free.sensor_gain_error)


def test_an_ambiguous_gain_has_that_error_and_moves_the_rest() -> None:
    y, c = integrator_loop(lines=((40, 0.01, 30),))
    axis = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    search, model = Search(data=axis.data), axis.fitted_model
    errors = standard_errors(model.spectrum, model.covariance)
    more = hold_gain(search, model, 0.2)
    wider = standard_errors(model.spectrum, more.covariance)
    assert wider.log_gain == pytest.approx(0.2, rel=1e-6)
    assert wider.components[1].log_power > errors.components[1].log_power


def test_white_noise_says_how_well_its_colour_shows() -> None:
    frames = 8192
    axis = identify_series(np.random.default_rng(1).standard_normal(frames), frame_rate_hz=RATE)
    assert axis.noise_correlation == 0
    assert axis.noise_correlation_error == pytest.approx(1 / np.sqrt(frames), rel=0.25)


def disturbance(wind: float, pole: float, rms_nm: float) -> lbt.models.SumSpectrum:
    """Return frozen flow with a drift of first order on top."""
    air = lbt.Atmosphere(seeing_arcsec=1.0, outer_scale_m=25, wind_speed_m_s=wind, diameter_m=8.22)
    driving = rms_nm * float(np.sqrt(1 - pole**2))
    drift = lbt.models.ARModel(coefficients=[pole], driving_rms_nm=driving, frame_rate_hz=RATE)
    return lbt.models.SumSpectrum(parts=[air, drift])


def fit_loop(
    total: lbt.models.SumSpectrum, gain: float | None = None
) -> tuple[Search, FittedModel]:
    """Return the fit to what a minute of an integrator's loop scatters about."""
    search = Search(data=expected_periodogram(total, NOISE_NM, GAIN), gain=gain)
    return search, search_models(search)[0]


@pytest.mark.parametrize(("wind", "noise_nm"), [(8.0, NOISE_NM), (20.0, NOISE_NM), (20.0, 1.0)])
def test_a_drift_over_frozen_flow_does_not_shift_the_gain(wind: float, noise_nm: float) -> None:
    """Without a roll-off beside the drift it was a quarter too low: 13 standard errors.

    With two free poles of the drift it was a fifth too high where there is little noise.
    """
    total = disturbance(wind, 0.999, 30.0)
    model = search_models(Search(data=expected_periodogram(total, noise_nm, GAIN)))[0]
    assert [c.kind for c in model.spectrum.components] == ["drift", "slow"]
    assert model.spectrum.rolls_off
    assert model.spectrum.gain == pytest.approx(GAIN, rel=0.01)
    assert np.exp(model.spectrum.log_noise / 2) == pytest.approx(noise_nm, rel=0.01)


@pytest.mark.parametrize(
    ("wind", "pole", "rms_nm", "first"),
    [(20.0, 0.999, 30.0, "turbulence"), (8.0, 0.9995, 100.0, "drift")],
)
def test_the_filter_of_the_nearest_processes(wind, pole, rms_nm, first) -> None:
    """A weak drift is a resonance beside turbulence; a strong one has the first place."""
    total = disturbance(wind, pole, rms_nm)
    search, model = fit_loop(total, GAIN)
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
    search, model = fit_loop(disturbance(20.0, 0.999, 30.0), GAIN)
    near = nearest_processes(search, model)
    own = np.diag(model.information)[-6:]
    np.testing.assert_array_equal(np.diag(near.information)[-6:], np.roll(own, 3))
    assert np.all(np.isfinite(density(search.data, near.spectrum)))


def test_what_two_axes_share_stays() -> None:
    search, model = fit_loop(disturbance(20.0, 0.999, 30.0), GAIN)
    drift, slow = model.spectrum.components
    near = nearest_processes(search, model, [1]).spectrum
    assert near.components[1] == slow
    assert near.components[0].kind == "drift"
    assert near.components[0] != drift
    assert not near.rolls_off


def test_turbulence_without_a_roll_off_is_left_alone() -> None:
    search, model = fit_loop(disturbance(20.0, 0.999, 30.0), GAIN)
    plain = model.with_spectrum(model.spectrum.without_roll_off())
    assert nearest_processes(search, plain) is plain


def exact(separation: float, second_nm2: float = 500.0):
    """Return the exact spectrum of a pair as data, its model, and that of one line fitted to it.

    The separation is in half widths; the second line has half the power of the first.
    """
    f = np.arange(1, int(SPECTRUM_RATE / 2 * DURATION_S)) / DURATION_S
    data = LoopPeriodogram(
        frequency_hz=f,
        measured=np.ones_like(f),
        crossed=np.zeros_like(f),
        corrected=np.zeros_like(f),
        count=np.ones_like(f),
        frame_rate_hz=SPECTRUM_RATE,
        resolution_hz=1 / DURATION_S,
        duration_s=DURATION_S,
    )
    search = Search(data=data)
    slow = search.component("turbulence", 1.0, 0.5, 1e4)
    ground = SpectrumModel(0.0, 0.0, 0.0, 0.0, (slow,)).without_roll_off()
    places = ((40.0, 1000.0), (40.0 * (1 + separation * DAMPING), second_nm2))
    pair = ground.add(*(search.component("line", hz, DAMPING, power) for hz, power in places))
    data = replace(data, measured=density(data, pair))
    search = Search(data=data)
    single = fit(search, ground.add(search.component("line", 40.05, DAMPING, 1500.0)))
    assert single is not None
    return search, pair, single.spectrum


@pytest.mark.parametrize("separation", [2.5, 3.5])
def test_a_split_gains_what_the_pair_is_likelier(separation: float) -> None:
    search, pair, single = exact(separation)
    gain = contrast(search.data, single) - contrast(search.data, pair)
    assert gain > 1
    # the rest of the model stays, and merged bins see a little less
    assert split_gain(search, single, 1) == pytest.approx(gain, rel=0.15)


def test_a_single_line_gains_nothing() -> None:
    search, _, single = exact(0.0)
    assert split_gain(search, single, 1) == pytest.approx(0, abs=0.1)


def test_a_line_beside_zero_is_not_split() -> None:
    search, _, single = exact(0.0)
    slow = search.component("line", 1 / DURATION_S, DAMPING, 1.0)
    assert split_gain(search, single.add(slow), 2) == 0


def simulated(second_hz: float, seed: int):
    """Identify a loop with a line at 40 Hz and another."""
    lines = tuple(
        lbt.Vibration(frequency_hz=hz, damping=DAMPING, rms_nm=50, direction=(1.0,))
        for hz in (40.0, second_hz)
    )
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=2.0, frame_rate_hz=SPECTRUM_RATE)
    truth = lbt.Truth(turbulence=slow, vibrations=lines, noise_nm=5.0)
    loop = lbt.integrator(lbt.LoopHardware(frame_rate_hz=SPECTRUM_RATE, modes=1), gain=0.4)
    path = lbt.LoopHardware(frame_rate_hz=SPECTRUM_RATE, modes=1)
    run = lbt.simulate(loop.controller, truth, hardware=path, frames=30_000, seed=seed)
    y, u = run.measurements[0, :, 0], run.commands[0, :, 0]
    return identify_series(y[2:], u[:-2], frame_rate_hz=SPECTRUM_RATE)


def test_a_note_names_the_line_that_may_be_two() -> None:
    axis = simulated(40.5, 4)
    (line,) = axis.lines
    (note,) = describe_close_lines(axis, 0)
    assert f"the line of axis 0 at {line.frequency_hz:.4g} Hz may be two" in note


def test_a_note_names_a_line_that_is_hardly_separate() -> None:
    axis = simulated(41.2, 1)
    second = axis.lines[1]
    assert not list(describe_close_lines(axis, 1))
    model = axis.fitted_model
    at = 1 + int(model.spectrum.components[2].frequency > model.spectrum.components[1].frequency)
    weak = replace(model, evidence=tuple(20.0 if i == at else 500.0 for i in range(3)))
    (note,) = describe_close_lines(replace(axis, fitted_model=weak), 1)
    assert f"the line of axis 1 at {second.frequency_hz:.4g} Hz lies in the skirts" in note
