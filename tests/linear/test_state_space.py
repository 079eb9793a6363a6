"""Frequency responses, the way to python-control and back, and systems with a period."""

import control
import numpy as np
import pytest
import scipy.signal
from support.periodic_problems import relative_distance
from support.refusals import require_refusals
from support.systems import random_system

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear import StateSpace
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.linear.state_space import balancing_scales, pointwise_response, stacked_response


def test_systems_of_python_control_and_scipy():
    A, B, C, D = random_system(7, 5, 2, 3, 0.9)
    system = StateSpace(A=A, B=B, C=C, D=D, dt_s=0.002)
    peer = system.to_control()
    back = StateSpace.of(peer)
    assert all(np.array_equal(getattr(back, name), getattr(system, name)) for name in "ABCD")
    f = np.linspace(0.0, 250, 40)
    expected = np.moveaxis(peer(np.exp(2j * np.pi * f * 0.002)), 2, 0)
    assert np.allclose(system.frequency_response(f), expected, rtol=1e-10)
    peers = [control.tf([1.0], [1.0, 0.5], dt_s) for dt_s in (0.1, True)]
    peers += [peer, scipy.signal.dlti([1.0], [1.0, 0.5], dt=0.2)]
    assert [StateSpace.of(x).dt_s for x in peers] == [0.1, 1.0, 0.002, 0.2]


def test_a_continuous_system_is_refused_with_the_map_that_keeps_its_norm():
    """The norm of s / (s + 1) is one; a zero-order hold of half a second makes it 1.24."""
    lead = control.tf([1.0, 0.0], [1.0, 1.0])
    for system in (lead, control.ss(lead), scipy.signal.lti([1.0, 0.0], [1.0, 1.0])):
        with pytest.raises(ProblemError, match=r'sample_system\(.*method="bilinear"\)'):
            StateSpace.of(system)
    for method, norm in (("bilinear", 1.0), ("zoh", 2 / (1 + np.exp(-0.5)))):
        sampled = control.sample_system(control.ss(lead), 0.5, method=method)
        assert float(lbt.hinf_norm(sampled)) == pytest.approx(norm, rel=1e-9)


@pytest.mark.parametrize("n", [2, 12])
def test_frequency_responses_of_defective_matrices(n):
    """A Jordan block at 0.9, turned at random: no basis of eigenvectors, a closed form."""
    turn = np.linalg.qr(np.random.default_rng(n).standard_normal((n, n)))[0]
    block = 0.9 * np.eye(n) + np.eye(n, k=1)
    system = StateSpace(A=turn @ block @ turn.T, B=turn[:, -1:], C=turn[:, :1].T, D=0, dt_s=1.0)
    frequency = np.linspace(0.1, 0.5, 5000)
    z = np.exp(2j * np.pi * frequency)
    response = system.frequency_response(frequency)[:, 0, 0]
    assert np.max(np.abs(response * (z - 0.9) ** n - 1)) < 1e-9


def test_states_of_very_different_sizes_are_balanced_without_a_warning():
    state, outside = balancing_scales(np.array([[0.5]]), np.array([1e60]), np.array([1e-60]))
    assert 0.1e60 < state / outside < 10e60


PATH = lbt.LoopHardware(frame_rate_hz=100, delay_frames=2, modes=2)


def random_stack(*, period=5, m=2, kind=StateSpace):
    A, B, C, D = random_system(0, 3, m, 2, 0.9, period)
    return kind(A=A, B=B, C=C, D=D, dt_s=0.01)


def steps(system, inputs):
    """Return the outputs for inputs (frames, m), from rest."""
    x, out = np.zeros(system.n_states), []
    for k, w in enumerate(inputs):
        t = k % system.period
        out.append(system.C[t] @ x + system.D[t] @ w)
        x = system.A[t] @ x + system.B[t] @ w
    return np.array(out)


@pytest.mark.parametrize("kind", ["lifted", "lifted_compactly"])
def test_lifted_systems_have_the_norm_and_the_variance(kind):
    system = random_stack()
    lifted = getattr(system, kind)()
    P = stationary_covariance(lifted.A, lifted.B @ lifted.B.T)
    outputs = np.diag(lifted.C @ P @ lifted.C.T + lifted.D @ lifted.D.T).reshape(5, 2)
    own = np.array([np.diag(one) for one in system.output_covariances()])
    np.testing.assert_allclose(outputs, own, rtol=1e-10)
    assert relative_distance(system.covariances()[0], P) < 1e-12
    # a long run as one matrix has almost the norm of an endless one
    stepped = np.array([steps(system, w.reshape(-1, 2)).ravel() for w in np.eye(160)]).T
    norm = float(lbt.hinf_norm(lifted))
    assert norm > np.linalg.norm(stepped, 2) == pytest.approx(norm, rel=5e-3)
    assert float(lbt.hinf_norm(system)) == pytest.approx(norm, rel=1e-9)
    assert lifted.dt_s == pytest.approx(0.05)
    assert random_stack(m=30).lifted_compactly().B.shape == (3, 13)


def test_the_frequency_response_is_what_a_sinusoid_leaves():
    system, frequency_hz = random_stack(), 7.3
    wave = np.exp(2j * np.pi * frequency_hz * 0.01 * np.arange(600))
    for column in range(2):
        left = steps(system, wave[:, None] * np.eye(2)[column])[-5:] / wave[-5:, None]
        response = system.phase_response([frequency_hz])[0, :, :, column]
        np.testing.assert_allclose(left, response, rtol=1e-9)


def test_a_controller_reads_its_new_state():
    controller = random_stack(kind=lbt.Controller)
    inputs = np.random.default_rng(3).standard_normal((7, 2))
    expected, run = steps(controller.to_statespace(), inputs), controller.start()
    for _ in range(2):
        np.testing.assert_allclose([run.step(y) for y in inputs], expected, atol=1e-12)
        run.reset()


