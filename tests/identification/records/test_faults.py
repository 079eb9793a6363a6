"""Faults of a series: those that are there are found, and no others."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.records import LINE, SLOW, findings, kinds, record

import lbt_synth as lbt

RATE = 1000.0


def turbulence(frames, *, rate=RATE, noise=15.5, seed=0, line=None):
    """An AR2 turbulence of 592 nm, perhaps a line, and noise."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    a = [1, -1.997477, 0.997555]
    x = lfilter([1.0], a, rng.standard_normal(frames + 20_000))[20_000:]
    x *= 592 / np.sqrt((1 + 0.997555) / (1 - 0.997555) / ((1.997555) ** 2 - 1.997477**2))
    if line is not None:
        x = x + line(np.arange(frames) / rate)
    return x + noise * rng.standard_normal(frames)


def test_a_million_clean_frames_show_nothing():
    y = np.random.default_rng(11).standard_normal((1_000_000, 1))
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    assert seen.findings == ()
    assert seen.usable.all()
    assert seen.notes == ()


def sinusoid(t):
    return 500 * np.sqrt(2) * np.cos(2 * np.pi * 20 * t + 1)


def burst(t):
    return 800 * np.exp(-(((t - t.mean()) / 0.8) ** 2)) * np.cos(2 * np.pi * 60 * t)


def high(t):
    return 500 * np.cos(2 * np.pi * 340 * t)


@pytest.mark.parametrize(
    "line", [None, sinusoid, burst, high], ids=lambda f: getattr(f, "__name__", "none")
)
@pytest.mark.parametrize("step", [None, 1.0, 30.0], ids=["fine", "1 nm", "30 nm"])
def test_strong_lines_and_coarse_numbers_are_no_faults(line, step):
    y = turbulence(30_000, noise=0.5 if step is None else 15.5, line=line)
    y = y if step is None else step * np.round(y / step)
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    assert findings(seen) == []


def test_resonances_and_closed_loops_are_no_faults():
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    sharp = lbt.Vibration(frequency_hz=45, damping=0.003, rms_nm=800, direction=[1.0, 0.2])
    truth = lbt.Truth(turbulence=SLOW, noise_nm=15.5, vibrations=(sharp, LINE))
    run = lbt.simulate(
        lbt.integrator(path, gain=0.3).controller, truth, hardware=path, frames=60_000, seed=9
    )
    seen = record(run, path)
    assert kinds(seen) == {("correction not known", "frames", None)}
    assert kinds(seen, spoils=False) == set()


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**31),
    at=st.one_of(st.integers(0, 3), st.integers(0, 4999)),
    sign=st.sampled_from([-1, 1]),
)
def test_one_spike_is_one_outlier(seed, at, sign):
    rng = np.random.default_rng(seed)
    y = 15 * rng.standard_normal((5000, 2))
    y[at, 1] += sign * 450  # half of it bends the frame beside an end
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    found = np.flatnonzero(~seen.usable)
    assert at in found
    # beside an end the frames that nothing can judge go with it
    assert len(found) == {0: 2, 1: 2, 2: 3}.get(min(at, 4999 - at), 1)
    assert kinds(seen) == {("outlier", "measurements", 1)}
    assert np.array_equal(seen.measurements[seen.usable], y[seen.usable])
    assert np.max(np.abs(seen.measurements)) < 300  # the filler is not the spike


@pytest.mark.parametrize("length", [2, 3, 4])
def test_spikes_side_by_side(length):
    y = 15 * np.random.default_rng(length).standard_normal(5000)
    y[1000 : 1000 + length] += 400
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    found = set(np.flatnonzero(~seen.usable))
    edges = {1000, 1000 + length - 1}
    assert edges <= found
    assert found <= set(range(998, 1002 + length))


@pytest.mark.parametrize("step", [None, 1.0])
@pytest.mark.parametrize("ends", [(-np.inf, 25.0), (-25.0, np.inf), (-25.0, 25.0)])
def test_a_range_that_is_cut_off_is_found(ends, step):
    y = 15 * np.random.default_rng(4).standard_normal(20_000)
    y = y if step is None else step * np.round(y / step)
    cut = np.clip(y, *ends)
    seen = lbt.identification.loop_record(cut, frame_rate_hz=RATE, unit="nm")
    assert kinds(seen) == {("saturated", "measurements", 0)}
    assert np.array_equal(seen.usable, (cut > ends[0]) & (cut < ends[1]))
