"""Records from arrays: gaps, units, commands, and what is refused."""

from functools import partial

import numpy as np
from support.records import SHELL, findings, kinds, ran
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.identification import loop_record
from lbt_synth.identification.records.record import require_length

RATE = 1000.0


def test_gaps_of_every_kind():
    y = 10 * np.random.default_rng(1).standard_normal((2000, 2))
    y[100, 0] = np.nan
    y[200:203, 1] = np.inf
    y[300, 1] = -3e105
    y = np.ma.masked_array(y, mask=y == y[400, 1])
    y[500:540, 0] = y[500, 0]
    seen = loop_record(y, frame_rate_hz=RATE, unit="nm")
    assert findings(seen) == [
        ("not finite", "measurements", 0, 1, 100),
        ("stuck", "measurements", 0, 40, 500),
        ("not finite", "measurements", 1, 5, 200),
    ]
    assert int(seen.usable.sum()) == np.sum(seen.usable) == 2000 - 46
    ends = np.reshape([0, 100, 101, 200, 203, 300, 301, 400, 401, 500, 540, 2000], (-1, 2))
    assert np.array_equal(seen.stretches(), ends)
    assert np.all(np.isfinite(seen.measurements))
    assert seen.summary() == (
        "1954 of 2000 frames are usable; 1 not finite (measurements), 40 stuck (measurements), "
        "5 not finite (measurements)."
    )


def test_a_dead_axis_leaves_nothing():
    y = np.random.default_rng(0).standard_normal((5000, 2)) * [1, 0]
    seen = loop_record(y, frame_rate_hz=RATE, unit="nm")
    assert not seen.usable.any()
    assert kinds(seen) == {("stuck", "measurements", 1)}
    words = r"got 0 \(0 s\), the longest stretch 0. 0 of 5000 frames"
    refused(lambda: require_length(seen), ProblemError, words)


def test_clipped_commands_spoil_their_corrections():
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    run = ran(path, frames=3000, noise_nm=5)
    u = np.clip(run.commands[0], -250, None)
    u[1000:1100] = 0.0  # the loop was open, and zeros are no end of a range
    seen = loop_record(run.measurements[0], u, frame_rate_hz=RATE, delay_frames=2, unit="nm")
    clipped = np.any(run.commands[0] < -250, axis=1) & np.all(u != 0, axis=1)
    expected = np.zeros(3000, dtype=bool)
    expected[:2] = True
    expected[2:] |= clipped[:-2]
    assert clipped.sum() > 5
    assert np.array_equal(~seen.usable, expected)


def test_an_open_loop_with_zero_commands():
    y = np.random.default_rng(0).standard_normal((200, 2))
    seen = loop_record(y, 0 * y, frame_rate_hz=RATE, delay_frames=2, unit="nm")
    assert seen.usable[2:].all()
    assert np.array_equal(seen.pseudo_open_loop(), y)


def test_a_scatter_that_changes_is_said():
    y = np.random.default_rng(0).standard_normal((4000, 2))
    y[:, 1] *= np.linspace(1, 6, 4000)
    seen = loop_record(y, frame_rate_hz=RATE, unit="nm")
    (note,) = seen.notes
    assert note.startswith("axis 1 is not stationary: the rms difference of two frames is 2")
    assert seen.usable.all()


def test_arrays_that_are_refused():
    y = np.random.default_rng(0).standard_normal((30, 2))
    fields = {"measurements": y, "commands": y, "frame_rate_hz": RATE, "unit": "nm"}
    odd_rate = {"frame_rate_hz": 777, "delay_frames": 2, "mirror": SHELL}
    rows = [
        ({"measurements": np.ones((3, 5))}, "one or two axes.*Choose tip and tilt"),
        ({"measurements": np.ones((2, 50))}, "one or two axes.*Transpose it"),
        ({"measurements": []}, "not empty"),
        ({"commands": np.ones((30, 1))}, "commands must match measurements"),
        ({"delay_frames": 0.5}, "delay_frames must be at least 1"),
        ({"obstruction": 1}, "obstruction must be below 1"),
        ({"mirror": "shell"}, "expected a PositionLoop"),
        (odd_rate, "whole number of samples per frame"),
    ]
    require_refusals(
        (partial(loop_record, **{**fields, **change}), ProblemError, words)
        for change, words in rows
    )
