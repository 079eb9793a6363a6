"""The local position loop and its lifting: closed forms, brute force, python-control."""

from __future__ import annotations

import re

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from support.plants import ROOT, lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.models.lifted_mirror import lifted_mirror, settled_mirror

QUICK = {"natural_frequency_hz": 50, "damping": 0.5, "bandwidth_hz": 500}
SLOW = {"natural_frequency_hz": 20, "damping": 0.5, "bandwidth_hz": 70, "delay_samples": 2}


def shell(**changes):
    return lbt.models.PositionLoop.of_bandwidth(**{**QUICK, **changes})


def test_the_step_is_that_of_a_second_order_system_when_sampled_fast():
    w, z = 2 * np.pi * 500, 0.6
    mirror = shell(bandwidth_damping=z, sampling_hz=2e6, delay_samples=0)
    step = mirror.step_response()
    t, wd = step.time_s, w * np.sqrt(1 - z**2)
    exact = 1 - np.exp(-z * w * t) * (np.cos(wd * t) + z / np.sqrt(1 - z**2) * np.sin(wd * t))
    np.testing.assert_allclose(step.position, exact, atol=2e-3)
    assert step.overshoot == pytest.approx(np.exp(-np.pi * z / np.sqrt(1 - z**2)), rel=2e-2)
    enters = brentq(lambda s: np.interp(s, t, exact) - 0.9, 0, np.pi / wd)
    assert step.settling_s == pytest.approx(enters, rel=2e-3)
    quarter = (1 - 2 * z**2) + np.sqrt((1 - 2 * z**2) ** 2 + 1)
    assert mirror.bandwidth_hz == pytest.approx(500 * np.sqrt(quarter), rel=2e-3)


def test_the_lag_converges_with_the_sampling():
    """Sampled feedback differs from the continuous one by a term of first order in the sample."""
    t = np.linspace(0, 2e-3, 50)
    w, z = 2 * np.pi * 500, 0.7
    wd = w * np.sqrt(1 - z**2)
    exact = 1 - np.exp(-z * w * t) * (np.cos(wd * t) + z / np.sqrt(1 - z**2) * np.sin(wd * t))
    errors = []
    for rate in (2e5, 4e5, 8e5):
        step = shell(sampling_hz=rate, delay_samples=0).step_response()
        errors.append(np.max(np.abs(np.interp(t, step.time_s, step.position) - exact)))
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(2, rel=0.05)


@pytest.mark.parametrize("changes", [{}, {"ramp_samples": 37, "delay_samples": 0}, SLOW])
def test_a_step_response_in_blocks_is_that_sample_by_sample(changes):
    mirror = shell(**changes)
    loop, step = mirror.closed_loop(), mirror.step_response()
    state = np.zeros(loop.n_states)
    for i in range(300):
        assert step.position[8 * i] == pytest.approx(state[0], abs=1e-12)
        r = min(1.0, (i + 1) / mirror.ramp_samples)
        state = loop.A @ state + loop.B[:, 0] * r


@pytest.mark.parametrize("damping", [1.2, 3.0, 8.0])
def test_two_lags_without_feedback_have_taps_in_closed_form(damping):
    """A held force on an overdamped mode: steps of ``1 - (p2 e^-p1 t - p1 e^-p2 t)/(p2 - p1)``."""
    w, T = 2 * np.pi * 200, 1 / 800
    mirror = lbt.models.PositionLoop(
        natural_frequency_hz=200,
        damping=damping,
        proportional_per_s2=0,
        derivative_per_s=0,
        delay_samples=0,
    )
    p1, p2 = w * (damping - np.sqrt(damping**2 - 1)), w * (damping + np.sqrt(damping**2 - 1))

    def travelled(t):
        t = np.maximum(t, 0)
        slow, fast = (1 - np.exp(-p1 * t)) / p1, (1 - np.exp(-p2 * t)) / p2
        return t - (p2 * slow - p1 * fast) / (p2 - p1)

    for delay in (2.0, 2.3):
        taps = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay, mirror=mirror).mirror_taps
        edges = (np.arange(taps.size + 1) - (delay - 1)) * T
        exact = np.diff(np.diff(travelled(edges)) / T, prepend=0.0)
        np.testing.assert_allclose(taps, exact, atol=1e-12)


