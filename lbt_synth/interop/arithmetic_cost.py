"""Arithmetic and memory that a controller needs per frame."""

from __future__ import annotations

import numpy as np

from lbt_synth.design import Design
from lbt_synth.linear import Controller
from lbt_synth.linear.held_controller import as_controller
from lbt_synth.storage.rows import column, table_row
from lbt_synth.validation import FloatArray, set_fields

_SMALL = 256  # up to so many entries of [[A, B], [C, D]], every term is written out
_LONGEST = 4096  # terms that are written out at most


@table_row
class FrameCost:
    """Arithmetic and memory of one frame of a controller, as exported and with whole matrices."""

    form: str = column(
        "form of the exported source",
        help='"straight line" where each non-zero term is written out, "loops" where the source '
        "multiplies by whole matrices",
    )
    multiplications: int = column(
        "multiplications per frame",
        help="Of the exported source; factors of 1 and -1 are no multiplications",
    )
    dense_multiplications: int = column("  with whole matrices", help="The same of A, B, C, D")
    additions: int = column("additions per frame", help="Of the exported source")
    dense_additions: int = column("  with whole matrices", help="The same of A, B, C, D")
    coefficients: int = column(help="Numbers that the exported source stores")
    states: int = column(help="Numbers that it keeps between frames: states and last commands")
    coefficient_bytes_double: int = column("coefficients, double", unit="bytes", init=False)
    coefficient_bytes_single: int = column("coefficients, single", unit="bytes", init=False)
    dense_coefficients: int = column(
        "  with whole matrices, double",
        unit="bytes",
        scale=8,
        help="Numbers of the whole matrices",
    )
    state_bytes_double: int = column("state, double", unit="bytes", init=False)
    state_bytes_single: int = column("state, single", unit="bytes", init=False)

    def __post_init__(self) -> None:
        set_fields(
            self,
            coefficient_bytes_double=8 * self.coefficients,
            coefficient_bytes_single=4 * self.coefficients,
            state_bytes_double=8 * self.states,
            state_bytes_single=4 * self.states,
        )


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
    controller = as_controller(design)
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
        states=controller.n_states + len(controller.C),
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
