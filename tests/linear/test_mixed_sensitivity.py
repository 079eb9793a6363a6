"""Mixed-sensitivity plants, against the responses of their parts."""

from __future__ import annotations

import control
import numpy as np
import pytest
from support.generalized_plants import sampled

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear import StateSpace, mixed_sensitivity

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
