"""The generalised plant of a mixed-sensitivity problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear.continuous_system import ContinuousSystem, linear_system, require_same_time
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.validation import FloatArray, matrix


def mixed_sensitivity(
    plant: Any, *, performance: Any = None, control: Any = None, robustness: Any = None
) -> GeneralizedPlant:
    """Weight the sensitivity S, the control K S and the complementary sensitivity T of a loop.

    The loop is ``e = w - G u``, ``u = K e``; the errors are ``W1 e``, ``W2 u`` and ``W3 G u``, so
    that the closed loop from w is ``[W1 S; W2 K S; W3 T]``.

    Parameters
    ----------
    plant : object
        G, as :func:`linear_system` takes it.
    performance, control, robustness : object or float, optional
        The weights W1, W2 and W3: a system, a matrix or a number. A system of one input and one
        output weighs each signal. At least one must be given.

    Returns
    -------
    GeneralizedPlant
        Its measurement is e, its control u, its states those of G, W1, W2 and W3 in turn.

    Raises
    ------
    ProblemError
        If there is no weight, or systems differ in time.
    DimensionError
        If a weight does not fit.

    References
    ----------
    S. Skogestad, I. Postlethwaite, "Multivariable Feedback Control", Wiley (2005), section 9.3.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lag = lbt.linear.StateSpace(A=0.9, B=0.1, C=1.0, D=0.0, dt_s=1e-3)
    >>> W1 = lbt.linear.StateSpace(A=0.999, B=0.1, C=1.0, D=0.5, dt_s=1e-3)
    >>> lbt.linear.mixed_sensitivity(lag, performance=W1, control=0.1)
    <GeneralizedPlant: 2 states, 1 disturbance, 1 control, 2 errors, 1 measurement>
    """
    G = linear_system(plant)
    p, m = G.D.shape
    given = {"performance": performance, "control": control, "robustness": robustness}
    # what each weight reads of the states, of w and of u
    reads = {
        "performance": (-G.C, np.eye(p), -G.D),
        "control": (np.zeros((m, len(G.A))), np.zeros((m, p)), np.eye(m)),
        "robustness": (G.C, np.zeros((p, p)), G.D),
    }
    names = [name for name, value in given.items() if value is not None]
    if not names:
        raise ProblemError("give at least one of performance, control and robustness.")
    systems = [_weight(given[name], name, len(reads[name][0]), G) for name in names]
    from_state, from_w, from_u = (np.vstack([reads[name][i] for name in names]) for i in range(3))
    entry = block_diag(*(W.B for W in systems))
    through = block_diag(*(W.D for W in systems))
    A = block_diag(G.A, *(W.A for W in systems))
    n = len(G.A)
    A[n:, :n] = entry @ from_state
    return GeneralizedPlant(
        A=A,
        B1=np.vstack([np.zeros((n, p)), entry @ from_w]),
        B2=np.vstack([G.B, entry @ from_u]),
        C1=np.hstack([through @ from_state, block_diag(*(W.C for W in systems))]),
        C2=np.hstack([-G.C, np.zeros((p, len(A) - n))]),
        D11=through @ from_w,
        D12=through @ from_u,
        D21=np.eye(p),
        D22=-G.D,
        dt_s=require_same_time(G),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Weight:
    """Matrices of a weight; a gain has no states."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


def _weight(value: Any, name: str, size: int, like: StateSpace | ContinuousSystem) -> _Weight:
    """Return a weight of signals of some size, in the time of a system."""
    if isinstance(value, int | float | np.ndarray):
        D = matrix(value, name)
        parts = {"A": np.zeros((0, 0)), "B": np.zeros((0, D.shape[1])), "C": np.zeros((len(D), 0))}
        parts["D"] = D
    else:
        W = linear_system(value)
        require_same_time(like, W)
        parts = {key: getattr(W, key) for key in "ABCD"}
    if parts["D"].shape == (1, 1):
        parts = {key: block_diag(*[part] * size) for key, part in parts.items()}
    if parts["D"].shape[1] != size:
        raise DimensionError(
            f"the weight {name} must take {size} signals; got one of {parts['D'].shape[1]}."
        )
    return _Weight(**parts)
