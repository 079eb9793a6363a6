"""Filters by inequalities, part by part, and the programme of the mixed filter."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from support.refusals import refused

import lbt_synth as lbt
from lbt_synth.errors import NumericalError
from lbt_synth.linear import EstimationProblem
from lbt_synth.linear.lmi import filters
from lbt_synth.linear.lmi.filters import kalman_sdp, least_gamma_lmi
from lbt_synth.linear.lmi.mixed import InnovationProgramme
from lbt_synth.linear.riccati.filtering import kalman_riccati


def random_axis(rng):
    """One axis: a drift, a line, and noise of one's own."""
    turn = rng.uniform(0.1, 1.0)
    line = 0.99 * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    A, B = block_diag(rng.uniform(0.9, 0.99), line), np.diag(rng.uniform(0.5, 2, 3)) @ np.eye(3, 4)
    return A, B, np.array([[1.0, 1.0, 0.0]]), rng.uniform(0.5, 2) * np.eye(1, 4, k=3)


def problem_of(axes, turn=None):
    A, B, C, D = (block_diag(*parts) for parts in zip(*axes, strict=True))
    turn = np.arange(len(A)) if turn is None else turn
    A, B, C = A[np.ix_(turn, turn)], B[turn], C[:, turn]
    return lbt.EstimationProblem(A=A, B=B, C=C, D=D, L=C)


@pytest.mark.parametrize("seed", range(2))
def test_axes_that_have_nothing_in_common_stay_apart(seed):
    """Exactly, whatever the solver leaves; equal axes included, at odd seeds."""
    rng = np.random.default_rng(seed)
    axes = [random_axis(rng), random_axis(rng)]
    axes[1] = axes[0 if seed % 2 else 1]
    turn = rng.permutation(6)
    both, other = problem_of(axes, turn), (turn[:, None] // 3) != np.arange(2)
    least = lbt.hinf(both, route="lmi")
    alone = max(lbt.hinf(problem_of([axis]), route="riccati").gamma_least for axis in axes)
    assert (least.gamma_least, least.gamma_infeasible) == pytest.approx((alone, alone), rel=1e-6)
    near = lbt.hinf(both, gamma_ratio=1.1, route="lmi")
    for design in (lbt.kalman(both, route="sdp"), least, near):
        assert not np.any(design.gain_predictor[other])


def test_a_programme_that_did_not_end_gives_no_filter(monkeypatch):
    walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    monkeypatch.setattr(filters, "solve", lambda *_: ("user_limit", 200))
    facts = {"coordinates": np.eye(1), "scale": 1.0}
    words = "of the Kalman filter ended as"
    refused(lambda: kalman_sdp(walk, **facts), NumericalError, words)
    refused(lambda: least_gamma_lmi(walk, **facts), NumericalError, r"least gamma's .* ended as")


GRID_HZ = np.linspace(0, 0.5, 30)


def two_axes(angle: float) -> EstimationProblem:
    """Two resonances of different damping, whose axes are turned by an angle."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    A = block_diag([[1.9, -0.98], [1.0, 0.0]], [[1.8, -0.95], [1.0, 0.0]])
    L = np.eye(4)[::2]
    B, D = np.pad(L.T, ((0, 0), (0, 2))), 3 * np.eye(2, 4, k=2)
    return EstimationProblem(A=A, B=B, C=turn @ np.roll(L, 1, axis=1), D=D, L=turn @ L)


def test_turned_axes_have_the_same_optimum() -> None:
    """A turn couples the axes, not the optimum: cones for each axis against matrices for both."""
    distances = []
    for problem in (two_axes(0.0), two_axes(0.4)):
        gain = kalman_riccati(problem).gain_predictor
        programme = InnovationProgramme.from_predictor(problem, gain, taps=3)
        norm = np.max(np.linalg.norm(programme.error.frequency_response(GRID_HZ), 2, (1, 2)))
        taps, _ = programme.minimize_variance(0.97 * float(norm), GRID_HZ)
        scaled = taps @ np.kron(np.eye(3), np.linalg.inv(programme.whitening))
        distances.append(np.sum((scaled @ programme.root - programme.target) ** 2))
        assert np.sum(taps**2) > 0.001
    np.testing.assert_allclose(distances[1], distances[0], rtol=1e-5)
