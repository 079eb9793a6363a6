"""The generalised plant of a mixed-sensitivity problem."""

from __future__ import annotations

from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear.generalized_plant import GeneralizedPlant, require_same_period
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.linear.weights import Weight, constant_weight, stack_weights, weigh_plant
from lbt_synth.validation import matrix


def mixed_sensitivity(
    plant: Any, *, performance: Any = None, control: Any = None, robustness: Any = None
) -> GeneralizedPlant:
    """Weight the sensitivity S, the control K S and the complementary sensitivity T of a loop.

    The loop is ``e = w - G u``, ``u = K e``; the errors are ``W1 e``, ``W2 u`` and ``W3 G u``, so
    that the closed loop from w is ``[W1 S; W2 K S; W3 T]``.

    Parameters
    ----------
    plant : object
        G: a StateSpace, or what :meth:`StateSpace.of` takes.
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
        If there is no weight, a system is in continuous time, or sampling periods differ.
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
    G = StateSpace.of(plant)
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
    weight = stack_weights(
        _weight(given[name], name, len(reads[name][0]), G.dt_s) for name in names
    )
    C1, D11, D12 = (np.vstack([reads[name][i] for name in names]) for i in range(3))
    loop = GeneralizedPlant(
        A=G.A,
        B1=np.zeros((len(G.A), p)),
        B2=G.B,
        C1=C1,
        C2=-G.C,
        D11=D11,
        D12=D12,
        D21=np.eye(p),
        D22=-G.D,
        dt_s=G.dt_s,
    )
    return weigh_plant(loop, weight)


def _weight(value: Any, name: str, size: int, dt_s: float) -> Weight:
    """Return a weight of signals of some size, with a sampling period."""
    if isinstance(value, int | float | np.ndarray):
        weight = constant_weight(matrix(value, name))
    else:
        W = StateSpace.of(value)
        require_same_period(dt_s, W)
        weight = Weight(W.A, W.B, W.C, W.D)
    if weight.D.shape == (1, 1):
        weight = stack_weights([weight] * size)
    if weight.D.shape[1] != size:
        raise DimensionError(
            f"the weight {name} must take {size} signals; got one of {weight.D.shape[1]}."
        )
    return weight
