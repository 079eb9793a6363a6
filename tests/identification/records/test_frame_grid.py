"""Rounded times: frames are laid where they were, or refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.records import noise

import lbt_synth as lbt


def test_rounded_times_of_a_known_rate():
    kept = np.delete(np.arange(2000), [500, 501])
    times = np.round(kept / 800, 3)  # steps of 1 and 2 ms
    y = np.random.default_rng(0).standard_normal(len(kept))
    seen = lbt.identification.loop_record(y, frame_rate_hz=800, times_s=times, unit="nm")
    assert np.flatnonzero(~seen.usable).tolist() == [500, 501]
    with pytest.raises(
        lbt.errors.ProblemError, match="the times may be rounded. Give frame_rate_hz"
    ):
        lbt.identification.loop_record(y, times_s=times, unit="nm")


@pytest.mark.parametrize(
    "rate", [800, 900, 998.5, 999.9, 1000, 1000.5, 1001, 1003, 1050, 1200, 1500, 2000]
)
@pytest.mark.parametrize("rounding", [np.round, np.floor])
def test_rounded_times_lose_no_frame_at_a_known_rate(rate, rounding):
    y, ms = noise(40_000), np.arange(40_000) / rate * 1e3
    seen = lbt.identification.loop_record(
        y, frame_rate_hz=rate, times_s=1e-3 * rounding(ms + 0.25), unit="nm"
    )
    assert seen.frame_rate_hz == rate
    assert np.array_equal(seen.measurements[:, 0], y)
    assert seen.usable.all()


@pytest.mark.parametrize("rate", [800, 900, 997, 998.5, 1001, 1003, 1050, 1200, 1500])
def test_rounded_times_do_not_tell_the_rate(rate):
    times = np.round(np.arange(30_000) / rate, 3)
    with pytest.raises(
        lbt.errors.ProblemError, match="the times may be rounded. Give frame_rate_hz"
    ):
        lbt.identification.loop_record(noise(30_000), times_s=times, unit="nm")


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
        seen = lbt.identification.loop_record(y[kept], frame_rate_hz=rate, times_s=times, unit="nm")
    except lbt.errors.ProblemError:
        # never without a reason: times as coarse as frames
        assert quantum * rate > 0.7
        return
    ends = [k for k in lost if not frames // 8 < k < frames - frames // 8 and k < frames]
    if quantum * rate > 0.9 and ends:
        return  # rounding may hide a frame at the ends
    assert seen.frames == frames
    there = np.zeros(frames, dtype=bool)
    there[kept] = True
    assert np.array_equal(seen.usable, there)
    assert np.array_equal(seen.measurements[there, 0], y[there])


def test_a_lost_frame_of_exact_times_is_still_found():
    kept = np.delete(np.arange(4000), [1700])
    for rate, times in ((1000.0, kept / 1000), (1003.0, kept / 1003)):
        seen = lbt.identification.loop_record(
            noise(3999), frame_rate_hz=rate, times_s=times, unit="nm"
        )
        assert np.flatnonzero(~seen.usable).tolist() == [1700]


def test_a_lost_frame_that_rounding_hides_is_refused():
    kept = np.delete(np.arange(40_000), [17_000])
    for rate in (1003, 2000):
        times = np.floor(kept / rate * 1e3 + 1e-6) / 1e3
        with pytest.raises(lbt.errors.ProblemError, match="cannot tell which frames are missing"):
            lbt.identification.loop_record(
                noise(39_999), frame_rate_hz=rate, times_s=times, unit="nm"
            )
    # and so it is where the rate is not quite that of the times
    kept = np.delete(np.arange(4000), [1700])
    with pytest.raises(lbt.errors.ProblemError, match="cannot tell which frames are missing"):
        lbt.identification.loop_record(
            noise(3999), frame_rate_hz=1000.1, times_s=kept / 1000, unit="nm"
        )
    # 300 frames of 999 Hz in ms: one step of 2 ms, by rounding or by a frame that is lost
    times = np.floor(np.arange(300) / 999 * 1e3 + 0.9) / 1e3
    with pytest.raises(lbt.errors.ProblemError, match="cannot tell rounding from missing"):
        lbt.identification.loop_record(noise(300), frame_rate_hz=999, times_s=times, unit="nm")
