"""Arithmetic and memory that a controller needs per frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller
from lbt_synth.validation import FloatArray

_SMALL = 256  # up to so many entries of [[A, B], [C, D]], every term is written out
_LONGEST = 4096  # terms that are written out at most


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameCost:
    """Arithmetic and memory of one frame of a controller.

    Attributes
    ----------
    form : str
        "straight line" where the exported source writes each non-zero term out, "loops" where
        it multiplies by whole matrices.
    multiplications, additions : int
        Per frame of the exported source; factors of 1 and -1 are no multiplications.
    coefficients : int
        Numbers that the exported source stores.
    states : int
        Numbers that it keeps from one frame to the next.
    dense_multiplications, dense_additions, dense_coefficients : int
        The same for products with the whole matrices A, B, C, D.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    >>> cost = lbt.interop.frame_cost(slow)
    >>> cost.multiplications, cost.dense_multiplications, cost.state_bytes_single
    (2, 16, 8)
    """

    form: str
    multiplications: int
    additions: int
    coefficients: int
    states: int
    dense_multiplications: int
    dense_additions: int
    dense_coefficients: int

    @property
    def coefficient_bytes_double(self) -> int:
        """Bytes of the coefficients in double precision."""
        return 8 * self.coefficients

    @property
    def coefficient_bytes_single(self) -> int:
        """Bytes of the coefficients in single precision."""
        return 4 * self.coefficients

    @property
    def state_bytes_double(self) -> int:
        """Bytes of the state in double precision."""
        return 8 * self.states

    @property
    def state_bytes_single(self) -> int:
        """Bytes of the state in single precision."""
        return 4 * self.states


def frame_cost(design: Design | Controller) -> FrameCost:
    """Count the arithmetic and the memory of one frame.

    Parameters
    ----------
    design : Design or Controller
        The controller, or a design with one.

    Returns
    -------
    FrameCost
        Counts for the source that :func:`export_c` writes, and for dense matrices.

    Raises
    ------
    ProblemError
        If it is neither.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lag = lbt.Controller(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]])
    >>> cost = lbt.interop.frame_cost(lag)
    >>> cost.multiplications, cost.additions, cost.dense_multiplications
    (1, 1, 4)
    """
    controller = design.controller if isinstance(design, Design) else design
    if not isinstance(controller, Controller):
        raise ProblemError(f"expected a Design or a Controller; got {type(design).__name__}.")
    whole = block_matrix(controller)
    rows, columns = whole.shape
    terms = np.count_nonzero(whole, axis=1)
    written = has_straight_line_form(controller)
    factors = int(np.count_nonzero((whole != 0) & (np.abs(whole) != 1)))
    return FrameCost(
        form="straight line" if written else "loops",
        multiplications=factors if written else whole.size,
        additions=int(np.sum(np.maximum(terms - 1, 0))) if written else whole.size,
        coefficients=factors if written else whole.size,
        states=controller.n_states,
        dense_multiplications=whole.size,
        dense_additions=rows * (columns - 1),
        dense_coefficients=whole.size,
    )


def block_matrix(controller: Controller) -> FloatArray:
    """Return ``[[A, B], [C, D]]``."""
    return np.block([[controller.A, controller.B], [controller.C, controller.D]])


def has_straight_line_form(controller: Controller) -> bool:
    """Return whether each non-zero term is written out: there are few, or half are zero."""
    whole = block_matrix(controller)
    terms = int(np.count_nonzero(whole))
    return whole.size <= _SMALL or (2 * terms <= whole.size and terms <= _LONGEST)
