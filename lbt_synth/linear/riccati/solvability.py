"""Find out why a Riccati equation has no stabilising solution, and which mode is to blame."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag, eigvals

from lbt_synth.errors import DefinitenessError, DetectabilityError
from lbt_synth.linear.riccati.equations import Equations
from lbt_synth.linear.state_space import balancing_scales
from lbt_synth.validation import FloatArray

_RANK = 1e-10
_CIRCLE = 1e-3  # a multiple root on the circle is computed up to this far from it
_SINGULAR = 1e-11  # a ratio of singular values of a pencil that counts as zero
_ROUNDING = 1e-14  # a change of the data by this part is one of rounding
_LARGE = 1e6  # above this norm the ratio of singular values says little
_ELSEWHERE = 0.37 + 0.61j  # an arbitrary point
# An eigenvalue of a defective matrix is computed up to this far from the circle. It is tested on
# the circle as well, with a tolerance at which a mode that decays passes.
_CLUSTER = 1e-4
_CLUSTER_RANK = 1e-13


def unstable_hidden_mode(
    A: FloatArray, C: FloatArray, *, drive: FloatArray, only_unit_circle: bool = False
) -> complex | None:
    """Eigenvalue of A that does not decay and that C does not see, or None.

    The Popov-Belevitch-Hautus test on the eigenvalues with modulus 1 or more
    (or about 1, with ``only_unit_circle``). ``drive`` (n, p), which enters the states,
    serves to scale them, because the answer must not depend on their units.
    """
    n = A.shape[0]
    entry, leaving = np.linalg.norm(drive, axis=1), np.linalg.norm(C, axis=0)
    units = balancing_scales(A, entry, leaving)[:n]
    A, C = A * units / units[:, None], C * units
    scale_A = max(float(np.linalg.norm(A, 2)), 1e-300)
    scale_C = max(float(np.linalg.norm(C, 2)), 1e-300)
    points: list[tuple[complex, float]] = []
    for value in np.linalg.eigvals(A):
        size = abs(value)
        if size >= 1 - _RANK and not (only_unit_circle and size > 1 + _RANK):
            points.append((complex(value), _RANK))
        if abs(size - 1) < _CLUSTER:
            points.append((complex(value / size), _CLUSTER_RANK))
    for point, tolerance in points:
        pencil = np.vstack([(A - point * np.eye(n)) / scale_A, C / scale_C])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < tolerance:
            return point
    return None


def require_stabilising(equations: Equations, index: int, name: str = "") -> None:
    """Raise if an equation has no stabilising solution for a reason that can be named."""
    A, B, Q, R, S = (getattr(equations, key)[index] for key in "ABQRS")
    hidden = unstable_hidden_mode(A.T, B.T, drive=weight_root(Q))
    if hidden is not None:
        raise DetectabilityError(
            f"{name}(A, B) must be stabilisable; the mode of A at {hidden:.6g} does not decay and "
            "B does not reach it. Give it an input, or take it out of the model.",
            eigenvalue=hidden,
        )
    inputs = np.vstack([part / max(np.abs(part).max(), 1e-300) for part in (B, R, S)])
    if np.linalg.svd(inputs, compute_uv=False)[-1] < _RANK:
        raise DefinitenessError(
            f"{name}R must be positive definite, or B and S must act where it is not; got a "
            "combination of inputs that has no weight and no effect. Leave it out."
        )
    if np.linalg.eigvalsh(R)[0] > 0:
        feedback = np.linalg.solve(R, S.T)
        weight = Q - S @ feedback
        hidden = unstable_hidden_mode(
            A - B @ feedback, weight_root((weight + weight.T) / 2).T, drive=B, only_unit_circle=True
        )
        if hidden is not None:
            raise DetectabilityError(
                f"{name}Q must see every mode on the unit circle; the mode of A at {hidden:.6g} "
                "has no weight, so there is no stabilising solution. Add a small weight on it.",
                eigenvalue=hidden,
            )
    zero = _unit_circle_zero(A, B, Q, R, S, name)
    if zero is not None:
        raise DetectabilityError(
            f"{name}to rounding, the equation has a zero on the unit circle, at {zero:.6g}: there "
            "its weights leave an oscillation free of cost, so there is no stabilising solution. "
            "Add a small weight.",
            eigenvalue=zero,
        )


def weight_root(weight: FloatArray) -> FloatArray:
    """Columns whose squares add up to the absolute value of a symmetric matrix."""
    values, vectors = np.linalg.eigh(weight)
    size = np.abs(values)
    size = np.where(size > 1e-14 * size.max(initial=0.0), size, 0.0)  # a root doubles its digits
    return np.asarray(vectors * np.sqrt(size), dtype=np.float64)


def _unit_circle_zero(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray, name: str
) -> complex | None:
    """Eigenvalue on the unit circle of the extended symplectic pencil, or None."""
    (n, m), zero = B.shape, np.zeros
    weight = max(np.abs(Q).max(), np.abs(R).max(), np.abs(S).max(), 1e-300)
    Q, R, S = Q / weight, R / weight, S / weight
    M = np.block([[A, zero((n, n)), B], [-Q, np.eye(n), -S], [S.T, zero((m, n)), R]])
    N = block_diag(np.eye(n), np.vstack([A.T, -B.T]), zero((0, m)))
    size = float(np.linalg.norm(M, 2))
    elsewhere = np.linalg.svd(M - _ELSEWHERE * N, compute_uv=False)[-1]
    if size < _LARGE and elsewhere < _SINGULAR * size:
        raise DefinitenessError(
            f"{name}R + B'XB must not be singular; it is, whatever X: some input has neither a "
            "weight nor an effect that Q sees. Give R or Q a small weight there."
        )
    values = eigvals(M, N)
    for value in values[np.isfinite(values)]:
        if abs(abs(value) - 1) > _CIRCLE:
            continue
        on_circle = value / abs(value)
        if np.linalg.svd(M - on_circle * N, compute_uv=False)[-1] < _ROUNDING * size:
            return complex(on_circle)
    return None
