"""Generalised plants: their partition, weights, and the loop around a controller."""

import control
import numpy as np
import pytest
from support.generalized_plants import random_plant, sampled
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, NumericalError, ProblemError
from lbt_synth.linear import GeneralizedPlant, StateSpace


@pytest.mark.parametrize("seed", range(2))
def test_closed_loop_is_the_fractional_transformation(seed):
    rng, P = np.random.default_rng(seed), random_plant(seed, n=4)
    m1, m2, p1, p2 = P.sizes
    P = GeneralizedPlant.of(P.whole, measurements=p2, controls=m2)
    B, C, D = rng.normal(size=(3, p2)), rng.normal(size=(m2, 3)), 0.1 * rng.normal(size=(m2, p2))
    K = StateSpace(A=0.3 * rng.normal(size=(3, 3)), B=B, C=C, D=D)
    frequency_hz = np.linspace(0.01, 0.5, 9)
    G, Kf = (system.frequency_response(frequency_hz) for system in (P.whole, K))
    P11, P12, P21, P22 = (
        G[:, a, b] for a in (slice(p1), slice(p1, None)) for b in (slice(m1), slice(m1, None))
    )
    expected = P11 + P12 @ np.linalg.solve(np.eye(m2) - Kf @ P22, Kf @ P21)
    assert P.closed_loop(K).frequency_response(frequency_hz) == pytest.approx(expected, rel=1e-8)


@pytest.mark.filterwarnings("ignore:connect:FutureWarning")  # python-control's own
def test_design_of_a_textbook_plant():
    """S. Skogestad's disturbance process (section 2.6.3): the norm stays near one."""
    G = control.tf([200.0], np.polymul([10.0, 1.0], np.polymul([0.05, 1.0], [0.05, 1.0])))
    W1 = control.tf([1 / 1.5, 10.0], [1.0, 10.0 * 1e-4])
    weighted = control.augw(sampled(G, 0.1), sampled(W1, 0.1), control.ss([], [], [], 1.0, 0.1))
    design = lbt.hinf_controller(GeneralizedPlant.of(weighted, measurements=1, controls=1))
    assert design.gamma == pytest.approx(1.37, abs=0.01)  # the book's table says 1.37


ONE = {"A": 0.5, "B1": 1.0, "B2": 1.0, "C1": 1.0, "C2": 1.0}
LOOP = GeneralizedPlant(**ONE, D22=1.0)
NO_INPUT = {"B2": np.zeros((1, 0))}
HELD = lbt.Controller(A=0.0, B=0.0, C=0.0, D=0.0)
SLOW = control.ss([[-1.0]], [[1.0, 1.0]], [[1.0], [1.0]], np.zeros((2, 2)))
SAMPLE_IT = 'Sample it first.*method="bilinear"'


def static(D, **more):
    return StateSpace(A=0.0, B=np.zeros((1, len(np.atleast_2d(D)[0]))), C=0.0, D=D, **more)


def test_refusals():
    of, wide = GeneralizedPlant.of, static([[0.0, 0.0]])
    rows = [
        (lambda: GeneralizedPlant(**ONE, D12=np.ones((2, 1))), DimensionError, "D12 must have 1"),
        (lambda: GeneralizedPlant(**(ONE | NO_INPUT)), DimensionError, "B2 must have at least one"),
        (lambda: of(LOOP.whole, measurements=2, controls=1), ProblemError, "at most 1"),
        (lambda: GeneralizedPlant(**ONE, dt_s=0), ProblemError, "dt_s must be above 0"),
        (lambda: of(SLOW, measurements=1, controls=1), ProblemError, SAMPLE_IT),
        (lambda: LOOP.closed_loop(wide), DimensionError, "1 measurements to 1 cont"),
        (lambda: LOOP.closed_loop(static(1.0)), NumericalError, "not well posed"),
        (lambda: LOOP.closed_loop(static(0.0, dt_s=0.1)), ProblemError, "got 1 s and 0.1 s"),
        (lambda: LOOP.closed_loop(HELD), ProblemError, "must be a StateSpace"),
    ]
    require_refusals(rows)
