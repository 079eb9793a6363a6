"""The central controller of a level, from the solutions of both sides.

The disturbance is replaced by its distance from the worst one, and the control by its distance
from the best one; what is left is to estimate the best control from the measurements. M. Green,
D. J. N. Limebeer, "Linear Robust Control", Prentice-Hall (1995), appendix B. With an infinite
level it is the controller of least variance.
"""

from __future__ import annotations

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.linear.generalized_plant import GeneralizedPlant, invert_well_posed
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.validation import FloatArray


def central_controller(
    plant: GeneralizedPlant, X: FloatArray, Y: FloatArray, gamma: float = np.inf
) -> StateSpace:
    """Return the central controller, from y to u, of a level above the least one.

    X and Y (n, n) are the stabilising solutions of control and of estimation at the level; an
    infinite level is that of the least variance. NumericalError if it is not above the least one.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> from lbt_synth.linear.output_feedback.central_controller import central_controller
    >>> P = lbt.linear.GeneralizedPlant(
    ...     A=1.0,
    ...     B1=[[1.0, 0.0]],
    ...     B2=1.0,
    ...     C1=[[1.0], [0.0]],
    ...     C2=1.0,
    ...     D12=[[0.0], [1.0]],
    ...     D21=[[0.0, 1.0]],
    ... )
    >>> golden = [[(1 + 5**0.5) / 2]]
    >>> round(float(central_controller(P, golden, golden).D[0, 0]), 6)  # -1 / golden^2
    -0.381966
    """
    X, Y = np.asarray(X), np.asarray(Y)
    try:
        best = _best_control(plant, X, Y, gamma)
        injection = _injection(*best)
    except np.linalg.LinAlgError as error:
        raise NumericalError(
            f"the level {gamma:.9g} has no controller to working accuracy: {error}. Try a larger "
            "gamma.",
            status="central controller",
        ) from error
    A, _, C2, _, F, _, _ = best
    n = len(A)
    state, control = injection[:n], injection[n:]
    C, D = control @ C2 - F, -control
    observer = StateSpace(
        A=A - state @ C2 + plant.B2 @ C, B=state + plant.B2 @ D, C=C, D=D, dt_s=plant.dt_s
    )
    return with_seen_controls(observer, plant.D22)


def _best_control(
    plant: GeneralizedPlant, X: FloatArray, Y: FloatArray, gamma: float
) -> tuple[FloatArray, ...]:
    """Return A, B1, C2, D21 about the worst disturbance, the law (F, F0), and Z."""
    scale = gamma if np.isfinite(gamma) else 1.0
    B1, D11, D21, m = plant.B1 / scale, plant.D11 / scale, plant.D21 / scale, plant.sizes[0]
    A, B2, C1, D12, n = plant.A, plant.B2, plant.C1, plant.D12, len(plant.A)
    R3, R2 = D12.T @ D12 + B2.T @ X @ B2, D12.T @ D11 + B2.T @ X @ B1
    L2, L1 = B2.T @ X @ A + D12.T @ C1, B1.T @ X @ A + D11.T @ C1
    worst, unit, Z = np.zeros((m, n)), np.eye(m), Y
    if np.isfinite(gamma):
        least = D11.T @ D11 + B1.T @ X @ B1 - R2.T @ _solve(R3, R2) - np.eye(m)
        worst = -_solve(least, L1 - R2.T @ _solve(R3, L2))
        root = np.asarray(np.linalg.cholesky(-(least + least.T) / 2), dtype=np.float64)
        unit = _solve(root.T, unit)
        Z = _solve((np.eye(n) - X @ Y / scale**2).T, Y.T).T / scale**2
    law = _solve(R3, np.hstack([L2 + R2 @ worst, R2 @ unit]))
    return (
        *(A + B1 @ worst, B1 @ unit, plant.C2 + D21 @ worst, D21 @ unit),
        *(law[:, :n], law[:, n:], (Z + Z.T) / 2),
    )


def _injection(
    A: FloatArray,
    B1: FloatArray,
    C2: FloatArray,
    D21: FloatArray,
    F: FloatArray,
    F0: FloatArray,
    Z: FloatArray,
) -> FloatArray:
    """Gains of the innovation into the state (n, p2) and into the best control (m2, p2)."""
    innovation = D21 @ D21.T + C2 @ Z @ C2.T
    seen = np.vstack([A, F]) @ Z @ C2.T + np.vstack([B1, F0]) @ D21.T
    return _solve(innovation, seen.T).T


def with_seen_controls(controller: StateSpace, D22: FloatArray) -> StateSpace:
    """Return the controller for measurements that see the control at once, by D22."""
    if not np.any(D22):
        return controller
    K = controller
    loop = invert_well_posed(-D22, K.D)  # (I + D22 D)^-1
    seen = loop @ np.hstack([-D22 @ K.C, np.eye(len(D22))])
    n = K.n_states
    step, out = K.B @ seen, K.D @ seen
    return StateSpace(
        A=K.A + step[:, :n], B=step[:, n:], C=K.C + out[:, :n], D=out[:, n:], dt_s=K.dt_s
    )


def _solve(M: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(M, right), dtype=np.float64)
