"""Reconstructors from slopes to modes, and modes made orthogonal to others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.modal.stack import mode_indices, name_modes
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.validation import FloatArray, integer, matrix, number, read_only, real_array

_EMPTY = 1e-8  # part of a mode that has to be left by a projection


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reconstructor:
    """Generalised inverse of an interaction matrix, made by :func:`reconstructor`.

    Attributes
    ----------
    interaction_matrix : (q, n) ndarray
        Slopes that each mode gives.
    matrix : (n, q) ndarray
        The inverse: ``modes = matrix @ slopes``.
    singular_values : (min(q, n),) ndarray
        All singular values of the interaction matrix, the largest first.
    kept : int
        Number of singular values that are inverted.
    """

    interaction_matrix: FloatArray
    matrix: FloatArray
    singular_values: FloatArray
    kept: int

    @property
    def n_modes(self) -> int:
        """Number of modes n."""
        return int(self.matrix.shape[0])

    @property
    def n_slopes(self) -> int:
        """Number of slopes q."""
        return int(self.matrix.shape[1])

    @property
    def condition_number(self) -> float:
        """Largest over smallest singular value of those that are kept."""
        return float(self.singular_values[0] / self.singular_values[self.kept - 1])

    @property
    def noise_amplification(self) -> FloatArray:
        """Standard deviation of each mode for slopes with independent noise of 1, (n,)."""
        return read_only(np.linalg.norm(self.matrix, axis=1))


def reconstructor(
    interaction_matrix: ArrayLike, *, condition: float | None = None, kept: int | None = None
) -> Reconstructor:
    """Invert an interaction matrix by its singular values.

    Without a truncation the result is a left inverse: every mode comes back as it was. With
    one, the combinations of modes that give the weakest slopes are set to zero, and with
    them the noise that they would let in.

    Parameters
    ----------
    interaction_matrix : (q, n) array_like
        Slopes that a unit of each mode gives, one column per mode.
    condition : float, optional
        Greatest condition number: singular values below the largest over this are left out.
    kept : int, optional
        Number of singular values kept, instead of ``condition``.

    Returns
    -------
    Reconstructor
        The inverse, with what was left out of it.

    Raises
    ------
    DimensionError
        If there are more modes than slopes and no truncation.
    ProblemError
        If an entry is not finite, a mode gives no slopes at all, both truncations are given or
        one is out of its range, or the modes are not distinct and nothing is left out.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> inverse = lbt.design.modal.reconstructor([[2.0, 0.0], [0.0, 0.5], [0.0, 0.0]])
    >>> inverse.matrix.tolist(), inverse.condition_number
    ([[0.5, 0.0, 0.0], [0.0, 2.0, 0.0]], 4.0)
    >>> lbt.design.modal.reconstructor([[2.0, 0.0], [0.0, 0.5]], condition=3).matrix.tolist()
    [[0.5, 0.0], [0.0, 0.0]]
    """
    D = matrix(interaction_matrix, "interaction_matrix")
    q, n = D.shape
    if q == 0 or n == 0:
        raise DimensionError(f"interaction_matrix must have rows and columns; got {D.shape}.")
    size = np.linalg.norm(D, axis=0)
    invisible = np.flatnonzero(size <= q * np.finfo(float).eps * size.max())
    if invisible.size:
        raise ProblemError(
            f"every mode must give slopes; got none from {name_modes(invisible)} of {n} (zero "
            "columns of interaction_matrix). Measure them, or leave them out."
        )
    if condition is not None and kept is not None:
        raise ProblemError("give condition or kept, not both.")
    if n > q and condition is None and kept is None:
        raise DimensionError(
            f"interaction_matrix must have at least as many slopes as modes, {n}; got {D.shape}. "
            "Control fewer modes, or truncate: condition=100, or kept=... singular values."
        )
    left, values, right = np.linalg.svd(D, full_matrices=False)
    rank = int(np.sum(values > max(D.shape) * np.finfo(float).eps * values[0]))
    count = n if kept is None else integer(kept, "kept", at_least=1)
    if condition is not None:
        count = int(np.sum(values >= values[0] / number(condition, "condition", at_least=1)))
    if count > rank:
        raise ProblemError(
            f"the {min(q, n)} singular values that are inverted must not vanish; got {rank} that "
            f"do not and {count} to keep: some modes give the same slopes. Try "
            f"kept={rank} or less, or a condition below {values[0] / values[rank - 1]:.3g}."
        )
    inverse = read_only((right[:count].T / values[:count]) @ left[:, :count].T)
    sizes = read_only(values)
    return Reconstructor(interaction_matrix=D, matrix=inverse, singular_values=sizes, kept=count)


def project_out(
    modes: ArrayLike,
    removed: Sequence[int] = (0, 1),
    *,
    weights: ArrayLike | None = None,
    influence_matrix: ArrayLike | None = None,
) -> FloatArray:
    """Take some modes, such as tip and tilt, out of all the others.

    So that a controller of these modes does not work against that of the others: Agapito et
    al. (2008) project tip and tilt out of all modes "in order to decouple the control". What
    is taken out is the part along them in the inner product of the pupil,
    ``<a, b> = sum(weights a b)`` over its points.

    Parameters
    ----------
    modes : (points, n) array_like
        Phase of each mode over the points of the pupil; or, with ``influence_matrix``, the
        commands of each mode, (actuators, n).
    removed : sequence of int, optional
        Columns of the modes that are taken out of the others; they do not change.
    weights : (points,) array_like, optional
        Weight of each point of the pupil, at least 0; all the same by default.
    influence_matrix : (points, actuators) array_like, optional
        Phase that a unit of each actuator gives.

    Returns
    -------
    (points, n) or (actuators, n) ndarray
        The modes, the others now orthogonal to those that were taken out.

    Raises
    ------
    ProblemError
        If sizes clash, a value is out of its range, the removed modes are not independent, or
        nothing is left of a mode.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> x = np.linspace(-1, 1, 5)
    >>> modes = np.stack([x, x**3], axis=1)  # x^3 is partly a tilt
    >>> clean = lbt.design.modal.project_out(modes, [0])
    >>> bool(abs(clean[:, 0] @ clean[:, 1]) < 1e-12)
    True
    """
    given = matrix(modes, "modes")
    n = given.shape[1]
    taken = mode_indices(removed, "removed", n)
    phase = given
    if influence_matrix is not None:
        why = (len(given), f"to match modes {given.shape}, commands of as many actuators")
        phase = matrix(influence_matrix, "influence_matrix", cols=why) @ given
    if weights is not None:
        w = real_array(weights, "weights")
        if w.shape != (len(phase),):
            wanted = f"({len(phase)},), one per point of the pupil"
            raise DimensionError(f"weights must have shape {wanted}; got {w.shape}.")
        if np.any(w < 0) or not np.any(w):
            raise ProblemError(f"weights must be at least 0, and not all 0; got {np.min(w):.6g}.")
        phase = np.sqrt(w)[:, None] * phase
    others = np.setdiff1d(np.arange(n), taken)
    base, rest = phase[:, taken], phase[:, others]
    parts, _, rank, _ = np.linalg.lstsq(base, rest, rcond=None)
    if rank < taken.size:
        got = f"{taken.size} of rank {rank}"
        raise ProblemError(f"the removed modes must be independent on the pupil; got {got}.")
    out = np.array(given)
    out[:, others] -= given[:, taken] @ parts
    left = rest - base @ parts
    size, before = np.linalg.norm(left, axis=0), np.linalg.norm(rest, axis=0)
    gone = others[size <= _EMPTY * before]
    if gone.size:
        names = name_modes(gone)
        raise ProblemError(f"nothing is left of {names} without the removed ones. Leave them out.")
    return read_only(out)
