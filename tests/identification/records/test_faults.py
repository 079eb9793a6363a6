"""Faults of a series: those that are there are found, and no others."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter
from support.records import LINE, SLOW, findings, kinds, record

import lbt_synth as lbt

RATE = 1000.0


def of_series(y):
    return lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")


def test_half_a_million_clean_frames_show_nothing():
    seen = of_series(np.random.default_rng(11).standard_normal((500_000, 1)))
    assert (seen.findings, seen.notes) == ((), ())
    assert seen.usable.all()


LINES = {
    "none": lambda t: 0 * t,
    "sinusoid": lambda t: 707 * np.cos(2 * np.pi * 20 * t + 1),
    "burst": lambda t: 800 * np.exp(-(((t - 15) / 0.8) ** 2)) * np.cos(2 * np.pi * 60 * t),
    "high": lambda t: 500 * np.cos(2 * np.pi * 340 * t),
}


@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("step", [None, 1.0, 30.0], ids=["fine", "1 nm", "30 nm"])
def test_strong_lines_and_coarse_numbers_are_no_faults(line, step):
    """Beside a turbulence of 592 nm."""
    rng = np.random.default_rng(0)
    y = lfilter([1.2], [1, -1.997477, 0.997555], rng.standard_normal(50_000))[20_000:]
    y = y * 592 / y.std() + LINES[line](np.arange(30_000) / RATE)
    y = y + (0.5 if step is None else 15.5) * rng.standard_normal(30_000)
    assert findings(of_series(y if step is None else step * np.round(y / step))) == []


def test_resonances_and_closed_loops_are_no_faults():
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    sharp = lbt.Vibration(frequency_hz=45, damping=0.003, rms_nm=800, direction=[1.0, 0.2])
    truth = lbt.Truth(turbulence=SLOW, noise_nm=15.5, vibrations=(sharp, LINE))
    run = lbt.simulate(
        lbt.integrator(path, gain=0.3).controller, truth, hardware=path, frames=60_000, seed=9
    )
    seen = record(run, path)
    assert kinds(seen) == {("correction not known", "frames", None)}


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
    seen = of_series(y)
    found = np.flatnonzero(~seen.usable)
    assert at in found
    # beside an end the frames that nothing can judge go with it
    assert len(found) == {0: 2, 1: 2, 2: 3}.get(min(at, 4999 - at), 1)
    assert kinds(seen) == {("outlier", "measurements", 1)}
    assert np.array_equal(seen.measurements[seen.usable], y[seen.usable])
    assert np.max(np.abs(seen.measurements)) < 300  # the filler is not the spike


@pytest.mark.parametrize("length", [2, 4])
def test_spikes_side_by_side(length):
    y = 15 * np.random.default_rng(length).standard_normal(5000)
    y[1000 : 1000 + length] += 400
    unusable = set(np.flatnonzero(~of_series(y).usable))
    assert {1000, 1000 + length - 1} <= unusable <= set(range(998, 1002 + length))


@pytest.mark.parametrize("step", [None, 1.0])
@pytest.mark.parametrize("ends", [(-np.inf, 25.0), (-25.0, np.inf), (-25.0, 25.0)])
def test_a_range_that_is_cut_off_is_found(ends, step):
    y = 15 * np.random.default_rng(4).standard_normal(20_000)
    y = y if step is None else step * np.round(y / step)
    cut = np.clip(y, *ends)
    seen = of_series(cut)
    assert kinds(seen) == {("saturated", "measurements", 0)}
    assert np.array_equal(seen.usable, (cut > ends[0]) & (cut < ends[1]))
