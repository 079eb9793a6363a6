"""Where lines come from: their direction, with an error that covers the truth."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.control_laws import PATH, RATE
from support.recorded_loops import slow

import lbt_synth as lbt
from lbt_synth.identification.diagnosis.line_origins import line_origins

ANGLES = {20.0: 0.0, 37.0: 90.0, 61.0: 30.0, 90.0: -40.0}  # by frequency [Hz]


def line(frequency, direction, rms=60.0):
    return lbt.Vibration(frequency_hz=frequency, damping=0.006, rms_nm=rms, direction=direction)


def recorded(vibrations, seed, frames=16_384):
    truth = lbt.Truth(turbulence=slow(), vibrations=vibrations, noise_nm=8.0, sensor_gain=0.7)
    run = lbt.simulate(
        lbt.integrator(PATH, gain=0.3).controller, truth, hardware=PATH, frames=frames, seed=seed
    )
    return lbt.identification.loop_record(
        run.measurements[0], run.commands[0], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )


def origins_in(record, model):
    return line_origins(model, record.pseudo_open_loop(0.7), record.stretches())


def without_directions(model):
    """The model as if its axes kept a line each."""
    axes = [
        replace(axis, parts=tuple(replace(part, direction=None) for part in axis.parts))
        for axis in model.axes
    ]
    return replace(model, axes=tuple(axes), shared=())


@cache
def several():
    lines = tuple(
        line(f, (np.cos(np.radians(angle)), np.sin(np.radians(angle))))
        for f, angle in ANGLES.items()
    )
    # two lines of one frequency that know nothing of each other
    record = recorded((*lines, line(130, (1.0, 0.0)), line(130, (0.0, 1.0))), seed=2)
    return origins_in(record, lbt.identify(record, sensor_gain=0.7))


def test_each_line_has_its_direction():
    rows = {round(each.row.frequency_hz): each.row for each in several()}
    assert sorted(rows) == [20, 37, 61, 90, 130]
    for frequency, angle in ANGLES.items():
        row = rows[frequency]
        apart = (row.direction_deg - angle + 90) % 180 - 90
        assert abs(apart) < 4 * row.direction_error_deg < 12
        assert row.rms_nm == pytest.approx(60, rel=0.35)
    origins = [rows[f].origin for f in sorted(rows)]
    assert origins[:4] == ["tip", "tilt", "a diagonal", "a diagonal"]
    assert origins[4] == "both axes, unrelated"
    assert np.isnan(rows[130].direction_deg)


def test_a_diagonal_is_one_vibration_and_twins_are_two():
    by_frequency = {round(each.row.frequency_hz): each for each in several()}
    assert [len(by_frequency[f].vibrations) for f in (20, 37, 61, 130)] == [1, 1, 1, 2]
    assert min(np.abs(by_frequency[61].vibrations[0].direction)) > 0.4
    assert by_frequency[61].name.startswith("line at 6")


def test_errors_of_the_direction():
    angle = np.degrees(np.arctan2(0.4, 0.9))
    one = (line(45, (0.9, 0.4), rms=40.0),)
    records = [recorded(one, seed, frames=6000) for seed in range(16)]
    model = without_directions(lbt.identify(records[0], sensor_gain=0.7))
    rows = [origins_in(record, model)[0].row for record in records]
    deviations = [(row.direction_deg - angle) / row.direction_error_deg for row in rows]
    assert 0.6 < np.sqrt(np.mean(np.square(deviations))) < 1.5
