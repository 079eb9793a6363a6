"""The programme of the mixed filter: axes apart, and axes that look coupled."""

import numpy as np

from lbt_synth.linear import EstimationProblem
from lbt_synth.linear.lmi.mixed import InnovationProgramme
from lbt_synth.linear.riccati.filtering import kalman_riccati

GRID_HZ = np.linspace(0, 0.5, 30)


def two_axes(angle: float) -> EstimationProblem:
    """Two resonances of different damping, whose axes are turned by an angle."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    A, B, L = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((2, 4))
    for i, (first, second) in enumerate([(1.9, -0.98), (1.8, -0.95)]):
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[first, second], [1.0, 0.0]]
        B[2 * i, i], L[i, 2 * i] = 1.0, 1.0
    C = turn @ np.roll(L, 1, axis=1)
    D = np.hstack([np.zeros((2, 2)), 3 * np.eye(2)])
    return EstimationProblem(A=A, B=B, C=C, D=D, L=turn @ L)


def test_turned_axes_have_the_same_optimum() -> None:
    """A turn couples the axes, not the optimum: cones for each axis against matrices for both."""
    found = []
    for angle in (0.0, 0.4):
        problem = two_axes(angle)
        gain = kalman_riccati(problem).gain_predictor
        programme = InnovationProgramme.from_predictor(problem, gain, taps=3)
        norm = np.max(np.linalg.norm(programme.error.frequency_response(GRID_HZ), 2, (1, 2)))
        taps, _ = programme.minimize_variance(0.97 * float(norm), GRID_HZ)
        scaled = taps @ np.kron(np.eye(3), np.linalg.inv(programme.whitening))
        distance = np.sum((scaled @ programme.root - programme.target) ** 2)
        assert np.sum(taps**2) > 0.001
        found.append(distance)
    np.testing.assert_allclose(found[1], found[0], rtol=1e-5)