def test_the_motion_within_a_sample_is_that_of_python_control():
    mirror = lbt.models.PositionLoop(
        natural_frequency_hz=300,
        damping=0.2,
        proportional_per_s2=0,
        derivative_per_s=0,
        sampling_hz=9000,
        delay_samples=0,
    )
    w = 2 * np.pi * 300
    plant = control.tf([w**2], [1, 2 * 0.2 * w, w**2])
    peer = control.sample_system(plant, 1 / 9000, method="zoh")
    f = np.array([10.0, 100, 290, 1000, 4000])
    ours = mirror.closed_loop().frequency_response(f)[:, 0, 0]
    np.testing.assert_allclose(ours, peer(np.exp(2j * np.pi * f / 9000)), rtol=1e-9)


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
        (shell(), 3000.0, 2.0),
        (shell(feed_forward=0.3, delay_samples=3), 2400.0, 1.37),
        (shell(ramp_samples=11, natural_frequency_hz=300, damping=0.1), 3000.0, 2.6321),
        (shell(**SLOW), 4000.0, 2.5),
    ],
)
def test_the_lifted_mirror_is_the_brute_force_one(mirror, rate, delay):
    taps = lifted_mirror(mirror, rate, delay).taps
    brute = brute_taps(mirror, rate, delay, 7)
    np.testing.assert_allclose(taps[: brute.size], brute, atol=1e-10)


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
        mirror = lbt.models.PositionLoop.of_bandwidth(
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


def test_a_ramp_is_a_mean_of_steps():
    rate, n = 800.0, 18
    steps = [
        np.resize(lifted_mirror(shell(), rate, 2 + i / 90).taps, 12) * (np.arange(12) < 12)
        for i in range(n)
    ]
    ramp = lifted_mirror(shell(ramp_samples=n), rate, 2.0).taps
    np.testing.assert_allclose(ramp[:12], np.mean(steps, axis=0), atol=1e-12)


def test_a_quicker_mirror_tends_to_the_settled_one():
    for delay in (2.0, 2.25, 2.75):
        settled = settled_mirror(delay).taps
        errors = []
        for k in (1, 2, 4, 8):
            mirror = shell(bandwidth_hz=2000 * k, sampling_hz=72_000.0 * k)
            taps = lifted_mirror(mirror, 800.0, delay).taps
            padded = np.zeros(max(taps.size, settled.size))
            padded[: taps.size] += taps
            padded[: settled.size] -= settled
            errors.append(np.max(np.abs(padded)))
        # in proportion to the time the mirror takes
        assert errors[0] / errors[3] == pytest.approx(8, rel=0.02)


def test_a_loop_without_a_mirror_is_what_it_was():
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2.25)
    assert path.mirror is None
    assert path.mirror_taps.tolist() == [0.0, 0.75, 0.25]
    assert settled_mirror(1.0).whole.n_states == 0


@pytest.mark.parametrize("delay", [1.0, 1.4, 2.0, 2.5])
@pytest.mark.parametrize("feedthrough", [False, True])
def test_the_loop_with_a_moving_mirror_is_affine_in_the_filter(delay, feedthrough):
    rng = np.random.default_rng(3)
    influence = np.array([[1.0, 0.1], [-0.2, 0.9]])
    path = lbt.LoopHardware(
        frame_rate_hz=800, delay_frames=delay, influence_matrix=influence, mirror=shell(**SLOW)
    )
    parameter = lbt.Controller(
        A=np.diag([0.9, 0.4, -0.5]),
        B=rng.normal(size=(3, 2)),
        C=rng.normal(size=(2, 3)),
        D=rng.normal(size=(2, 2)) * feedthrough,
        dt_s=1 / 800,
    )
    loop = lbt.close_loop(path, lbt.loop.youla_controller(path, parameter))
    assert loop.is_stable
    f = np.array([0.0, 3.0, 20.0, 150.0, 400.0])
    z = np.exp(2j * np.pi * f / 800)[:, None, None]
    Q = parameter.to_statespace().frequency_response(f)
    M = sum(tap * influence * z**-i for i, tap in enumerate(path.mirror_taps))
    np.testing.assert_allclose(loop.sensitivity(f), np.eye(2) - M @ Q / z, atol=1e-10)
    np.testing.assert_allclose(loop.noise_transfer(f), -M @ Q, atol=1e-10)


def test_simulation_by_taps_is_that_of_the_states():
    plant = lbt_axis_plant(modes=1)
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1, mirror=shell(**SLOW))
    slow = lbt.integrator(path, gain=0.1)
    truth = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    same = {"hardware": path, "frames": 400, "seed": 3, "settle_frames": 100}
    by_states = lbt.simulate(slow.controller, truth, **same)
    by_taps = lbt.simulate(slow.controller.start(), truth, **same)
    np.testing.assert_allclose(by_states.residual_nm, by_taps.residual_nm, atol=1e-9)


