"""The trade-off between variance, norm and tolerated sensor gain."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import field

import numpy as np

from lbt_synth.design import FilterDesign, central_filter, hinf, kalman, mixed
from lbt_synth.design.mixed import require_taps
from lbt_synth.linear import EstimationProblem
from lbt_synth.linear.estimation_problem import require_problem
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.methods.mixed import METHOD as MIXED
from lbt_synth.storage.rows import column, fill_row, nm_column, table_row
from lbt_synth.validation import choice, integer

FAMILIES = (MIXED.name, "central")
_MOST_POINTS = 200
_CROWDING = 1.5  # above 1, points are denser near the least norm


@table_row
class TradeoffPoint:
    """One filter of the trade-off, ``design``; a problem without a loop has no margins, but nan."""

    family: str = column(
        "filter",
        help='"mixed": least variance of all filters with this norm; "central": the H-infinity '
        "filter whose norm this is",
    )
    gamma: float = nm_column(
        "norm", format=".2f", help="H-infinity norm of its estimation error, recomputed"
    )
    gamma_ratio: float = column(
        "norm / least", format=".4f", help="The same over the least norm of any filter"
    )
    rms: float = nm_column(
        "rms",
        format=".2f",
        help="Standard deviation of its estimation error, recomputed",
    )
    gain_low: float = column(
        "gain from", format=".3f", help="Least stable sensor gain", default=np.nan
    )
    gain_high: float = column(
        "gain to", format=".3f", help="Greatest stable sensor gain", default=np.nan
    )
    modulus: float = column(
        "modulus margin", format=".3f", help="Modulus margin of its loop", default=np.nan
    )
    design: FilterDesign = field(compare=False, repr=False)


def tradeoff(
    problem: EstimationProblem,
    *,
    points: int = 9,
    families: Sequence[str] = FAMILIES,
    taps: int = 16,
) -> Iterator[TradeoffPoint]:
    """Return filters from the least norm to the least variance, and examine their loops.

    The levels run from the least gamma to the norm of the Kalman filter, at which all
    families meet.

    Parameters
    ----------
    problem : EstimationProblem
        The problem; with a plant, each filter's loop is examined.
    points : int, optional
        Levels of the norm, 2 to 200.
    families : sequence of {"mixed", "central"}, optional
        Which filters to design at each level.
    taps : int, optional
        Length of the mixed filters' impulse response.

    Returns
    -------
    iterator of TradeoffPoint
        In the order of levels, then families; each is designed when it is requested.

    Raises
    ------
    ProblemError
        If a value is out of its range.
    SynthesisError
        If a design fails.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> line = lbt.EstimationProblem(
    ...     A=[[1.9, -0.99], [1.0, 0.0]],
    ...     B=[[1.0, 0.0], [0.0, 0.0]],
    ...     C=[[0.0, 1.0]],
    ...     D=[[0.0, 3.0]],
    ...     L=[[1.0, 0.0]],
    ... )
    >>> points = list(lbt.studies.tradeoff(line, points=3, families=["mixed"]))
    >>> points[0].rms > points[1].rms > points[2].rms
    True
    """
    require_problem(problem)
    count = integer(points, "points", at_least=2, at_most=_MOST_POINTS)
    length = require_taps(taps)
    for family in families:
        choice(family, "families", FAMILIES)
    return _points(problem, count, tuple(families), length)


def _points(
    problem: EstimationProblem, count: int, families: tuple[str, ...], taps: int
) -> Iterator[TradeoffPoint]:
    least, best = hinf(problem, route="riccati"), kalman(problem)
    spread = max(best.gamma / least.gamma_least, 1.0)
    for i, share in enumerate(np.linspace(0, 1, count) ** _CROWDING):
        level = least.gamma_least * float(spread**share)
        for family in families:
            if i == 0:
                design = least
            elif i == count - 1:
                design = best
            elif family == MIXED.name:
                design = mixed(problem, gamma=level, taps=taps)
            else:
                design = central_filter(problem, gamma=level)
            yield _point(design, family, least.gamma_least)


def _point(design: FilterDesign, family: str, least: float) -> TradeoffPoint:
    margins = None
    if design.hardware is not None:
        margins = loop_margins(close_loop(design.hardware, design.controller))
    ratio = max(design.gamma / least, 1.0)
    return fill_row(TradeoffPoint, design, margins, family=family, gamma_ratio=ratio, design=design)
