"""The mirror at the frame rate, against brute force and closed forms."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import lbt_synth as lbt
from lbt_synth.models.mirror.frame_rate_system import instant_mirror, lifted_mirror

SLOW = {"natural_frequency_hz": 20, "damping": 0.5, "bandwidth_hz": 70, "delay_samples": 2}
shell = partial(
    lbt.models.PositionLoop.from_bandwidth, natural_frequency_hz=50, damping=0.5, bandwidth_hz=500
)


def brute_taps(mirror, frame_rate_hz, delay_frames, frames):
    """Averages over exposures by an integrator of differential equations, sample by sample."""
    w = 2 * np.pi * mirror.natural_frequency_hz
    dt, frame = 1 / mirror.sampling_hz, 1 / frame_rate_hz
    arrival = (delay_frames - 1) * frame

    def motion(t, s, a):
        return [s[1], a - 2 * mirror.damping * w * s[1] - w**2 * s[0], s[0]]

    state, last, pipeline = np.zeros(3), 0.0, [0.0] * mirror.delay_samples
    edges = np.arange(1, frames + 2) * frame - arrival  # ends of exposures after the arrival
    edges = edges[edges > 1e-12]
    averages, i = [], 0
    while len(averages) < edges.size:
        r = min(1.0, (i + 1) / mirror.ramp_samples)
        a = (
            mirror.feed_forward * w**2 * r
            + mirror.proportional_per_s2 * (r - state[0])
            - mirror.derivative_per_s * (state[0] - last) * mirror.sampling_hz
        )
        pipeline.append(a)
        a, last = pipeline.pop(0), state[0]
        inside = edges[(edges > i * dt + 1e-12) & (edges <= (i + 1) * dt + 1e-12)]
        stops = np.concatenate([inside, [(i + 1) * dt]])
        t = i * dt
        for n, stop in enumerate(stops):
            if stop - t > 1e-15:
                run = solve_ivp(
                    motion, (t, stop), state, args=(a,), rtol=1e-12, atol=1e-15, method="DOP853"
                )
                state, t = run.y[:, -1], stop
            if n < inside.size:
                averages.append(state[2])
                state[2] = 0.0
        i += 1
    steps = np.array(averages) / frame / mirror.static_gain
    taps = np.diff(steps, prepend=0.0)
    before = int(np.floor(delay_frames - 1))
    return np.concatenate([np.zeros(before), taps])


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
    brute = brute_taps(mirror, rate, delay, 7)
    np.testing.assert_allclose(taps[: brute.size], brute, atol=1e-10)


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
    try:
        mirror = lbt.models.PositionLoop.from_bandwidth(
            natural_frequency_hz=natural,
            damping=damping,
            bandwidth_hz=natural * ratio,
            bandwidth_damping=0.8,
            delay_samples=late,
            ramp_samples=ramp,
        )
    except lbt.errors.ProblemError as error:
        if "must be stable" not in str(error):
            raise
        return
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay, mirror=mirror)
    system = path.mirror_system
    taps = path.mirror_taps
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


def test_mirrors_that_do_not_fit_are_refused():
    quick = shell(sampling_hz=8e7)
    ringing = lbt.models.PositionLoop(
        natural_frequency_hz=10, damping=1e-5, proportional_per_s2=0, derivative_per_s=0
    )
    for rate, mirror, words in (
        (990, shell(), r"that fit are 986\.30137 and 1000 Hz"),
        (1e5, shell(), r"that fit are 72000 Hz"),
        (800, shell(ramp_samples=91), "ramp_samples must be at most 90"),
        (800, 0.7, "expected a PositionLoop"),
        (799, quick, r"at most 100000 samples .* Lower sampling_hz"),
        (1e-308, quick, "got inf"),
        (800, ringing, "must settle within 4000 frames"),
    ):
        with pytest.raises(lbt.errors.ProblemError, match=words):
            lbt.LoopHardware(frame_rate_hz=rate, mirror=mirror)
    lbt.LoopHardware(frame_rate_hz=8e2 * 10, mirror=quick)
    with pytest.raises(lbt.errors.ProblemError, match="must settle within"):
        ringing.step_response()
