"""Both axes identified with one sensor gain, and records that are not what they seem."""

from __future__ import annotations

import numpy as np
import pytest
from support.recorded_loops import LINE, integrator_loop, spliced_record

import lbt_synth as lbt
from lbt_synth.errors import ProblemError

RATE = 1000.0


FRAMES = 16_384


def joint(
    gains: tuple[float, float], loop_gains: tuple[float, float]
) -> lbt.identification.IdentifiedModel:
    parts = [
        integrator_loop(sensor_gain=g, gain=k, seed=i, frames=20_000, noise=10.0)
        for i, (g, k) in enumerate(zip(gains, loop_gains, strict=True))
    ]
    y, c = (np.hstack([part[i] for part in parts]) for i in range(2))
    u = np.vstack([c, np.zeros((2, 2))])
    record = lbt.identification.loop_record(
        np.vstack([np.zeros((2, 2)), y]), u, frame_rate_hz=RATE, delay_frames=2.0, unit="nm"
    )
    return lbt.identify(record)


def test_axes_share_a_sensor_gain_where_they_agree() -> None:
    same = joint((0.6, 0.6), (0.4, 0.4))
    assert same.axes[0].sensor_gain == same.axes[1].sensor_gain
    assert same.axes[0].sensor_gain_error is not None
    assert same.sensor_gains[0] == pytest.approx(0.6, abs=4 * same.axes[0].sensor_gain_error)
    other = joint((0.9, 0.4), (0.4, 0.4))
    assert other.sensor_gains == pytest.approx((0.9, 0.4), rel=0.1)
    assert "different sensor gains" in other.notes[0]
    one = joint((0.6, 0.6), (0.4, 0.002))
    assert one.axes[1].sensor_gain_note == "that of the other axis"
    assert one.axes[0].sensor_gain == one.axes[1].sensor_gain


def test_identify_needs_what_it_needs() -> None:
    y = np.random.default_rng(0).standard_normal((6000, 1))
    without = lbt.identification.loop_record(y, y, frame_rate_hz=RATE, unit="nm")
    with pytest.raises(ProblemError, match="with_delay"):
        lbt.identify(without)
    with pytest.raises(ProblemError, match="one number, or 1"):
        lbt.identify(
            lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm"), sensor_gain=[1.0, 2.0]
        )
    with pytest.raises(ProblemError, match="expected an IdentifiedModel"):
        lbt.report.figures.identification_figure("model")


@pytest.mark.parametrize("factor", [1 / 500, 100.0])
def test_commands_in_other_units_are_doubted(factor: float) -> None:
    record = spliced_record((0,), lines=LINE, frames=20_000)
    wrong = lbt.identification.loop_record(
        record.measurements,
        factor * record.commands,
        frame_rate_hz=RATE,
        delay_frames=2,
        unit="nm",
    )
    found = lbt.identify(wrong)
    doubted = any("units, signs and axes of the commands" in note for note in found.notes)
    assert doubted or found.axes[0].sensor_gain_error is None


def test_wide_resonances_that_hide_the_gain_are_noted() -> None:
    lines = ((20.0, 0.1, 60.0), (60.0, 0.3, 40.0), (130.0, 0.5, 40.0))
    axis = lbt.identify(spliced_record((1,), lines=lines, frames=60_000, noise=8.0)).axes[0]
    if axis.sensor_gain_error is None:
        assert "not found" in axis.sensor_gain_note
    else:
        assert axis.sensor_gain == pytest.approx(0.6, abs=3 * axis.sensor_gain_error)


def test_a_wide_resonance_is_no_turbulence() -> None:
    axis = lbt.identify(spliced_record((1,), lines=((60.0, 0.3, 30.0),), frames=60_000)).axes[0]
    assert axis.turbulence_fit.frequency_hz < 3
    assert axis.turbulence.rms_nm == pytest.approx(300, rel=0.3)
    (part,) = axis.parts
    assert part.kind == "broad"
    assert part.frequency_hz == pytest.approx(60, rel=0.1)


def test_standard_errors_hold_the_error_of_the_gain() -> None:
    deviations = []
    for seed in range(10):
        parts = [
            integrator_loop(lines=((31, 0.05, 60),), gain=0.15, seed=10 * seed + i, frames=15_000)
            for i in range(2)
        ]
        y, c = (np.hstack([part[i] for part in parts]) for i in range(2))
        record = lbt.identification.loop_record(
            y[:-2], np.vstack([c[2:], c[-2:]])[:-2], frame_rate_hz=RATE, delay_frames=2, unit="nm"
        )
        model = lbt.identify(record)
        alone = lbt.identification.identify_axis(
            y[:, 0], c[:, 0], frame_rate_hz=RATE, sensor_gain=model.sensor_gains[0]
        )
        deviations += [
            (axis.lines[0].rms_nm - 60) / axis.lines[0].rms_error_nm
            for axis in model.axes
            if axis.lines
        ]
        # a gain that is given without an error makes them smaller
        assert model.axes[0].lines[0].rms_error_nm > alone.lines[0].rms_error_nm
    assert 0.5 < np.sqrt(np.mean(np.square(deviations))) < 1.6


def test_the_limit_of_lines_is_kept_and_noted() -> None:
    lines = tuple((10.0 + 12 * i, 0.004, 30.0) for i in range(8))
    record = spliced_record(lines=lines, frames=20_000)
    found = lbt.identify(record, most_lines=5, sensor_gain=0.6)
    assert sum(part.kind != "turbulence" for part in found.axes[0].parts) <= 5
    assert any("limit of 5 lines was reached" in note for note in found.notes)
    assert not any("limit" in note for note in lbt.identify(record, sensor_gain=0.6).notes)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sensor_gain": 1e300}, "sensor_gain must be"),
        ({"sensor_gain": "x"}, "sensor_gain must be numbers"),
        ({"announced": [31.0]}, "LinePrior"),
        ({"start": 3}, "IdentifiedModel"),
        ({"stretches": [(2, 4000), (3000, 5000)]}, "lie apart"),
        ({"stretches": [(0, 4000)]}, "usable"),
        ({"frame_rate_hz": 900.0}, "for spectra only"),
        ({"delay_frames": 3.0}, "with_delay"),
    ],
)
def test_bad_requests(options: dict[str, object], words: str) -> None:
    with pytest.raises(ProblemError, match=words):
        lbt.identify(spliced_record(frames=6000), **options)  # type: ignore[arg-type]


def test_a_dead_axis_is_named() -> None:
    y = np.random.default_rng(0).standard_normal((6000, 2))
    y[:, 1] = 0
    record = lbt.identification.LoopRecord(
        frame_rate_hz=RATE,
        measurements=y,
        usable=np.ones(6000, dtype=bool),
        health=lbt.identification.RecordHealth(frames=6000, usable=6000),
    )
    with pytest.raises(ProblemError, match="axis 1 of the record is constant"):
        lbt.identify(record)
