"""Controllers as estimators that are given the applied commands."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.exports import lbt_config, turn_states
from support.refusals import refused, require_refusals
from support.shaping import ONE, shaped

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, NonFiniteError, NumericalError, ProblemError
from lbt_synth.linear import estimator_form
from lbt_synth.loop.simulation import settling_frames
from lbt_synth.loop.stable_range import affine_radii, parts_by_gain

PATH = lbt.LoopHardware(frame_rate_hz=800)


def law(path=PATH, **changes):
    return lbt.integrator(path, gain=0.3, law=lbt.design.IntegratorLaw(**changes))


DESIGNS = {
    "kalman": lambda: lbt.kalman(lbt_config().plant),
    "hinf": lambda: lbt.hinf(lbt_config().plant, gamma_ratio=1.2, route="riccati"),
    "integrator": law,
    # coordinates that say nothing of the command
    "turned": lambda: turn_states(lbt.kalman(lbt_config().plant)),
    "leak": lambda: law(leak=0.98),
    "zero": lambda: law(zero_hz=20.0),
    "two": lambda: law(integrators=2, zero_hz=20.0),
    # a command that acts on the next measurement
    "fast": lambda: shaped(path=replace(ONE, delay_frames=1), functions=8),
    "late": lambda: shaped(path=replace(ONE, delay_frames=2.4), functions=8),
}


@pytest.mark.parametrize("name", DESIGNS)
def test_it_is_the_same_controller_where_its_commands_are_applied(name):
    controller = DESIGNS[name]().controller
    form = estimator_form(controller)
    assert form.spectral_radius < 1
    plain, given, own = controller.start(), form.start(), form.start()
    last = np.zeros(len(controller.C))
    for y in np.random.default_rng(0).standard_normal((30, controller.B.shape[1])):
        u, last, alone = plain.step(y), given.step(y, last), own.step(y)
        assert np.allclose(last, u, rtol=0, atol=1e-10 * np.max(np.abs(u)))
        assert np.array_equal(alone, last)


@pytest.mark.parametrize("name", ["kalman", "hinf", "fast", "late"])
def test_an_estimator_does_not_see_whether_its_commands_are_applied(name):
    """Measurements of a loop whose mirror does anything: the estimate is that of another one."""
    design, rng = DESIGNS[name](), np.random.default_rng(1)
    hardware, form, last = design.hardware, estimator_form(design), []
    total = np.cumsum(rng.standard_normal((60, hardware.modes)), axis=0)
    for mirror in (0.0, 1.0):
        run, residual = form.start(), np.zeros(hardware.modes)
        past = np.zeros((len(hardware.mirror_taps), hardware.n_commands))
        for phase in total:
            u = run.step(hardware.sensor @ residual, past[0])
            past = np.vstack([mirror * rng.standard_normal(u.shape), past[:-1]])
            residual = phase - hardware.influence @ (hardware.mirror_taps @ past)
        last.append(u)
    assert np.allclose(*last, rtol=0, atol=1e-9 * np.max(np.abs(last)))


def test_what_is_left_of_a_conditioned_controller_are_its_zeros():
    form, pure = estimator_form(law(zero_hz=20.0)), estimator_form(law())
    assert form.spectral_radius == pytest.approx(np.exp(-2 * np.pi * 20 / 800), rel=1e-12)
    assert not pure.A.any()
    assert np.array_equal(pure.applied, np.eye(2))  # u(k) = u_applied(k-1) + g y(k)
    # two actuators of one mode: what no measurement sees leaks as before
    both = lbt.LoopHardware(frame_rate_hz=800, modes=1, influence_matrix=[[0.5, 0.5]])
    assert estimator_form(law(both, leak=0.98)).spectral_radius == pytest.approx(0.98, rel=1e-12)


def test_refusals():
    late = lbt.Controller(A=[[0, 0], [1, 1.0]], B=[[1], [0]], C=[[0, 1]], D=0)
    # z (z - 2) / (z - 1)^2
    outside = lbt.Controller(A=[[2, -1], [1, 0]], B=[[1], [0]], C=[[1, -2.0]], D=0)
    parts, run = {"A": 0.5, "B": 1, "C": 1, "D": 0}, estimator_form(law()).start()
    rows = [
        (lambda: estimator_form(late), NumericalError, "a pole of modulus 1, a zero"),
        (lambda: estimator_form(outside), NumericalError, "a pole of modulus 2, a zero"),
        (lambda: lbt.Controller(**parts, applied=np.ones((2, 1))), DimensionError, "applied must"),
        (lambda: run.step([1, 2], [0]), DimensionError, "applied must have shape"),
        (lambda: run.step([1, 2j]), ProblemError, "y must be real; got complex"),
        (lambda: run.step("a"), ProblemError, "y must be an array of numbers; got str"),
    ]
    require_refusals(rows)
    assert refused(*rows[1]).residual == pytest.approx(2)


def test_inputs_that_are_not_finite_leave_the_state():
    run, plain = estimator_form(law()).start(), law().controller.start()
    run.step([1.0, 2.0], [0.0, 0.0])
    plain.step([1.0, 2.0])
    states = run.state.copy(), plain.state.copy()
    for bad in (np.nan, np.inf, -np.inf):
        for step, *inputs in (
            (run.step, [bad, 0], [0, 0]),
            (run.step, [0, 0], [bad, 0]),
            (plain.step, [0, bad]),
        ):
            refused(partial(step, *inputs), NonFiniteError, "Hold the last command")
    assert np.array_equal(states, (run.state, plain.state))
    plain.reset()
    assert not plain.state.any()


QUIET, LONGEST = 200, 400  # frames before an episode, and of one at most
TURBULENCE_NM, POLE, LINE_NM, LINE_HZ, NOISE_NM = 592.0, 0.9886, 797.0, 20.0, 15.5


def disturbances(count, frames, dt_s):
    """Frames of turbulence, a vibration of the first axis and noise, (count, 2) each."""
    rng = np.random.default_rng(0)
    air = TURBULENCE_NM * rng.standard_normal((count, 2))
    phase = rng.uniform(0, 2 * np.pi, count)
    for k in range(frames):
        line = LINE_NM * np.sqrt(2) * np.sin(2 * np.pi * LINE_HZ * dt_s * k + phase)
        yield air + line[:, None] * [1, 0], NOISE_NM * rng.standard_normal((count, 2))
        kick = TURBULENCE_NM * np.sqrt(1 - POLE**2) * rng.standard_normal((count, 2))
        air = POLE * air + kick


class Run:
    """Many loops of two frames' delay around one controller, in either form."""

    def __init__(self, design, gains, *, given):
        k, form = design.controller, estimator_form(design)
        assert design.hardware.delay_frames == 2
        assert not k.D.any()
        rows = [form.A, form.B, form.applied] if given else [k.A, k.B, 0 * form.applied]
        self.step_matrix, self.C, self.gains = np.hstack(rows).T, k.C.T, gains[:, None]
        self.state = np.zeros((len(gains), k.n_states))
        self.applied, self.residual = np.zeros((2, len(gains), 2))

    def request(self, total, noise):
        """Step all loops, and return the commands that they compute."""
        y = self.gains * self.residual + noise
        self.state = np.hstack([self.state, y, self.applied]) @ self.step_matrix
        self.residual = total - self.applied  # the command of the frame before
        return self.state @ self.C


