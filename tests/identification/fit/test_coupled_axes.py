"""Shared lines in the model of both axes: shares, directions, errors, plant and truth."""

from __future__ import annotations

import numpy as np
import pytest
from support.recorded_loops import RATE, open_record, slow

import lbt_synth as lbt
from lbt_synth.identification.fit.coupled_axes import couple_axes
from lbt_synth.models.plant.tip_tilt import with_vibrations

ANGLE = 30.0
ALONG = (float(np.cos(np.radians(ANGLE))), float(np.sin(np.radians(ANGLE))))
DIAGONAL = lbt.Vibration(frequency_hz=31, damping=0.006, rms_nm=60, direction=ALONG)
TILT = lbt.Vibration(frequency_hz=52, damping=0.006, rms_nm=40, direction=(0, 1))


@pytest.fixture(scope="module")
def model() -> lbt.identification.IdentifiedModel:
    return lbt.identify(open_record(((DIAGONAL, 0), (TILT, 0)), seed=1))


def test_each_axis_shows_its_share(model):
    (line,) = model.shared
    shares = [axis.lines[0] for axis in model.axes]
    assert [share.direction for share in shares] == [line.direction] * 2
    for share, part in zip(shares, line.direction, strict=True):
        assert share.rms_nm == pytest.approx(part * line.rms_nm)
        assert share.frequency_hz == line.frequency_hz
        assert share.damping == line.damping
        assert share.evidence == line.evidence > 100
    own = model.axes[1].lines[1]
    assert own.direction is None
    assert own.direction_deg is None
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
    each = zip(model.axes, ((1, 0), (0, 1)), strict=True)
    apart = [axis.lines[0].vibration(direction) for axis, direction in each]
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    truth = lbt.Truth(turbulence=slow(), vibrations=(DIAGONAL, TILT), noise_nm=6.0)

    def left(vibrations):
        plant = with_vibrations(model.plant(), vibrations)
        loop = lbt.close_loop(path, lbt.kalman(plant).controller)
        return lbt.residual_budget(loop, truth).rms_nm ** 2

    together = left(model.plant().vibrations)
    assert together < 0.95 * left([*apart, TILT])
    assert together < 1.02 * left([DIAGONAL, TILT])


def test_errors_of_direction_frequency_and_size():
    deviations = []
    for seed in range(8):
        (line,) = lbt.identify(open_record(((DIAGONAL, 0),), seed=seed, frames=8192)).shared
        deviations.append(
            [
                (line.direction_deg - ANGLE) / line.direction_error_deg,
                (line.frequency_hz - 31) / line.frequency_error_hz,
                np.log(line.rms_nm / 60) * line.rms_nm / line.rms_error_nm,
            ]
        )
    size = np.sqrt(np.mean(np.square(deviations), axis=0))
    assert np.all((size > 0.5) & (size < 1.6))


def test_errors_hold_what_the_error_of_a_gain_moves():
    """A fit at another gain says by how much."""
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    truth = lbt.Truth(turbulence=slow(), vibrations=(DIAGONAL,), noise_nm=6.0, sensor_gain=0.6)
    ran = lbt.integrator(path, gain=0.2).controller
    run = lbt.simulate(ran, truth, hardware=path, frames=8000)
    record = lbt.identification.loop_record(
        run.measurements[0], run.commands[0], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )

    def couple(gain: float, error: float):
        axes = [
            lbt.identification.identify_axis(
                y,
                c,
                frame_rate_hz=RATE,
                sensor_gain=gain,
                sensor_gain_error=error,
                stretches=record.stretches(),
            )
            for y, c in zip(record.measurements.T, record.corrections().T, strict=True)
        ]
        axes, (line,), _ = couple_axes(record, axes, record.stretches(), 3.0)
        return (
            np.array([line.rms_nm, axes[0].noise_nm]),
            np.array([line.rms_error_nm, axes[0].noise_error_nm]),
        )

    values, held = couple(0.6, 0.0)
    _, errors = couple(0.6, 0.06)
    moved, _ = couple(0.606, 0.0)
    assert np.sqrt(errors**2 - held**2) == pytest.approx(10 * np.abs(moved - values), rel=0.2)


def test_a_drift_that_becomes_a_resonance_keeps_the_lines_in_their_places() -> None:
    """Parts and components were matched by their order, which the drift changes."""
    air = lbt.Atmosphere(seeing_arcsec=1.0, outer_scale_m=25, wind_speed_m_s=20, diameter_m=8.22)
    driving = 30 * float(np.sqrt(1 - 0.999**2))
    drift = lbt.models.ARModel(coefficients=[0.999], driving_rms_nm=driving, frame_rate_hz=1000)
    total = lbt.models.SumSpectrum(parts=[air, drift])
    lines = tuple(
        lbt.Vibration(frequency_hz=f, damping=0.005, rms_nm=rms, direction=direction)
        for f, rms, direction in ((40.0, 50.0, (1, 1)), (4.5, 60.0, (1, -1)), (90.0, 20.0, (0, 1)))
    )
    path = lbt.LoopHardware(frame_rate_hz=1000)
    truth = lbt.Truth(turbulence=total, vibrations=lines, noise_nm=5.0, sensor_gain=0.6)
    law = lbt.integrator(path, gain=0.4).controller
    run = lbt.simulate(law, truth, hardware=path, frames=30_000, seed=1, settle_frames=1000)
    record = lbt.identification.loop_record(
        run.measurements[0], run.commands[0], frame_rate_hz=1000, delay_frames=2, unit="nm"
    )
    model = lbt.identify(record)
    for axis in model.axes:
        kinds = [c.kind for c in axis.fitted_model.spectrum.components]
        assert kinds[0] == "drift"
        (slow,) = [part for part in axis.parts if part.kind == "turbulence"]
        assert 4.5 < slow.frequency_hz < 40  # between two lines
        assert slow.direction is None
        for part in axis.parts:
            if part.kind == "line":
                assert part.separable_hz is not None
                assert part.separable_hz < 2
    assert [round(line.frequency_hz) for line in model.shared] == [5, 40]
    for line, sign in zip(model.shared, (-1, 1), strict=True):
        assert line.direction is not None
        assert line.direction[0] * line.direction[1] == pytest.approx(0.5 * sign, abs=0.02)