@pytest.mark.parametrize("frames", [0.5, 1.25])
def test_any_delay_of_a_moving_mirror_is_exact(frames):
    """A delay error is a delay of the same mirror, not an interpolation of its taps."""
    from dataclasses import replace

    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2.0, mirror=shell())
    moved = replace(path, delay_frames=2.0 + frames)
    np.testing.assert_array_equal(
        moved.mirror_taps, lifted_mirror(shell(), 800.0, 2.0 + frames).taps
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bandwidth_hz": 30}, "bandwidth_hz must be at least 50"),
        ({"natural_frequency_hz": 0}, "natural_frequency_hz must be above 0"),
        ({"damping": -0.1}, "damping must be at least 0"),
        ({"bandwidth_hz": 5000, "delay_samples": 6}, "local loop of the mirror must be stable"),
        ({"delay_samples": 0.5}, "delay_samples must be an integer"),
        ({"delay_samples": 1000}, "delay_samples must be at most 64"),
        ({"ramp_samples": 0}, "ramp_samples must be at least 1"),
        ({"sampling_hz": 80.0}, "natural_frequency_hz must lie below half"),
        ({"feed_forward": 11}, "feed_forward must be at most 10"),
        ({"damping": 20.0}, "bandwidth_damping must be at least"),
    ],
)
def test_impossible_local_loops_are_refused(changes, message):
    with pytest.raises(lbt.errors.ProblemError, match=message):
        shell(**changes)


def test_a_mirror_without_any_force_is_refused():
    with pytest.raises(lbt.errors.ProblemError, match="must follow its command"):
        lbt.models.PositionLoop(
            natural_frequency_hz=10,
            damping=1,
            proportional_per_s2=0,
            derivative_per_s=0,
            feed_forward=0,
        )


def test_rates_that_do_not_fit_are_refused():
    with pytest.raises(lbt.errors.ProblemError, match=r"that fit are 986\.30137 and 1000 Hz"):
        lbt.LoopHardware(frame_rate_hz=990, mirror=shell())
    with pytest.raises(lbt.errors.ProblemError, match=r"that fit are 72000 Hz"):
        lbt.LoopHardware(frame_rate_hz=1e5, mirror=shell())
    with pytest.raises(lbt.errors.ProblemError, match="ramp_samples must be at most 90"):
        lbt.LoopHardware(frame_rate_hz=800, mirror=shell(ramp_samples=91))
    with pytest.raises(lbt.errors.ProblemError, match="expected a PositionLoop"):
        lbt.LoopHardware(frame_rate_hz=800, mirror=0.7)


def test_a_local_loop_has_so_many_samples_a_frame():
    quick = shell(sampling_hz=8e7)
    lbt.LoopHardware(frame_rate_hz=8e2 * 10, mirror=quick)
    with pytest.raises(
        lbt.errors.ProblemError, match=r"at most 100000 samples .* Lower sampling_hz to"
    ):
        lbt.LoopHardware(frame_rate_hz=799, mirror=quick)
    with pytest.raises(lbt.errors.ProblemError, match="= inf"):
        lbt.LoopHardware(frame_rate_hz=1e-308, mirror=quick)


def test_the_page_says_where_the_settled_design_becomes_unstable(config):
    """Stable at the figure of docs/mirror.md, unstable a tenth of a hertz below."""
    text = (ROOT / "docs" / "mirror.md").read_text(encoding="utf-8")
    edge = float(re.search(r"stable down to ([\d.]+) Hz", text)[1])
    settled = lbt.kalman(config.plant)
    for bandwidth, stable in ((edge, True), (edge - 0.1, False)):
        mirror = shell(natural_frequency_hz=20, damping=0.5, bandwidth_hz=bandwidth)
        path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2, mirror=mirror)
        assert lbt.close_loop(path, settled.controller).is_stable is stable


def test_a_mirror_that_rings_for_ever_is_refused():
    ringing = lbt.models.PositionLoop(
        natural_frequency_hz=10, damping=1e-5, proportional_per_s2=0, derivative_per_s=0
    )
    with pytest.raises(lbt.errors.ProblemError, match="must settle within 4000 frames"):
        lbt.LoopHardware(frame_rate_hz=800, mirror=ringing)
    with pytest.raises(lbt.errors.ProblemError, match="must settle within"):
        ringing.step_response()


def test_a_tolerance_out_of_range_is_refused():
    with pytest.raises(lbt.errors.ProblemError, match="tolerance must be below 1"):
        shell().step_response(1.0)
