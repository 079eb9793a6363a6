"""Ranges of gains and delays: against radii, closed forms and common Lyapunov functions."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.lqg import shell
from support.plants import lbt_axis_plant
from support.refusals import require_refusals
from support.sensor_loops import example_plant
from support.systems import random_system

import lbt_synth as lbt
from lbt_synth.loop import stable_range as ranges
from lbt_synth.loop.stable_range import affine_radii, circle_norm, loop_changes, moving_gain


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 8))
def test_ends_of_a_change_of_rank_one_are_where_poles_cross(seed, n):
    rng = np.random.default_rng(seed)
    A, b, c = rng.standard_normal((n, n)), rng.standard_normal((n, 1)), rng.standard_normal((1, n))
    nominal = rng.uniform(0.1, 3)
    loop = rng.uniform(0.5, 0.999) / max(abs(np.linalg.eigvals(A))) * A
    parts = ranges.affine_parts((loop - nominal * b @ c)[None], (b @ c)[None])
    low, high = ranges.stable_range(parts, nominal)
    assert low < nominal < high
    inside = np.linspace(max(low, nominal / 50), min(high, nominal * 50), 3000)[1:-1]
    assert np.all(affine_radii(parts, inside) < 1 + 1e-9)
    for end in (low, high):
        if 0 < end < np.inf:
            assert affine_radii(parts, np.array([end]))[0] == pytest.approx(1, abs=1e-8)


@pytest.mark.parametrize(
    ("low", "high", "nominal"),
    [(0.35, 1.9, 1.0), (0.0, 1.2, 1.0), (0.97, np.inf, 1.0), (0.4, 5.0, 2.0)],
)
def test_ends_of_a_stepped_range(low, high, nominal):
    ends = ranges.stepped_range(lambda g: np.where((low < g) & (g < high), 0.5, 1.5), nominal)
    assert ends == pytest.approx((low, high), rel=1e-11)


def test_narrow_holes_and_poles_beside_the_circle_end_a_range():
    ends = ranges.stepped_range(lambda g: np.where((g > 1.3) & (g < 1.32), 1.5, 0.5))
    assert ends == pytest.approx((0.0, 1.3), rel=1e-11)
    for width in (1e-2, 1e-8):  # poles of z^2 - g z + (1 - width)^2 pass 1
        A = (1 - width) * np.array([[0.0, 1.0], [-1.0, 0.0]])
        parts = ranges.affine_parts(A[None], np.diag([0.0, 1.0])[None])
        assert ranges.stable_range(parts, 1e-3)[1] == pytest.approx(1 + (1 - width) ** 2, rel=1e-9)


def test_radii_of_many_gains_are_those_of_their_loops():
    plant = example_plant(influence_matrix=[[2.0, 0.1], [0.3, 1.0]])
    controller, gains = lbt.kalman(plant).controller, np.array([0.2, 1.0, 1.7])
    loops = [lbt.close_loop(plant.hardware, controller, sensor_gain=gain) for gain in gains]
    radii = affine_radii(ranges.parts_by_gain(plant.hardware, controller), gains)
    np.testing.assert_allclose(radii, [loop.spectral_radius for loop in loops], rtol=1e-9)


@pytest.mark.parametrize("method", ["kalman", "integrator"])
def test_modes_that_mix_have_the_range_of_those_that_do_not(method, lbt_designs):
    """A turned sensor and a mirror that turns back: the same loop, followed in steps."""
    turn, k = np.array([[0.8, -0.6], [0.6, 0.8]]), lbt_designs[method].controller
    mixed = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=turn, influence_matrix=turn.T)
    turned = lbt.Controller(A=k.A, B=k.B @ turn.T, C=turn @ k.C, D=turn @ k.D @ turn.T, dt_s=k.dt_s)
    exact = lbt.loop.stable_sensor_gains(lbt.LoopHardware(frame_rate_hz=800), k)
    assert lbt.loop.stable_sensor_gains(mixed, turned) == pytest.approx(exact, rel=1e-6)


def one_pole(pole, gain=0.5, *, delay_frames=1):
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay_frames, modes=1)
    return path, lbt.Controller(A=pole, B=gain, C=1.0, D=0.0, dt_s=1 / 800)


def integrator_loop(delay_frames, gain=0.5):
    return lbt.close_loop(*one_pole(1.0, gain, delay_frames=delay_frames))


@pytest.mark.parametrize("low", [1e-3, 3.0])
def test_one_state_is_proved_exactly_where_each_constant_gain_is_stable(low):
    """``|1 - g / 2| < 1`` at both ends is necessary and sufficient: gains up to 4."""
    loop = integrator_loop(1)
    assert circle_norm(loop, low=low, high=4 - 1e-5) < ranges.CIRCLE_LIMIT
    assert circle_norm(loop, low=low, high=4 + 1e-5) > 1
    assert circle_norm(integrator_loop(2), low=0.5, high=4.5) == np.inf


@pytest.mark.parametrize(("low", "high"), [(0.1, 1.5), (0.8, 0.9), (0.8, 1.35)])
def test_an_integrator_of_two_frames_against_its_closed_form(low, high):
    """``T = a / (z^2 - z + a)`` is largest where ``cos = (1 + a) / (4 a)``, or at frequency 0."""
    a, r = 0.5 * (low + high) / 2, (high - low) / (high + low)
    cosine = min((1 + a) / (4 * a), 1.0)
    least = 4 * a * cosine**2 - 2 * (1 + a) * cosine + 1 + (1 - a) ** 2
    expected = r * a / np.sqrt(least)
    assert circle_norm(integrator_loop(2), low=low, high=high) == pytest.approx(expected, rel=1e-9)


def test_the_moving_gain_lies_in_the_constant_one_and_axes_count_one_by_one():
    plants = lbt_axis_plant(modes=2), lbt_axis_plant()
    moving, alone = (moving_gain(lbt.close_loop(p.hardware, lbt.kalman(p))) for p in plants)
    assert moving.constant_low < moving.moving_low < 1 < moving.moving_high < moving.constant_high
    ends, expected = ((x.moving_low, x.moving_high) for x in (moving, alone))
    assert ends == pytest.approx(expected, rel=1e-4)
    idle = moving_gain(lbt.close_loop(*one_pole(0.5, 0.0)))  # the gain does not touch it
    assert (idle.moving_low, idle.moving_high, idle.constant_high) == (0.01, 100.0, np.inf)


def test_intervals_are_of_the_sensor_gain_whatever_the_loop_has():
    plant = lbt_axis_plant()
    controller = lbt.kalman(plant).controller
    low, high = lbt.loop.stable_sensor_gains(plant.hardware, controller)
    moving = moving_gain(lbt.close_loop(plant.hardware, controller, sensor_gain=0.5))
    assert moving.moving_low < 0.5 < moving.moving_high < moving.constant_high
    assert (moving.constant_low, moving.constant_high) == pytest.approx((low, high))
    inside = [*np.geomspace(low * 1.0001, high * 0.9999, 9), low * 0.999, high * 1.001]
    loops = [lbt.close_loop(plant.hardware, controller, sensor_gain=gain) for gain in inside]
    assert [loop.is_stable for loop in loops] == [True] * 9 + [False] * 2


def strokes(hardware, controller, **gain):
    """Ratios of the plain form and of the estimator form."""
    forms = controller, lbt.linear.estimator_form(controller)
    return [lbt.loop.stroke_ratio(hardware, form, **gain) for form in forms]


@pytest.mark.parametrize(
    ("pole", "gain"),
    [(1.01, 0.5), (1.1, 0.5), (1.3, 1.2), (1.6, 0.9), (1.0, 0.5), (1.0, 1.9), (0.9, 0.5)],
)
def test_one_state_is_proved_exactly_where_no_clip_sets_it_free(pole, gain):
    """``|p - g d| < 1`` at ``d = 1 / ratio``; given what was applied, ``(p - g)^k`` decays."""
    plain, estimator = strokes(*one_pole(pole, gain))
    expected = gain / (pole - 1) if pole > 1 else 1e4
    assert plain == pytest.approx(expected, rel=2e-6 * expected if pole > 1 else 0)
    assert estimator == 1e4


def clip_peak(hardware, controller, sensor_gain):
    """Largest ``T_w`` of both forms on a grid, by ``T_w = P / (1 + P)`` of the broken loop."""
    f = np.linspace(0.01, hardware.frame_rate_hz / 2 - 0.01, 4001)
    z = np.exp(2j * np.pi * f * hardware.dt_s)[:, None, None]
    delay = sum(tap * z ** -(1.0 + i) for i, tap in enumerate(hardware.mirror_taps))
    seen = sensor_gain * delay * (hardware.sensor @ hardware.influence)
    form, peaks = lbt.linear.estimator_form(controller), []
    for A, L in ((controller.A, 0 * form.applied), (form.A, form.applied)):
        P = form.C @ (z * np.linalg.inv(z * np.eye(len(A)) - A)) @ (form.B @ seen - L / z)
        T = np.linalg.solve(np.eye(P.shape[1]) + P, P)
        peaks.append(np.linalg.eigvalsh(T + T.conj().swapaxes(1, 2)).max() / 2)
    return peaks


@pytest.mark.parametrize("delay", [1.0, 2.0, 2.4, 3.0])
@pytest.mark.parametrize("influence", [np.eye(2), [[1.0, 0.3], [-0.2, 0.8]]])
@pytest.mark.parametrize("mirror", [None, shell()])
def test_what_a_clip_sees_is_the_loop_broken_at_the_command(delay, influence, mirror):
    facts = {"delay_frames": delay, "influence_matrix": influence, "mirror": mirror}
    hardware = lbt.LoopHardware(frame_rate_hz=800, **facts)
    A, B, none = np.diag([1.05, 1.0]), np.diag([0.35, 0.25]), np.zeros((2, 2))
    law = lbt.Controller(A=A, B=B, C=np.linalg.inv(influence), D=none, dt_s=1 / 800)
    for gain in (0.6, 1.4) if mirror is None else (0.3, 0.5):
        peaks = np.array(clip_peak(hardware, law, gain))
        expected = np.where(peaks > 1 + 1e-4, peaks / (peaks - 1), 1e4)
        assert strokes(hardware, law, sensor_gain=gain) == pytest.approx(expected, rel=1e-3)


def clipped_runs(design, kicks, *, estimator, frames=3000):
    """Return the largest request and the residuals of loops of two frames, one a column of kicks.

    The last loop runs in the simulation, too.
    """
    form = lbt.linear.estimator_form(design) if estimator else design.controller
    phase = np.pad(kicks, ((0, frames - len(kicks)), (0, 0)))
    run, asked = form.start(), np.zeros(kicks.shape[1])
    applied, residuals = np.zeros((2, frames + 1, kicks.shape[1]))
    for k in range(frames):
        u = run.step(residuals[k][None], applied[k][None])
        residuals[k + 1] = phase[k] - applied[k]  # the command of the frame before
        applied[k + 1] = np.clip(u[0], -1, 1)
        asked = np.maximum(asked, np.abs(u[0]))
    met = lbt.loop.Disturbance(phase_nm=phase[:, -1:])
    simulated = lbt.simulate(form, met, hardware=design.hardware, stroke=1.0)
    assert simulated.commands[0, :, 0] == pytest.approx(applied[1:, -1], abs=1e-9)
    return asked, np.abs(residuals[-1])


def test_loops_that_ask_for_less_than_is_proved_come_back_and_some_beyond_do_not():
    plant = lbt_axis_plant()
    design, rng = lbt.kalman(plant), np.random.default_rng(0)
    plain, estimator = strokes(plant.hardware, design)
    low, _ = lbt.loop.stable_sensor_gains(plant.hardware, design)
    assert 1 < plain < 1 / low
    kicks = rng.standard_normal((60, 2000)) * np.geomspace(0.1, 60, 2000)
    asked, last = clipped_runs(design, kicks, estimator=False)
    clipped = (asked > 1.5) & (asked < plain)
    assert np.count_nonzero(clipped) > 100
    assert last[asked < plain].max() < 1e-6
    assert np.count_nonzero(last > 0.9) > 10  # the residual is the stroke
    assert estimator == 1e4
    asked, last = clipped_runs(design, kicks, estimator=True)
    assert asked.max() > 5 * plain
    assert last.max() < 1e-6


def test_refusals():
    plant, unstable = example_plant(), lbt.errors.UnstableLoopError
    strong, ratio = one_pole(1.0, 1.5, delay_frames=2), lbt.loop.stroke_ratio
    several = partial(ratio, plant.hardware, lbt.kalman(plant))
    rows = [
        (lambda: moving_gain(lbt.close_loop(*strong)), unstable, "unstable"),
        (lambda: ratio(*strong), unstable, "unstable"),
        (several, lbt.errors.ProblemError, "several sensors"),
    ]
    require_refusals(rows)


def is_stable(hardware, controller, gain, delay):
    path = replace(hardware, delay_frames=delay)
    return lbt.close_loop(path, controller, sensor_gain=gain).is_stable


LOOPS = {
    "kalman": lambda: lbt.kalman(lbt_axis_plant()),
    "kalman at a fraction": lambda: lbt.kalman(lbt_axis_plant(delay_frames=2.49)),
    "two axes": lambda: lbt.hinf(
        example_plant((), delay_frames=2.3, sensor_matrix=[[0.9, 0.2], [-0.1, 1.1]]),
        gamma_ratio=1.2,
    ),
    "integrator": lambda: lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=0.8),
}


@pytest.mark.parametrize("name", LOOPS)
def test_every_loop_within_the_errors_is_stable(name):
    design = LOOPS[name]()
    path = design.hardware
    scale = ranges.errors_together(lbt.close_loop(path, design))
    assert scale > 0.1
    late, factor = scale * ranges.FRAGILE_FRAMES, 10 ** (scale * ranges.FRAGILE_DB / 20)
    signs = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    for a, b in [*signs, *np.random.default_rng(0).uniform(-1, 1, (12, 2)).tolist()]:
        delay = max(path.delay_frames + a * late, 1.0)
        assert is_stable(path, design.controller, factor**b, delay), (a, b)
    # beyond, the proof is not far from the truth
    wide = [(factor ** (2.5 * b), path.delay_frames + 2.5 * a * late) for a, b in signs]
    assert not all(is_stable(path, design.controller, *pair) for pair in wide if pair[1] >= 1)


def test_a_gain_alone_has_the_exact_interval():
    """Of an integrator without an error of the delay: 1 / 0.8 at two frames."""
    path, law = one_pole(1.0, 0.8, delay_frames=2)
    low, high = lbt.loop.stable_sensor_gains(path, law)
    assert (low, high) == (0.0, pytest.approx(1.25, rel=1e-6))
    ((gain, delay, taps),) = loop_changes(path, low=1.0, high=high * 0.999, delay_frames=0.0)
    assert (gain, delay) == (high * 0.999, 2.0)
    np.testing.assert_allclose(taps, [0, 0, 1 - high * 0.999])


def test_loops_that_stand_for_all_are_the_corners_and_whole_delays():
    late, short = (lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=d) for d in (2.9, 1))
    changes = loop_changes(late, low=0.5, high=1.5, delay_frames=0.3)
    corners = {(gain, delay) for gain in (0.5, 1.5) for delay in (2.6, 3.0, 3.2)}
    assert {(gain, round(delay, 9)) for gain, delay, _ in changes} == corners
    assert not loop_changes(late, low=1.0, high=1.0, delay_frames=0.0)
    delays = {delay for _, delay, _ in loop_changes(short, low=1, high=1, delay_frames=0.5)}
    assert delays == {1.5}  # none is below one frame
    moving = replace(late, mirror=shell(100, delay_samples=2))
    loop = lbt.close_loop(moving, lbt.integrator(moving, gain=0.05))
    assert np.isnan(ranges.errors_together(loop))


def test_taps_behind_several_outputs():
    A, *rest = random_system(1, 3, 2, 2, 0.5)
    system = lbt.linear.StateSpace(A=A, **dict(zip("BCD", rest, strict=True)), dt_s=1 / 800)
    taps, f = np.array([0.0, 0.5, -0.2]), np.array([3.0, 77.0, 390.0])
    turn = np.exp(-2j * np.pi * f / 800)
    expected = (turn[:, None] ** np.arange(3) @ taps)[:, None, None] * system.frequency_response(f)
    np.testing.assert_allclose(ranges.append_taps(system, taps).frequency_response(f), expected)
