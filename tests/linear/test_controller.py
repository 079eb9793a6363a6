"""Controllers as estimators that are given the applied commands."""

import numpy as np
import pytest
from support.episodes import Episodes, frames_to_come_back
from support.exports import lbt_config, turn_states

import lbt_synth as lbt
from lbt_synth.linear import estimator_form

PATH = lbt.LoopHardware(frame_rate_hz=800)


def law(**changes):
    return lbt.integrator(PATH, gain=0.3, law=lbt.design.IntegratorLaw(**changes))


def shaped(delay):
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=delay)
    air = lbt.design.shaping.ResidualVariance(turbulence=slow, noise_nm=20.0)
    spec = lbt.design.shaping.Specification(terms=[air])
    return lbt.design.shape(path, spec, functions=8, states=None)


DESIGNS = {
    "kalman": lambda: lbt.kalman(lbt_config().plant),
    "hinf": lambda: lbt.hinf(lbt_config().plant, gamma_ratio=1.2, route="riccati"),
    "integrator": law,
    # coordinates that say nothing of the command
    "turned": lambda: turn_states(lbt.kalman(lbt_config().plant)),
    "leak": lambda: law(leak=0.98),
    "zero": lambda: law(zero_hz=20.0),
    "two": lambda: law(integrators=2, zero_hz=20.0),
    "fast": lambda: shaped(1),  # a command that acts on the next measurement
    "late": lambda: shaped(2.4),
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
        size = np.max(np.abs(u))
        assert np.allclose(last, u, rtol=0, atol=1e-10 * size)
        assert np.array_equal(alone, last)


@pytest.mark.parametrize("name", ["kalman", "hinf", "fast", "late"])
def test_an_estimator_does_not_see_whether_its_commands_are_applied(name):
    """Measurements of a loop whose mirror does anything: the estimate is that of another one."""
    design = DESIGNS[name]()
    hardware, form = design.hardware, estimator_form(design)
    rng = np.random.default_rng(1)
    total = np.cumsum(rng.standard_normal((60, hardware.modes)), axis=0)
    found = []
    for mirror in (0.0, 1.0):
        run, residual = form.start(), np.zeros(hardware.modes)
        past = np.zeros((len(hardware.mirror_taps), hardware.n_commands))
        for phase in total:
            u = run.step(hardware.sensor @ residual, past[0])
            past = np.vstack([mirror * rng.standard_normal(u.shape), past[:-1]])
            residual = phase - hardware.influence @ (hardware.mirror_taps @ past)
        found.append(u)
    assert np.allclose(*found, rtol=0, atol=1e-9 * np.max(np.abs(found)))


def test_what_is_left_of_a_conditioned_controller_are_its_zeros():
    form = estimator_form(law(zero_hz=20.0))
    assert form.spectral_radius == pytest.approx(np.exp(-2 * np.pi * 20 / 800), rel=1e-12)
    pure = estimator_form(law())
    assert not pure.A.any()
    assert np.array_equal(pure.applied, np.eye(2))  # u(k) = u_applied(k-1) + g y(k)
    both = lbt.LoopHardware(frame_rate_hz=800, modes=1, influence_matrix=[[0.5, 0.5]])
    leaky = lbt.integrator(both, gain=0.3, law=lbt.design.IntegratorLaw(leak=0.98))
    # two actuators of one mode: what no measurement sees leaks as before
    assert estimator_form(leaky).spectral_radius == pytest.approx(0.98, rel=1e-12)


def test_a_controller_without_such_a_form_is_refused():
    late = lbt.Controller(A=[[0, 0], [1, 1.0]], B=[[1], [0]], C=[[0, 1]], D=[[0]])
    with pytest.raises(lbt.errors.NumericalError, match="a pole of modulus 1, a zero"):
        estimator_form(late)
    # z (z - 2) / (z - 1)^2
    outside = lbt.Controller(A=[[2, -1], [1, 0]], B=[[1], [0]], C=[[1, -2.0]], D=[[0]])
    with pytest.raises(lbt.errors.NumericalError, match="a pole of modulus 2, a zero") as refused:
        estimator_form(outside)
    assert refused.value.residual == pytest.approx(2)
    with pytest.raises(lbt.errors.DimensionError, match="applied must have"):
        lbt.Controller(A=[[0.5]], B=[[1]], C=[[1]], D=[[0]], applied=np.ones((2, 1)))


def test_inputs_that_are_not_finite_leave_the_state():
    run, plain = estimator_form(law()).start(), law().controller.start()
    run.step([1.0, 2.0], [0.0, 0.0])
    plain.step([1.0, 2.0])
    states = run.state.copy(), plain.state.copy()
    for bad in (np.nan, np.inf, -np.inf):
        for step in (
            lambda b=bad: run.step([b, 0], [0, 0]),
            lambda b=bad: run.step([0, 0], [b, 0]),
            lambda b=bad: plain.step([0, b]),
        ):
            with pytest.raises(lbt.errors.NonFiniteError, match="Hold the last command"):
                step()
    assert np.array_equal(run.state, states[0])
    assert np.array_equal(plain.state, states[1])
    plain.reset()
    assert not plain.state.any()
    with pytest.raises(lbt.errors.DimensionError, match="applied must have shape"):
        run.step([1.0, 2.0], [0.0])


def test_a_mirror_that_stops_short_winds_up_the_plain_form_alone():
    config, design = lbt_config(), DESIGNS["kalman"]()
    known = {"hardware": config.hardware, "frames": 1200, "seed": 3, "settle_frames": 0}
    plain, given = (
        lbt.simulate(form, config.truth, **known, stroke=1200.0)
        for form in (design.controller, estimator_form(design))
    )
    assert np.max(np.abs(plain.commands)) == np.max(np.abs(given.commands)) == 1200
    assert plain.rms_nm[0] > 2 * given.rms_nm[0]


def back(name, count):
    """Parts of the episodes after which a loop is back in time, in both forms."""
    design = DESIGNS[name]()
    episodes = Episodes.draw(design, count, np.random.default_rng(1), (0.7, 1.0))
    return [
        np.mean(frames_to_come_back(design, episodes, given=given) <= 2 * episodes.settling)
        for given in (True, False)
    ]


def test_clipping_opening_and_holding_leave_nothing_behind():
    given, plain = back("kalman", 60)
    assert given == 1
    assert plain < 0.8


@pytest.mark.study
@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_nothing_is_left_behind_in_ten_thousand_episodes(name):
    assert back(name, 10_000)[0] == 1
