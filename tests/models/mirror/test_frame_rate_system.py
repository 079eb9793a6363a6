"""The mirror, in its local loop and at the frame rate, against brute force and closed forms."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.models.mirror.frame_rate_system import instant_mirror, lifted_mirror

SLOW = {"natural_frequency_hz": 20, "damping": 0.5, "bandwidth_hz": 70, "delay_samples": 2}
shell = partial(
    lbt.models.PositionLoop.from_bandwidth, natural_frequency_hz=50, damping=0.5, bandwidth_hz=500
)


def test_the_step_is_that_of_a_second_order_system_when_sampled_fast():
    w, z = 2 * np.pi * 500, 0.6
    step = shell(bandwidth_damping=z, sampling_hz=2e6, delay_samples=0).step_response()
    t, wd = step.time_s, w * np.sqrt(1 - z**2)
    exact = 1 - np.exp(-z * w * t) * (np.cos(wd * t) + z / np.sqrt(1 - z**2) * np.sin(wd * t))
    np.testing.assert_allclose(step.position, exact, atol=2e-3)
    assert step.overshoot == pytest.approx(np.exp(-np.pi * z / np.sqrt(1 - z**2)), rel=2e-2)
    enters = brentq(lambda s: np.interp(s, t, exact) - 0.9, 0, np.pi / wd)
    assert step.settling_s == pytest.approx(enters, rel=2e-3)


@pytest.mark.parametrize("changes", [{}, {"ramp_samples": 37, "delay_samples": 0}, SLOW])
def test_a_step_response_in_blocks_is_that_sample_by_sample(changes):
    mirror = shell(**changes)
    loop, step = mirror.closed_loop(), mirror.step_response()
    state = np.zeros(loop.n_states)
    for i in range(300):
        assert step.position[8 * i] == pytest.approx(state[0], abs=1e-12)
        state = loop.A @ state + loop.B[:, 0] * min(1.0, (i + 1) / mirror.ramp_samples)


def brute_taps(mirror, frame_rate_hz, delay_frames, frames):
    """Averages over exposures by an integrator of differential equations, sample by sample."""
    w, dt = 2 * np.pi * mirror.natural_frequency_hz, 1 / mirror.sampling_hz
    edges = (np.arange(frames + 1) - delay_frames + 1) / frame_rate_hz  # after the arrival

    def motion(t, s, a):
        return [s[1], a - 2 * mirror.damping * w * s[1] - w**2 * s[0], s[0]]

    state, last, pipeline = np.zeros(3), 0.0, [0.0] * mirror.delay_samples
    integrals = np.zeros(frames + 1)
    for i in range(int(np.ceil(edges[-1] / dt)) + 1):
        r = min(1.0, (i + 1) / mirror.ramp_samples)
        pipeline.append(
            mirror.feed_forward * w**2 * r
            + mirror.proportional_per_s2 * (r - state[0])
            - mirror.derivative_per_s * (state[0] - last) * mirror.sampling_hz
        )
        a, last = pipeline.pop(0), state[0]
        options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-15, "dense_output": True}
        run = solve_ivp(motion, (i * dt, (i + 1) * dt), state, args=(a,), **options)
        inside = (edges >= i * dt) & (edges < (i + 1) * dt)
        if inside.any():
            integrals[inside] = run.sol(edges[inside])[2]
        state = run.y[:, -1]
    return np.diff(np.diff(integrals), prepend=0) * frame_rate_hz / mirror.static_gain


@pytest.mark.parametrize(
    ("mirror", "rate", "delay"),
    [
        (shell(feed_forward=0.3, delay_samples=3), 2400.0, 1.37),
        (shell(ramp_samples=11, natural_frequency_hz=300, damping=0.1), 3000.0, 2.6321),
        (shell(**SLOW), 4000.0, 2.5),
    ],
)
def test_the_lifted_mirror_is_the_brute_force_one(mirror, rate, delay):
    taps = lifted_mirror(mirror, rate, delay).taps
    np.testing.assert_allclose(taps[:8], brute_taps(mirror, rate, delay, 8), atol=1e-12)


@settings(max_examples=10)
@given(
    natural=st.floats(5, 300),
    damping=st.floats(0.02, 1.1),
    ratio=st.floats(1.5, 10),
    delay=st.floats(1, 4),
    late=st.integers(0, 3),
    ramp=st.integers(1, 60),
)
def test_taps_are_an_impulse_response_of_unit_gain(natural, damping, ratio, delay, late, ramp):
    loop = {"natural_frequency_hz": natural, "damping": damping, "bandwidth_hz": natural * ratio}
    try:
        mirror = shell(**loop, bandwidth_damping=0.8, delay_samples=late, ramp_samples=ramp)
    except ProblemError as error:
        if "must be stable" not in str(error):
            raise
        return
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay, mirror=mirror)
    system, taps = path.mirror_system, path.mirror_taps
    assert taps.sum() == pytest.approx(1, abs=1e-13)
    assert not np.any(taps[: system.lead])
    assert taps[system.lead] == pytest.approx(system.core.D)
    np.testing.assert_allclose(system.whole.impulse(taps.size), taps, atol=1e-12)
    later = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay + 1, mirror=mirror)
    assert later.mirror_taps[1 : taps.size + 1] == pytest.approx(taps, abs=1e-9)


def test_a_loop_without_a_mirror_is_what_it_was():
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2.25)
    assert path.mirror is None
    assert path.mirror_taps.tolist() == [0.0, 0.75, 0.25]
    assert instant_mirror(1.0).whole.n_states == 0


def test_mirrors_that_cannot_be_or_do_not_fit_are_refused():
    quick, gains = shell(sampling_hz=8e7), ("proportional_per_s2", "derivative_per_s")
    bare = partial(lbt.models.PositionLoop, **dict.fromkeys(gains, 0), natural_frequency_hz=10)
    ringing = bare(damping=1e-5)

    def loop(rate, mirror):
        return lambda: lbt.LoopHardware(frame_rate_hz=rate, mirror=mirror)

    rows = [
        (partial(shell, bandwidth_hz=30), "bandwidth_hz must be at least 50"),
        (partial(shell, natural_frequency_hz=0), "natural_frequency_hz must be above 0"),
        (partial(shell, bandwidth_hz=5000, delay_samples=6), "local loop of the mirror must be st"),
        (partial(shell, delay_samples=1000), "delay_samples must be at most 64"),
        (partial(shell, sampling_hz=80.0), "natural_frequency_hz must lie below half"),
        (partial(shell, feed_forward=11), "feed_forward must be at most 10"),
        (partial(shell, damping=20.0), "bandwidth_damping must be at least"),
        (partial(bare, damping=1, feed_forward=0), "must follow its command"),
        (partial(shell().step_response, 1.0), "tolerance must be below 1"),
        (ringing.step_response, "must settle within"),
        (loop(990, shell()), r"that fit are 986\.30137 and 1000 Hz"),
        (loop(1e5, shell()), r"that fit are 72000 Hz"),
        (loop(800, shell(ramp_samples=91)), "ramp_samples must be at most 90"),
        (loop(800, 0.7), "expected a PositionLoop"),
        (loop(799, quick), r"at most 100000 samples .* Lower sampling_hz"),
        (loop(1e-308, quick), "got inf"),
        (loop(800, ringing), "must settle within 4000 frames"),
    ]
    require_refusals((call, ProblemError, words) for call, words in rows)
    loop(8000, quick)()