def test_a_system_of_three_phases_in_words_and_numbers():
    system = StateSpace(A=[[[0.5]], [[3.0]], [[0.1]]], B=[[[1.0]]], C=1.0, D=0.0, dt_s=1.0)
    radii = system.spectral_radius, system.radius_per_frame
    assert radii == pytest.approx((0.15, 0.15 ** (1 / 3)))
    assert "3 states, 2 inputs, 2 outputs, 100 Hz, period 5" in repr(random_stack())
    given = lbt.Controller(A=0.5, B=1.0, C=1.0, D=0.0, applied=[[[0.1]], [[0.2]]])
    assert (given.period, given.A.shape) == (2, (2, 1, 1))
    assert given.applied.ravel().tolist() == [0.1, 0.2]


def test_a_period_of_one_sample_is_none():
    whole = random_stack(period=1)
    assert (whole.period, whole.A.shape, whole.lifted()) == (1, (3, 3), whole)
    given = lbt.Controller(A=[[[0.5]]], B=1.0, C=1.0, D=0.0, applied=[[[0.1]]])
    assert given.applied.shape == given.A.shape == (1, 1)
    frequency_hz = np.linspace(0, 50, 7)
    response = whole.phase_response(frequency_hz)[:, 0]
    np.testing.assert_allclose(response, whole.frequency_response(frequency_hz), rtol=1e-10)


def test_refusals():
    stack, law = random_stack(), random_stack(kind=lbt.Controller)
    one, empty = {name: [[1.0]] for name in "ABCD"}, np.zeros((0, 0))
    integrator, f = StateSpace(A=1.0, B=1.0, C=1.0, D=0.0, dt_s=0.1), np.linspace(0, 5, 50)
    circle = "pole at 0 Hz, on the unit circle"

    def system(**changes):
        return lambda: StateSpace(**(one | {k: np.ones(v) for k, v in changes.items()}))

    phases, clash = "A must be one matrix, or one for each", DimensionError
    response = r"of 1; got one of 5.*phase_response\(\.\.\.\)"
    lifted = r"of 5 samples\. Try lifted\(\)\."
    nothing = {"A": empty, "B": np.zeros((0, 1)), "C": np.zeros((1, 0)), "L": np.zeros((1, 0))}
    estimate = "without states has nothing to estimate"
    rows = [
        (lambda: StateSpace.of(3.0), ProblemError, "a system must be"),
        (lambda: integrator.frequency_response(f), ProblemError, circle),
        (lambda: integrator.frequency_response(f[:1]), ProblemError, circle),
        (lambda: stack.frequency_response(1.0), ProblemError, response),
        (stack.to_control, ProblemError, rf"{lifted}to_control\(\)"),
        (stack.balanced, ProblemError, rf"{lifted}balanced\(\)"),
        (lambda: lbt.close_loop(PATH, law), ProblemError, "of several sensors"),
        (system(A=(1, 2, 1)), clash, r"A must be square; got \(1, 2, 1\)"),
        (system(C=(1, 1, 2)), clash, "C must have 1 column to match A"),
        (system(A=(2, 1, 1), B=(3, 1, 1)), clash, r"one for each of 3 phases; got \(2"),
        (system(A=(1, 1, 1, 1)), clash, phases),
        (system(A=(0, 1, 1)), clash, phases),
        (lambda: lbt.EstimationProblem(**nothing, D=1.0), clash, estimate),
    ]
    require_refusals(rows)
    assert np.isfinite(integrator.frequency_response(f[1:])).all()


def test_a_system_without_states_is_a_system():
    """A static gain of python-control: it has a response, a norm and a loop of its own."""
    for static in (control.ss([], [], [], [[3.0, 4.0]], 0.1), control.tf([5.0], [1], 0.1)):
        gain = StateSpace.of(static)
        assert (gain.n_states, gain.spectral_radius) == (0, 0)
        assert np.array_equal(gain.frequency_response([0.0, 1.0]), np.stack([gain.D] * 2))
        assert lbt.hinf_norm(gain).value == pytest.approx(5, rel=1e-9)
        assert gain.output_covariances()[0, 0, 0] == 25
        assert "0 states" in repr(gain)
    parts = {"A": np.zeros((0, 0)), "B": np.zeros((0, 1)), "C": np.zeros((1, 0)), "D": 0.3}
    held = lbt.Controller(**parts, dt_s=1 / 800)
    loop = lbt.close_loop(lbt.LoopHardware(frame_rate_hz=800, modes=1), held)
    assert loop.is_stable
    assert lbt.loop_margins(loop).modulus == pytest.approx(0.7, rel=1e-6)


def test_partial_fractions_and_what_has_none(monkeypatch):
    rng, eig, solved = np.random.default_rng(8), np.linalg.eig, []
    A = rng.standard_normal((3, 4, 4)) / 3
    A[1] = np.eye(4, k=-1)  # a chain of delays: defective
    parts = A, rng.standard_normal((3, 4, 2)), rng.standard_normal((3, 1, 4)), np.ones((3, 1, 2))
    z, parts = np.exp(1j * np.linspace(0.01, 3, 50)), tuple(part[[2, 0, 1, 2]] for part in parts)
    monkeypatch.setattr(np.linalg, "eig", lambda A: solved.append(len(A)) or eig(A))
    stacked = stacked_response(parts)(z)
    assert solved == [3]  # equal ones are computed once
    for k in range(4):
        A, B, C, D = (part[k] for part in parts)
        pointwise = pointwise_response(StateSpace(A=A, B=B, C=C, D=D), z)
        assert stacked[:, k] == pytest.approx(pointwise, rel=1e-9, abs=1e-9)
