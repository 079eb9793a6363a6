"""Models of one axis and of two: whiteness, errors, drifts, and resonances that axes share."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.recorded_loops import (
    RATE,
    expected_periodogram,
    identify_series,
    integrator_loop,
    open_record,
    slow,
)

import lbt_synth as lbt
from lbt_synth.identification import IdentifiedModel, loop_record
from lbt_synth.identification.fit import identified_model
from lbt_synth.identification.fit.fitting import Search, add_evidence, cost, fit
from lbt_synth.identification.fit.order_search import find_components
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.fit.shared_lines import couple_axes
from lbt_synth.models import ARModel, Spectrum, SumSpectrum
from lbt_synth.models.plant.tip_tilt import with_vibrations

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
    """Without a roll-off it was 13 errors off; in a plant the drift is an overdamped resonance."""
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
    model = IdentifiedModel(axes=(axis,), frame_rate_hz=RATE, delay_frames=2.0)
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
    known = {"information": np.pad(model.information, (0, 3)), "evidence": (*model.evidence, 0.0)}
    for power, extra in ((1e-12, []), (100.0, [1.0])):
        spectrum = model.spectrum.add(search.component("slow", 1.0, 0.5, power))
        wider = replace(model, spectrum=spectrum, **known)
        parts = identified_model.describe_axis(search, wider, None, "").parts
        frequencies = sorted(part.frequency_hz for part in parts)
        assert frequencies == pytest.approx(sorted(places + extra))


def test_the_number_of_components_is_said_of_the_axis_that_tells_it_least() -> None:
    sure = replace(weakest_lines(0)[1], over_fewer=38.4, over_more=7.2)
    unsure = replace(sure, parts=(), over_fewer=np.inf, over_more=2.9)
    both = IdentifiedModel(axes=(sure, unsure), frame_rate_hz=RATE, delay_frames=2.0)
    assert identified_model.say_count(both) == (
        "The record tells 3 components from 2 by at most 38 and from 4 by about 3 units of the "
        "log-likelihood beyond the price."
    )
    alone = identified_model.say_count(replace(both, axes=(unsure,)))
    assert alone.startswith("The record tells 0 components from 1 by about 3 units")


ANGLE = 30.0
PATH = lbt.LoopHardware(frame_rate_hz=RATE)


def shaking(degrees: float, *, hz: float = 31.0, rms: float = 60.0) -> lbt.Vibration:
    direction = (np.cos(np.radians(degrees)), np.sin(np.radians(degrees)))
    return lbt.Vibration(frequency_hz=hz, damping=0.006, rms_nm=rms, direction=direction)


DIAGONAL, TILT = shaking(ANGLE), shaking(90, hz=52, rms=40)


def test_a_weak_part_of_a_line_belongs_to_it() -> None:
    """Tilt alone does not show its 0.7 nm."""
    record = open_record(((shaking(1.0, rms=40), 0),), noise=12.0)
    assert not identify_series(record.measurements[:, 1]).lines
    (line,) = lbt.identify(record).shared
    assert line.direction_deg == pytest.approx(1, abs=4 * line.direction_error_deg)
    assert line.direction_error_deg < 0.4


def test_a_neighbour_has_its_direction_first() -> None:
    lines = ((shaking(-23, hz=37, rms=90), 0), (shaking(21, hz=41, rms=15), 0))
    found = lbt.identify(open_record(lines, frames=20_000)).shared
    assert [round(line.frequency_hz) for line in found] == [37, 41]
    for line, degrees in zip(found, (-23, 21), strict=True):
        assert line.direction_deg == pytest.approx(degrees, abs=4 * line.direction_error_deg)


@pytest.mark.parametrize(
    ("lines", "places"),
    [
        (((shaking(0), 0), (TILT, 0)), [[31], [52]]),
        (((shaking(0), 0), (shaking(90), 0)), [[31], [31]]),  # twins
        (((shaking(45), 8),), [[31], [31]]),  # an ellipse: a quarter of the period
    ],
)
def test_axes_that_share_nothing_are_those_that_were_found_alone(lines, places) -> None:
    model = lbt.identify(record := open_record(lines, frames=8192))
    assert not model.shared
    assert [[round(line.frequency_hz) for line in axis.lines] for axis in model.axes] == places
    for axis, y in zip(model.axes, record.measurements.T, strict=True):
        alone = identify_series(y)
        assert (axis.parts, axis.noise_nm) == (alone.parts, alone.noise_nm)


def test_turbulence_of_both_axes() -> None:
    model = lbt.identify(open_record(shared_nm=-400.0))
    (air,) = model.shared
    assert air.kind == "turbulence"
    assert air.direction_deg == pytest.approx(45, abs=10)
    assert air.direction_error_deg is None
    covariance = np.outer(air.direction, air.direction) * air.rms_nm**2
    whole = covariance[0, 0] + model.axes[0].turbulence.rms_nm ** 2
    assert covariance[0, 1] / whole == pytest.approx(400**2 / (400**2 + 300**2), abs=0.1)


@pytest.fixture(scope="module")
def model() -> IdentifiedModel:
    return lbt.identify(open_record(((DIAGONAL, 0), (TILT, 0)), seed=1))


def test_a_line_along_a_diagonal_is_one_line_of_which_each_axis_shows_its_share(model):
    (line,) = model.shared
    assert line.kind == "line"
    assert line.direction_deg == pytest.approx(ANGLE, abs=4 * line.direction_error_deg)
    assert 0 < line.direction_error_deg < 0.5
    assert line.frequency_hz == pytest.approx(31, abs=4 * line.frequency_error_hz)
    assert line.rms_nm == pytest.approx(60, abs=3 * line.rms_error_nm)
    shares = [axis.lines[0] for axis in model.axes]
    for share, part in zip(shares, line.direction, strict=True):
        assert share.direction == line.direction
        assert share.rms_nm == pytest.approx(part * line.rms_nm)
        assert (share.frequency_hz, share.damping) == (line.frequency_hz, line.damping)
        assert share.evidence == line.evidence > 100
    own = model.axes[1].lines[1]
    assert own.direction is own.direction_deg is None
    assert own.vibration().direction == (1.0, 0.0)


def test_the_plant_has_each_line_once(model):
    own, shared = model.parts
    assert own.direction == (0.0, 1.0)
    assert own.direction_deg == 90
    assert shared is model.shared[0]
    plant = model.plant()
    directions = np.array([line.direction for line in plant.vibrations])
    assert directions == pytest.approx(np.array([own.direction, shared.direction]), rel=1e-14)
    assert model.truth().vibrations == plant.vibrations
    assert plant.n_states == 2 * 2 + 2 * (1 + max(a.turbulence.order for a in model.axes))


def test_the_filter_uses_both_axes(model):
    """It comes closer to the filter of the truth than one with a line on either axis."""
    axes = zip(model.axes, np.eye(2).tolist(), strict=True)
    apart = [replace(axis.lines[0], direction=along).vibration() for axis, along in axes]
    truth = lbt.Truth(turbulence=slow(), vibrations=(DIAGONAL, TILT), noise_nm=6.0)
    variances = []
    for lines in (model.plant().vibrations, [*apart, TILT], [DIAGONAL, TILT]):
        design = lbt.kalman(with_vibrations(model.plant(), lines))
        loop = lbt.close_loop(PATH, design.controller)
        variances.append(lbt.residual_budget(loop, truth).rms_nm ** 2)
    assert variances[0] < min(0.95 * variances[1], 1.02 * variances[2])


@pytest.mark.study
def test_errors_of_direction_frequency_and_size():
    deviations = np.zeros((8, 3))
    for seed, row in enumerate(deviations):
        (line,) = lbt.identify(open_record(((DIAGONAL, 0),), seed=seed, frames=8192)).shared
        row[0] = (line.direction_deg - ANGLE) / line.direction_error_deg
        row[1] = (line.frequency_hz - 31) / line.frequency_error_hz
        row[2] = np.log(line.rms_nm / 60) * line.rms_nm / line.rms_error_nm
    sizes = np.sqrt(np.mean(np.square(deviations), axis=0))
    assert np.all((sizes > 0.5) & (sizes < 1.6))


def test_errors_hold_what_the_error_of_a_gain_moves():
    """A fit at another gain says by how much."""
    truth = lbt.Truth(turbulence=slow(), vibrations=(DIAGONAL,), noise_nm=6.0, sensor_gain=0.6)
    run = lbt.simulate(lbt.integrator(PATH, gain=0.2), truth, hardware=PATH, frames=8000)
    known = {"frame_rate_hz": RATE, "delay_frames": 2, "unit": "nm"}
    record = loop_record(run.measurements[0], run.commands[0], **known)
    stretches = record.stretches()
    pairs = [*zip(record.measurements.T, record.corrections().T, strict=True)]

    def couple(gain: float, error: float):
        known = {"sensor_gain": gain, "sensor_gain_error": error, "stretches": stretches}
        axes = [identify_series(y, c, **known) for y, c in pairs]
        (axis, _), (line,) = couple_axes(record, axes, stretches, 3.0)
        values, errors = (line.rms_nm, axis.noise_nm), (line.rms_error_nm, axis.noise_error_nm)
        return np.array(values), np.array(errors)

    values, held = couple(0.6, 0.0)
    _, errors = couple(0.6, 0.06)
    moved, _ = couple(0.606, 0.0)
    assert np.sqrt(errors**2 - held**2) == pytest.approx(10 * np.abs(moved - values), rel=0.2)