def back(name, count):
    """Parts of the episodes after which a loop is back in time, in both forms.

    For some frames its commands are clipped, not applied or held. It is back where its residual
    stays within 1 % of the undisturbed one after twice the frames in which it settles to 1e-4.
    """
    design, rng = DESIGNS[name](), np.random.default_rng(1)
    gains = np.sort(rng.uniform(0.7, 1.0, count))
    radii = affine_radii(parts_by_gain(design.hardware, design.controller), gains)
    settling = np.array([settling_frames(radius) for radius in radii])
    kinds, ends = rng.integers(3, size=(count, 1)), QUIET + rng.integers(1, LONGEST, size=count)
    depth = rng.uniform(0, 0.7, size=(count, 1))  # of clipping, as a part of the largest command
    free, *runs = (Run(design, gains, given=given) for given in (True, True, False))
    largest, power, away = np.zeros((count, 1)), np.zeros(count), np.zeros((2, count))
    frames = QUIET + LONGEST + 3 * int(np.max(settling))
    with np.errstate(all="ignore"):  # the plain form may grow beyond all numbers
        for k, series in enumerate(disturbances(count, frames, design.hardware.dt_s)):
            limit = 1.2 * np.maximum(largest, 3 * (TURBULENCE_NM + LINE_NM))
            low = np.where(kinds == 0, depth * largest, 0.0)
            inside = ((k >= QUIET) & (k < ends))[:, None]
            free.applied = free.request(*series)
            if k < QUIET:
                largest = np.maximum(largest, np.max(np.abs(free.applied), axis=1, keepdims=True))
            power += np.mean(free.residual**2, axis=1)
            for i, run in enumerate(runs):
                u = run.request(*series)
                stopped = np.where(kinds == 2, run.applied, np.clip(u, -low, low))
                run.applied = np.where(inside, stopped, np.clip(u, -limit, limit))
                apart = np.max(np.abs(run.residual - free.residual), axis=1)
                far = ~(apart <= 0.01 * np.sqrt(power / (k + 1)))
                away[i] = np.where(far & (k >= ends), k + 1 - ends, away[i])
    return np.mean(away <= 2 * settling, axis=1)


def test_clipping_opening_and_holding_leave_nothing_behind():
    given, plain = back("kalman", 60)
    assert given == 1
    assert plain < 0.8


@pytest.mark.study
@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_nothing_is_left_behind_in_ten_thousand_episodes(name):
    assert back(name, 10_000)[0] == 1
