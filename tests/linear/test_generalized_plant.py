"""Generalised plants: their partition, weights, and the loop around a controller."""

import control
import numpy as np
import pytest
from support.generalized_plants import random_plant, sampled

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, NumericalError, ProblemError
from lbt_synth.linear import GeneralizedPlant, StateSpace, mixed_sensitivity


@pytest.mark.parametrize("seed", range(4))
def test_closed_loop_is_the_fractional_transformation(seed):
    P = random_plant(seed, n=4)
    m1, m2, p1, p2 = P.sizes
    rng = np.random.default_rng(seed)
    K = StateSpace(
        A=0.3 * rng.normal(size=(3, 3)),
        B=rng.normal(size=(3, p2)),
        C=rng.normal(size=(m2, 3)),
        D=0.1 * rng.normal(size=(m2, p2)),
    )
    frequency_hz = np.linspace(0.01, 0.5, 9)
    G, Kf = P.whole.frequency_response(frequency_hz), K.frequency_response(frequency_hz)
    P11, P12, P21, P22 = (
        G[:, a, b] for a in (slice(p1), slice(p1, None)) for b in (slice(m1), slice(m1, None))
    )
    expected = P11 + P12 @ np.linalg.solve(np.eye(m2) - Kf @ P22, Kf @ P21)
    assert P.closed_loop(K).frequency_response(frequency_hz) == pytest.approx(expected, rel=1e-8)


def test_partition_and_back():
    P = random_plant(2, n=3)
    _, controls, _, measurements = P.sizes
    again = GeneralizedPlant.of(P.whole, measurements=measurements, controls=controls)
    for name in ("A", "B1", "B2", "C1", "C2", "D11", "D12", "D21", "D22"):
        assert np.array_equal(getattr(P, name), getattr(again, name))


def test_bad_plants():
    with pytest.raises(DimensionError, match=r"D12 must have 1 row to match C1"):
        GeneralizedPlant(A=1.0, B1=1.0, B2=1.0, C1=1.0, C2=1.0, D12=np.ones((2, 1)))
    with pytest.raises(DimensionError, match="B2 must have at least one signal"):
        GeneralizedPlant(A=1.0, B1=1.0, B2=np.zeros((1, 0)), C1=1.0, C2=1.0)
    with pytest.raises(ProblemError, match="measurements must be at most 1"):
        GeneralizedPlant.of(
            lbt.linear.StateSpace(A=1.0, B=[[1.0, 1.0]], C=[[1.0], [1.0]], D=np.zeros((2, 2))),
            measurements=2,
            controls=1,
        )


def test_bad_loops():
    P = GeneralizedPlant(A=0.5, B1=1.0, B2=1.0, C1=1.0, C2=1.0, D22=1.0)
    with pytest.raises(DimensionError, match="1 measurements to 1 controls"):
        P.closed_loop(StateSpace(A=0.0, B=np.zeros((1, 2)), C=0.0, D=np.zeros((1, 2))))
    with pytest.raises(NumericalError, match="not well posed"):
        P.closed_loop(StateSpace(A=0.0, B=0.0, C=0.0, D=1.0))
    with pytest.raises(ProblemError, match="one sampling period; got 1 s and 0.1 s"):
        P.closed_loop(StateSpace(A=0.0, B=0.0, C=0.0, D=0.0, dt_s=0.1))
    with pytest.raises(ProblemError, match="must be a StateSpace"):
        P.closed_loop(lbt.Controller(A=0.0, B=0.0, C=0.0, D=0.0))


@pytest.mark.parametrize("dt_s", [None, 0])
def test_a_plant_in_continuous_time_is_refused(dt_s):
    with pytest.raises(ProblemError, match='Sample it first.*method="bilinear"'):
        GeneralizedPlant(A=0.5, B1=1.0, B2=1.0, C1=1.0, C2=1.0, dt_s=dt_s)
    two = control.ss([[-1.0]], [[1.0, 1.0]], [[1.0], [1.0]], np.zeros((2, 2)))
    with pytest.raises(ProblemError, match='Sample it first.*method="bilinear"'):
        GeneralizedPlant.of(two, measurements=1, controls=1)


# -- mixed sensitivity ----------------------------------------------------------
G = StateSpace(A=[[0.9, 0.1], [0.0, 0.7]], B=[[0.0], [1.0]], C=[[1.0, 0.5]], D=[[0.2]], dt_s=0.1)
W1 = StateSpace(A=0.99, B=0.1, C=1.0, D=0.5, dt_s=0.1)
FREQUENCY_HZ = np.linspace(0.0, 5.0, 23)


@pytest.mark.parametrize("shape", ["siso", "mimo"])
def test_closed_loop_is_the_weighted_sensitivities(shape):
    plant = G
    if shape == "mimo":
        rng = np.random.default_rng(0)
        A = np.diag([0.9, 0.5, 0.3])
        plant = StateSpace(
            A=A, B=rng.normal(size=(3, 2)), C=rng.normal(size=(2, 3)), D=np.zeros((2, 2)), dt_s=0.1
        )
    P = mixed_sensitivity(plant, performance=W1, control=0.3, robustness=W1)
    size = len(plant.C)
    K = StateSpace(
        A=0.5 * np.eye(size), B=np.eye(size), C=0.1 * np.eye(size), D=0.05 * np.eye(size), dt_s=0.1
    )
    T = P.closed_loop(K).frequency_response(FREQUENCY_HZ)
    Gf, Kf, Wf = (s.frequency_response(FREQUENCY_HZ) for s in (plant, K, W1))
    S = np.linalg.inv(np.eye(size) + Gf @ Kf)
    expected = np.concatenate([Wf * S, 0.3 * Kf @ S, Wf * (Gf @ Kf @ S)], axis=1)
    assert T == pytest.approx(expected, rel=1e-9)


def test_design_of_a_textbook_plant():
    """S. Skogestad's disturbance process (section 2.6.3): the norm stays near one."""
    G = control.tf([200.0], np.polymul([10.0, 1.0], np.polymul([0.05, 1.0], [0.05, 1.0])))
    W1 = control.tf([1 / 1.5, 10.0], [1.0, 10.0 * 1e-4])
    plant = mixed_sensitivity(sampled(G, 0.1), performance=sampled(W1, 0.1), control=1.0)
    design = lbt.hinf_controller(plant)
    assert design.gamma == pytest.approx(1.37, abs=0.01)  # the book's table says 1.37


def test_bad_weights():
    with pytest.raises(ProblemError, match="at least one of performance"):
        mixed_sensitivity(G)
    with pytest.raises(ProblemError, match="one sampling period"):
        mixed_sensitivity(G, performance=sampled(control.tf([1.0], [1.0, 1.0]), 0.2))
    with pytest.raises(ProblemError, match="must be in discrete time"):
        mixed_sensitivity(G, performance=control.tf([1.0], [1.0, 1.0]))
    with pytest.raises(DimensionError, match="robustness must take 1 signals"):
        mixed_sensitivity(G, robustness=np.ones((1, 3)))
