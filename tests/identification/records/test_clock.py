"""Times and counters: missing and repeated frames, stated rates, rounded times."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.records import findings, noise
from support.refusals import require_refusals

from lbt_synth.errors import ProblemError
from lbt_synth.identification import loop_record

RATE = 1000.0


@pytest.mark.parametrize("by", ["times", "numbers", "both"])
def test_missing_frames_become_holes(by):
    y, kept = noise(500), np.delete(np.arange(500), [100, 101, 300])
    clock = {} if by == "times" else {"frame_numbers": 7000 + kept}
    if by != "numbers":
        jitter = np.random.default_rng(1).uniform(-1e-4, 1e-4, len(kept))
        clock["times_s"] = 1.7e9 + kept / RATE + jitter
    rate = RATE if by == "numbers" else None
    seen = loop_record(y[kept], frame_rate_hz=rate, unit="nm", **clock)
    assert np.flatnonzero(~seen.usable).tolist() == [100, 101, 300]
    assert seen.frames == 500
    assert seen.frame_rate_hz == pytest.approx(RATE, rel=1e-5)
    assert np.array_equal(seen.measurements[seen.usable, 0], y[kept])
    assert findings(seen) == [("missing", "frames", None, 3, 100)]
    words = "the times lie 0.057 frames rms beside a regular grid"
    assert (words in seen.notes) is (by != "numbers")


def test_rows_that_come_twice():
    y = noise(100)
    order = np.sort(np.concatenate([np.arange(100), [20, 20, 50]]))
    rows = y[order].copy()
    same = loop_record(rows, frame_rate_hz=RATE, frame_numbers=order, unit="nm")
    assert same.usable.all()
    assert np.array_equal(same.measurements[:, 0], y)
    assert same.notes == ("3 rows of a time that had been recorded already were left out",)
    rows[np.flatnonzero(order == 50)[1]] += 1  # two stories of one frame
    torn = loop_record(rows, frame_rate_hz=RATE, times_s=order / RATE, unit="nm")
    assert np.flatnonzero(~torn.usable).tolist() == [50]
    assert findings(torn) == [("repeated", "frames", None, 1, 50)]


def test_clocks_that_are_refused():
    rows = [
        ({}, "frame rate is not known; give frame_rate_hz"),
        ({"times_s": [0, 1, 2]}, r"times_s must have shape \(6,\)"),
        ({"times_s": [0, 1, 2, 1.5, 3, 4]}, "must not run backwards; got 2 and then 1.5 at row 3"),
        ({"times_s": [0, 1, 2, np.nan, 3, 4]}, "times_s must be finite"),
        ({"times_s": [1, 1, 1, 1, 1, 1], "frame_rate_hz": 2}, "times_s must rise"),
        ({"times_s": [0, 1, 2, 3.5, 5.3, 6.3]}, "lie on no regular grid of 1 Hz"),
        ({"times_s": np.arange(6), "frame_rate_hz": 2}, "must be that of the times, 1 Hz; got 2"),
        ({"times_s": [0, 1, 2, 3, 4, 500]}, "495 of 501 frames would be missing"),
        ({"times_s": [0, 1, 2, 3, 4, 1e19], "frame_rate_hz": 1}, "frames would be missing .* cut"),
        ({"frame_numbers": [0, 1, 2, 3, 4, 1e19], "frame_rate_hz": 1}, "frames would be missing"),
        ({"frame_numbers": [0, 1, 2, 0, 1, 2], "frame_rate_hz": 2}, "frame_numbers must not run b"),
        ({"frame_numbers": [0, 1, 2, 2.5, 3, 4], "frame_rate_hz": 2}, "must be whole numbers"),
        ({"frame_rate_hz": 0}, "frame_rate_hz must be above 0"),
    ]
    require_refusals(
        (partial(loop_record, noise(6), unit="nm", **clock), ProblemError, words)
        for clock, words in rows
    )


@pytest.mark.parametrize("frames", [None, np.arange(20_000)])  # by times alone, and by both
def test_a_stated_rate_is_held_against_the_times(frames):
    clock = {"times_s": np.arange(20_000) / 1000, "frame_numbers": frames}
    for rate in (1004, 999, 1000.2):
        with pytest.raises(ProblemError, match="must be that of the times, 1000 Hz; got"):
            loop_record(noise(20_000), frame_rate_hz=rate, unit="nm", **clock)
    for rate in (1000.05, 1000):
        near = loop_record(noise(20_000), frame_rate_hz=rate, unit="nm", **clock)
        assert (near.frame_rate_hz, near.notes) == (rate, ())


@pytest.mark.parametrize("rate", [800, 998.5, 999.9, 1000])
@pytest.mark.parametrize("rounding", [np.round, np.floor])
def test_rounded_times_lose_no_frame_at_a_known_rate(rate, rounding):
    y, ms = noise(20_000), np.arange(20_000) / rate * 1e3
    times = 1e-3 * rounding(ms + 0.25)
    seen = loop_record(y, frame_rate_hz=rate, times_s=times, unit="nm")
    assert seen.frame_rate_hz == rate
    assert np.array_equal(seen.measurements[:, 0], y)
    assert seen.usable.all()
    if rate != 1000:
        with pytest.raises(ProblemError, match="may be rounded: .*Give frame_rate_hz"):
            loop_record(y, times_s=times, unit="nm")


@settings(max_examples=60, deadline=None)
@given(
    rate=st.floats(300, 2500),
    phase=st.floats(0, 1e-3),
    lost=st.lists(st.integers(1, 2998), max_size=4),
    frames=st.sampled_from([40, 300, 3000]),
    quantum=st.sampled_from([1e-3, 1e-4, 1e-6]),
)
def test_frames_are_laid_where_they_were_or_refused(rate, phase, lost, frames, quantum):
    """Never silently elsewhere, unless rounding cannot be distinguished at that rate."""
    kept = np.setdiff1d(np.arange(frames), lost)
    times = quantum * np.round((kept / rate + phase) / quantum)
    y = noise(frames)
    try:
        seen = loop_record(y[kept], frame_rate_hz=rate, times_s=times, unit="nm")
    except ProblemError:
        # never without a reason: times as coarse as frames
        assert quantum * rate > 0.4
        return
    ends = [k for k in lost if not frames // 8 < k < frames - frames // 8 and k < frames]
    if quantum * rate > 0.9 and ends:
        return  # rounding may hide a frame at the ends
    assert seen.frames == frames
    there = np.zeros(frames, dtype=bool)
    there[kept] = True
    assert np.array_equal(seen.usable, there)
    assert np.array_equal(seen.measurements[there, 0], y[there])


@pytest.mark.parametrize(
    ("rate", "lost", "step_s"),
    [
        (800, 2, 1e-3),
        (1000, 0, 1.0),
        (2000, 0, 1e-3),  # a step of two frames hides one
        (1000.1, 1, 1e-3),  # and so does one where the rate is not quite that of the times
    ],
)
def test_stamps_that_may_hide_a_lost_frame_are_refused(rate, lost, step_s):
    kept = np.delete(np.arange(40_000), 17_000 + np.arange(lost))
    times = np.floor(kept / round(rate) / step_s + 1e-6) * step_s
    known = {"frame_rate_hz": rate, "times_s": times, "unit": "nm"}
    with pytest.raises(ProblemError, match="cannot tell which frames are missing"):
        loop_record(noise(len(kept)), **known)
    assert loop_record(noise(len(kept)), **known, frame_numbers=kept).frames == 40_000


def test_one_step_of_two_may_be_rounding_or_a_frame_that_is_lost():
    times = np.floor(np.arange(300) / 999 * 1e3 + 0.9) / 1e3
    with pytest.raises(ProblemError, match="cannot tell which frames are missing"):
        loop_record(noise(300), frame_rate_hz=999, times_s=times, unit="nm")


def test_one_row_has_no_rate_of_its_own():
    seen = loop_record([[1.0]], frame_rate_hz=RATE, times_s=[5.0], unit="nm")
    assert (seen.frame_rate_hz, seen.notes) == (RATE, ())
    with pytest.raises(ProblemError, match="frame rate is not known"):
        loop_record([[1.0]], times_s=[5.0], unit="nm")
