"""Periodic systems, stepped sample by sample."""

import numpy as np
import pytest
from support.periodic_problems import relative_distance

import lbt_synth as lbt
from lbt_synth.errors import DimensionError
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.linear.periodic.system import PeriodicController, PeriodicSystem


def random_system(seed=0, *, period=5, n=3, m=2, p=2, kind=PeriodicSystem):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((period, n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    rest = [rng.standard_normal((period, *size)) for size in ((n, m), (p, n), (p, m))]
    return kind(A=A, B=rest[0], C=rest[1], D=rest[2], dt_s=0.01)


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
    system = random_system()
    lifted = getattr(system, kind)()
    P = stationary_covariance(lifted.A, lifted.B @ lifted.B.T)
    outputs = np.diag(lifted.C @ P @ lifted.C.T + lifted.D @ lifted.D.T).reshape(5, 2)
    own = np.array([np.diag(one) for one in system.output_covariances()])
    np.testing.assert_allclose(outputs, own, rtol=1e-10)
    # a long run as one matrix has almost the norm of an endless one
    stepped = np.array([steps(system, w.reshape(-1, 2)).ravel() for w in np.eye(160)]).T
    norm = np.linalg.norm(stepped, 2)
    assert norm == pytest.approx(float(lbt.hinf_norm(lifted)), rel=5e-3)
    assert norm < float(lbt.hinf_norm(lifted))


def test_the_lifted_system_is_the_system():
    system, rng = random_system(), np.random.default_rng(1)
    inputs = rng.standard_normal((40, 2))
    lifted, x, out = system.lifted(), np.zeros(3), []
    for w in inputs.reshape(8, 10):
        out.append(lifted.C @ x + lifted.D @ w)
        x = lifted.A @ x + lifted.B @ w
    np.testing.assert_allclose(np.ravel(out), steps(system, inputs).ravel(), atol=1e-12)
    assert lifted.dt_s == pytest.approx(0.05)


def test_few_inputs_remain():
    assert random_system(m=30).lifted_compactly().B.shape == (3, 13)


def test_covariances_are_those_of_a_long_recursion():
    system = random_system()
    P = np.zeros((3, 3))
    for k in range(2000):
        t = k % 5
        P = system.A[t] @ P @ system.A[t].T + system.B[t] @ system.B[t].T
    assert relative_distance(system.covariances()[0], P) < 1e-12


def test_the_frequency_response_is_what_a_sinusoid_leaves():
    system, frequency_hz = random_system(), 7.3
    wave = np.exp(2j * np.pi * frequency_hz * 0.01 * np.arange(600))
    for column in range(2):
        left = steps(system, wave[:, None] * np.eye(2)[column])[-5:] / wave[-5:, None]
        response = system.frequency_response([frequency_hz])[0, :, :, column]
        np.testing.assert_allclose(left, response, rtol=1e-9)


def test_the_radius_of_a_period_and_of_a_frame():
    system = PeriodicSystem(
        A=[[[0.5]], [[3.0]], [[0.1]]], B=[[[1.0]]], C=[[[1.0]]], D=[[[0.0]]], dt_s=1.0
    )
    assert system.spectral_radius == pytest.approx(0.15)
    assert system.radius_per_frame == pytest.approx(0.15 ** (1 / 3))


def test_a_controller_reads_its_new_state():
    controller = random_system(kind=PeriodicController)
    inputs, x, out = np.random.default_rng(3).standard_normal((20, 2)), np.zeros(3), []
    for k, y in enumerate(inputs):
        own = controller.phase(k)
        x = own.A @ x + own.B @ y
        out.append(own.C @ x + own.D @ y)
    np.testing.assert_allclose(steps(controller.to_statespace(), inputs), out, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"A": [[1.0]]}, r"A must be a matrix per phase; got \(1, 1\)"),
        ({"A": np.ones((1, 2, 1))}, r"A must be \(1, 1, 1\); got \(1, 2, 1\)"),
        ({"C": np.ones((1, 1, 2))}, r"C must be \(1, 1, 1\); got \(1, 1, 2\)"),
        ({"A": np.ones((2, 1, 1)), "B": np.ones((3, 1, 1))}, r"A must be \(3, 1, 1\); got \(2"),
    ],
)
def test_sizes_that_clash(changes, words):
    one = {name: [[[1.0]]] for name in "ABCD"}
    with pytest.raises(DimensionError, match=words):
        PeriodicSystem(**(one | changes))
