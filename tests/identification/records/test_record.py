"""Records: the exact pseudo-open loop, later delays, bridged holes."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.records import RATE, SHELL, noise, ran
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification import loop_record
from lbt_synth.identification.records.record import (
    LoopRecord,
    cut_stretches,
    require_length,
    split_halves,
)

record_of = partial(loop_record, frame_rate_hz=RATE, unit="nm")


@settings(max_examples=25)
@given(
    delay=st.floats(1.0, 3.5),
    gains=st.tuples(st.floats(0.3, 1.4), st.floats(0.3, 1.4)),
    noise=st.floats(0.1, 50),
    moving=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_with_noise_it_is_phase_and_noise_over_the_gain(delay, gains, noise, moving, seed):
    """Against the loop stepped by hand, one gain an axis, from its first frame."""
    mirror = SHELL if moving else None
    taps = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, mirror=mirror).mirror_taps
    rng, frames, g = np.random.default_rng(seed), 80, np.array(gains)
    phase = np.cumsum(rng.standard_normal((frames, 2)), axis=0) * 20
    w = noise * rng.standard_normal((frames, 2))
    u, y, residual = np.zeros((frames, 2)), np.zeros((frames, 2)), np.zeros(2)
    for k in range(frames):
        y[k] = g * residual + w[k]
        u[k] = 0.99 * u[k - 1] + 0.1 * y[k]
        residual = phase[k] - sum(taps[i] * u[k - i] for i in range(min(len(taps), k + 1)))
    z = record_of(y, u, delay_frames=delay, mirror=mirror).pseudo_open_loop(g)
    expected = phase[:-1] + w[1:] / g
    # before the record there were no commands: here even its first frames are right
    assert np.max(np.abs(z[1:] - expected)) < 1e-9 * np.max(np.abs(expected))


def test_a_delay_can_come_later():
    run = ran(lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=2.4))
    u = run.commands[0].copy()
    u[100, 1] = np.nan
    unknown = record_of(run.measurements[0], u)
    assert unknown.usable.all()
    words = "delay of this loop is not known; give delay_fram"
    refused(unknown.corrections, ProblemError, words)
    seen = unknown.with_delay(2.4)
    # taps of u(k-2), u(k-3): frame 100 enters 102 and 103
    assert np.flatnonzero(~seen.usable).tolist() == [0, 1, 2, 102, 103]
    other = seen.with_delay(1.0)
    assert other.mirror is seen.mirror
    assert np.flatnonzero(~other.usable).tolist() == [0, 101]
    assert [finding.kind for finding in other.findings].count("correction not known") == 1


def test_short_holes_are_bridged_on_the_pseudo_open_loop():
    phase = 200 * np.sin(2 * np.pi * 10 * np.arange(2000) / RATE)[:, None]
    u = noise(2000)[:, None]
    y = 0.6 * (np.roll(phase, 1, axis=0) - np.roll(u, 2, axis=0))
    y[300], y[700:703], y[900:904] = np.nan, np.nan, np.nan
    seen = record_of(y, u, delay_frames=2)
    whole = seen.bridged(sensor_gain=0.6)
    assert "4 frames in 2 holes of at most 3 were interpolated" in whole.notes
    assert np.flatnonzero(~whole.usable).tolist() == [0, 1, 900, 901, 902, 903]
    z = whole.pseudo_open_loop(0.6)
    assert np.array_equal(z[seen.usable], seen.pseudo_open_loop(0.6)[seen.usable])
    holes = np.array([300, 700, 701, 702])
    np.testing.assert_allclose(z[holes], phase[holes - 1], atol=0.01)
    # the original stays as it was, and its delay may still change
    assert not seen.usable[300]
    assert not whole.with_delay(2.4).usable[300]
    assert whole.bridged() is whole
    for gain in (0, [1, 1]):
        refused(partial(seen.bridged, sensor_gain=gain), ProblemError, "must be")


def test_more_than_one_hundredth_of_a_record_is_not_bridged():
    y = noise(600)
    y[100:700:100] = np.nan
    assert record_of(y).bridged().usable.all()
    y[150:153] = np.nan
    seen = record_of(y)
    assert seen.bridged() is seen


def test_records_are_frozen():
    seen = record_of([1.0, 2.0], [1.0, 3.0])
    for name in ("measurements", "commands", "usable", "measured", "commanded"):
        assert not getattr(seen, name).flags.writeable
    with pytest.raises(dataclasses.FrozenInstanceError):
        seen.source = "x"
    require_refusals(
        (partial(dataclasses.replace, seen, **change), DimensionError, words)
        for change, words in (
            ({"measured": np.ones(3, dtype=bool)}, "2 truth values"),
            ({"commands": np.ones((3, 1))}, "commands must have 2 rows"),
        )
    )


def test_length():
    y = noise(6000)
    y[::200] = np.nan  # stretches of 199
    broken = record_of(y)
    assert require_length(broken.bridged()) == 5999
    short = record_of(y[1:200], frame_rate_hz=2000)
    coarse = record_of(y[1:1000:2], frame_rate_hz=400)
    require_refusals(
        (partial(require_length, record, seconds=seconds), ProblemError, words)
        for record, seconds, words in (
            (broken, 2, r"needs 2000 usable frames \(2 s at 1000 Hz\).*got 0 "),
            (broken.bridged(), 7, r"needs 7000 usable frames \(7 s at 1000 Hz\)"),
            (short, 2, "needs 4000 usable frames"),
            (coarse, 2, "needs 1024 usable frames"),
        )
    )


def test_commands_before_a_record_do_not_make_it_shorter():
    y = noise(5000)
    whole = record_of(y, y, delay_frames=2.5)
    assert whole.stretches() == ((3, 5000),)
    assert require_length(whole, seconds=5) == 5000
    y[3] = np.nan  # a frame that was lost
    late = record_of(y, np.zeros(5000), delay_frames=2.5)
    assert (late.first_known, late.lost) == (3, pytest.approx(1 / 4997))
    refused(lambda: require_length(late, seconds=5), ProblemError, "needs 5000 usable frames")


def frames_in(stretches):
    return np.concatenate([np.arange(start, stop) for start, stop in stretches])


@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_halves_are_apart_and_in_order(good):
    good = np.array(good)
    y = np.ones((len(good), 1))
    record = LoopRecord(frame_rate_hz=500, measurements=y, measured=good, commanded=good | True)
    if sum(good) < 2:
        words = f"to fit and to test on; got {sum(good)} usable"
        refused(lambda: split_halves(record), ProblemError, words)
        return
    fit, test = (frames_in(half.stretches()) for half in split_halves(record))
    assert len(fit) == sum(good) // 2
    np.testing.assert_array_equal(np.concatenate([fit, test]), np.flatnonzero(good))


def test_a_half_keeps_what_was_bridged_and_its_commands():
    y = noise(2000)
    y[[300, 1500]] = np.nan
    record = record_of(y, y, delay_frames=2).bridged()
    first, later = split_halves(record)
    assert (first.usable[300], later.usable[1500]) == (True, True)
    np.testing.assert_array_equal(first.usable | later.usable, record.usable)
    np.testing.assert_array_equal(later.corrections(), record.corrections())


def test_cuts_are_those_of_the_usable_frames():
    usable = ((10, 400), (450, 460), (500, 1001))
    everything = frames_in(usable)
    for first, last in ((0, 390), (389, 401), (395, 901)):
        part = cut_stretches(usable, first, last)
        assert np.array_equal(frames_in(part), everything[first:last])
