"""Resonances of both axes: which are one, their shares, directions, errors, plant and truth."""

from dataclasses import replace

import numpy as np
import pytest
from support.recorded_loops import RATE, identify_series, open_record, slow

import lbt_synth as lbt
from lbt_synth.identification import loop_record
from lbt_synth.identification.fit.shared_lines import couple_axes
from lbt_synth.models.plant.tip_tilt import with_vibrations

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


def test_twins_and_an_ellipse_stay_two_lines() -> None:
    for lines in (
        ((shaking(0), 0), (shaking(90), 0)),
        ((shaking(45), 8),),  # an ellipse: a quarter of the period
    ):
        model = lbt.identify(open_record(lines))
        assert not model.shared
        places = [[round(line.frequency_hz) for line in axis.lines] for axis in model.axes]
        assert places == [[31]] * 2


def test_turbulence_of_both_axes() -> None:
    model = lbt.identify(open_record(shared_nm=-400.0))
    (air,) = model.shared
    assert air.kind == "turbulence"
    assert air.direction_deg == pytest.approx(45, abs=10)
    assert air.direction_error_deg is None
    covariance = np.outer(air.direction, air.direction) * air.rms_nm**2
    whole = covariance[0, 0] + model.axes[0].turbulence.rms_nm ** 2
    assert covariance[0, 1] / whole == pytest.approx(400**2 / (400**2 + 300**2), abs=0.1)


def test_axes_that_share_nothing_are_those_that_were_found_alone() -> None:
    model = lbt.identify(record := open_record(((shaking(0), 0), (TILT, 0)), frames=8000))
    assert not model.shared
    for axis, y in zip(model.axes, record.measurements.T, strict=True):
        alone = identify_series(y)
        assert axis.parts == alone.parts
        assert axis.noise_nm == alone.noise_nm


@pytest.fixture(scope="module")
def model() -> lbt.identification.IdentifiedModel:
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
