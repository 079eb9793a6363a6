"""Which resonances of two axes are one: diagonals, twins, ellipses, weak parts, turbulence."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from support.recorded_loops import integrator_loop, open_record

import lbt_synth as lbt
from lbt_synth.identification.fit.coupled_axes import _joint_search
from lbt_synth.identification.fit.joint_whittle import JointSpectrum
from lbt_synth.identification.fit.shared_lines import Place, _fit_directions, _tie


def shaking(degrees: float, *, hz: float = 31.0, rms: float = 60.0) -> lbt.Vibration:
    direction = (np.cos(np.radians(degrees)), np.sin(np.radians(degrees)))
    return lbt.Vibration(frequency_hz=hz, damping=0.006, rms_nm=rms, direction=direction)


@cache
def diagonal(
    degrees: float,
) -> tuple[lbt.identification.LoopRecord, lbt.identification.IdentifiedModel]:
    """Return an open loop of one line along a direction, and its model."""
    record = open_record(((shaking(degrees), 0),))
    return record, lbt.identify(record)


@pytest.mark.parametrize("degrees", [36.0, -70.0])
def test_a_line_along_a_diagonal_is_one_line(degrees: float) -> None:
    _, model = diagonal(degrees)
    (line,) = model.shared
    assert line.kind == "line"
    assert line.direction_deg == pytest.approx(degrees, abs=4 * line.direction_error_deg)
    assert 0 < line.direction_error_deg < 0.5
    assert line.frequency_hz == pytest.approx(31, abs=4 * line.frequency_error_hz)
    assert line.rms_nm == pytest.approx(60, abs=3 * line.rms_error_nm)
    assert model.parts == (line,)


def test_a_weak_part_of_a_line_belongs_to_it() -> None:
    """Tilt alone does not show its 0.7 nm."""
    record = open_record(((shaking(1.0, rms=40), 0),), noise=12.0)
    alone = lbt.identification.identify_axis(record.measurements[:, 1], frame_rate_hz=1000)
    assert not alone.lines
    (line,) = lbt.identify(record).shared
    assert line.direction_deg == pytest.approx(1, abs=4 * line.direction_error_deg)
    assert line.direction_error_deg < 0.4


def test_a_neighbour_has_its_direction_first() -> None:
    lines = ((shaking(-23, hz=37, rms=90), 0), (shaking(21, hz=41, rms=15), 0))
    found = lbt.identify(open_record(lines, frames=30_000)).shared
    assert [round(line.frequency_hz) for line in found] == [37, 41]
    for line, degrees in zip(found, (-23, 21), strict=True):
        assert line.direction_deg == pytest.approx(degrees, abs=4 * line.direction_error_deg)


@pytest.mark.parametrize("seed", range(3))
def test_twins_stay_two(seed: int) -> None:
    lines = ((shaking(0), 0), (shaking(90), 0))
    model = lbt.identify(open_record(lines, seed=seed))
    assert not model.shared
    assert [[round(line.frequency_hz) for line in axis.lines] for axis in model.axes] == [[31]] * 2
    assert not model.notes


def test_an_ellipse_stays_two_lines_and_is_noted() -> None:
    model = lbt.identify(open_record(((shaking(45), 8),)))  # a quarter of the period
    assert not model.shared
    assert [len(axis.lines) for axis in model.axes] == [1, 1]
    (note,) = model.notes
    assert "move on an ellipse" in note
    assert "at 31" in note


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
    y, c = (
        np.hstack(each)
        for each in zip(
            *(
                integrator_loop(lines=((f, 0.004, 60),), seed=i, frames=8000, axes=1)
                for i, f in enumerate((31, 47))
            ),
            strict=True,
        )
    )
    u = np.vstack([c[2:], c[-2:]])
    record = lbt.identification.loop_record(
        y[:-2], u[:-2], frame_rate_hz=1000, delay_frames=2, unit="nm"
    )
    model = lbt.identify(record, sensor_gain=0.6)
    assert not model.shared
    for i, axis in enumerate(model.axes):
        alone = lbt.identification.identify_axis(
            record.measurements[:, i],
            record.corrections()[:, i],
            frame_rate_hz=1000,
            sensor_gain=0.6,
            stretches=record.stretches(),
        )
        assert axis.parts == alone.parts
        assert axis.noise_nm == alone.noise_nm


def test_a_line_that_begins_on_the_wrong_side_of_an_axis_is_taken_across() -> None:
    record, model = diagonal(36.0)
    axes = model.axes
    search = _joint_search(record, axes, record.stretches(), 3.0)
    joint = JointSpectrum(axes=tuple(axis.fitted_model.spectrum for axis in axes))
    for degrees in (36, -36):
        made = _tie(joint, Place(0, 1), Place(1, 1), shaking(degrees).direction)
        fit = _fit_directions(search, made)
        assert fit is not None
        assert np.cos(fit.joint.ties[0].phase) == pytest.approx(1)
