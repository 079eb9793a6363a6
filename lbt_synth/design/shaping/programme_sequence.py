"""The sequence of convex programmes that solves a specification in one basis."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.design.shaping.channel import Channel
from lbt_synth.design.shaping.frequency_bounds import ROOM
from lbt_synth.design.shaping.frequency_grid import Grid, fine_frequencies
from lbt_synth.design.shaping.objectives import noise_level
from lbt_synth.design.shaping.specification import Specification
from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.linear.convex_functions import (
    Constraint,
    Discs,
    Function,
    HalfPlanes,
    is_convex,
    leaf_fractions,
    merge_constraints,
    without_denominators,
)
from lbt_synth.validation import FloatArray

_STEPS = 24
_DECREASE = 2e-3  # of the objective, below which a step is the last
_FINE = 2048
_WORST = 2e-3  # by which a worst case may exceed that of the programme's own frequencies
_CLOSE = 0.98  # of a bound, beyond which the neighbourhood is checked more finely
_BETWEEN = 33
_RELAXED = 1e-6  # relaxations below this are none


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SequenceSolution:
    """Coefficients in one basis, and how they were found."""

    channel: Channel
    grid: Grid  # of the last programme
    coefficients: FloatArray  # (n,)
    objectives_nm2: tuple[float, ...]  # at the optimum for unit gain, and after each programme
    programmes: int  # number of them
    status: str  # what the solver said of the last programme

    @property
    def objective_nm2(self) -> float:
        """Objective over the grid [nm^2]."""
        return self.objectives_nm2[-1]


def solve_sequence(
    specification: Specification,
    channel: Channel,
    *,
    start: FloatArray | None = None,
    fineness: int = 1,
) -> SequenceSolution:
    """Minimise the objective of a specification in a basis.

    A convex specification takes one programme, and another for each time that a bound is exceeded
    between its frequencies. One with terms at other sensor gains is solved for unit gain first,
    until the demands hold at all frequencies, and goes on with upper bounds that touch the
    objective; none of these steps makes it larger or leaves the demands. ``start`` is (n,).
    """
    from lbt_synth.linear.lmi.conic_program import minimize

    grid = specification.grid(channel, fineness=fineness)
    points = fine_frequencies(channel.hardware.frame_rate_hz, channel.basis.poles, _FINE * fineness)
    fine = _FineGrid.build(specification, channel, grid, points)
    function, groups = specification.compile(channel, grid)
    convex = is_convex(function)
    scale = _objective_scale(specification, function, channel.basis.size)
    # the upper bounds need coefficients whose loops are stable at all sensor gains
    c = start if start is not None and fine.is_stable(start) else None
    aware = convex or c is not None
    values: list[float] = []
    for programmes in range(1, _STEPS + 1):
        constraints = merge_constraints(tuple(x for group in groups for x in group))
        goal = function if aware else without_denominators(function)
        solution = minimize(goal, constraints, size=channel.basis.size, scale=scale, start=c)
        if solution.coefficients is None:
            raise _infeasibility_error(specification, groups, channel.basis.size, solution.status)
        c = solution.coefficients
        values.append(function.value(c))
        excess = fine.excess(function, c)
        settled = convex or (len(values) > 1 and values[-2] - values[-1] <= _DECREASE * values[-1])
        if not aware:
            aware, settled, values = excess.size == 0, False, values[-1:]
        if excess.size == 0 and settled:
            return SequenceSolution(
                channel=channel,
                grid=grid,
                coefficients=c,
                objectives_nm2=tuple(values),
                programmes=programmes,
                status=solution.status,
            )
        if excess.size:
            grid = grid.with_points(excess)
            function, groups = specification.compile(channel, grid)
    raise NumericalError(
        f"the shaped loop exceeds its bounds between the {grid.points_hz.size} frequencies of its "
        f"programme, or does not settle, after {_STEPS} programmes. Try fewer functions, or "
        "looser bounds.",
        status="frequencies",
        residual=float(excess.size),
    )


def _objective_scale(specification: Specification, function: Function, size: int) -> float:
    """Guess the final size of the objective, within a few powers of ten [nm^2]."""
    return max(4 * noise_level(specification.objective) ** 2, 1e-4 * function.value(np.zeros(size)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _FineGrid:
    """Bounds and worst cases at frequencies between those of the programme."""

    specification: Specification
    channel: Channel
    grid: Grid
    function: Function
    constraints: tuple[Constraint, ...]

    @classmethod
    def build(
        cls, specification: Specification, channel: Channel, grid: Grid, points_hz: FloatArray
    ) -> _FineGrid:
        fine = replace(grid, points_hz=points_hz)
        function, groups = specification.compile(channel, fine)
        return cls(
            specification=specification,
            channel=channel,
            grid=fine,
            function=function,
            constraints=merge_constraints(tuple(c for group in groups for c in group)),
        )

    def is_stable(self, c: FloatArray) -> bool:
        """Whether the half-planes of the sensor gains hold, without the room."""
        planes = [x for x in self.constraints if isinstance(x, HalfPlanes)]
        return all(float(np.max(plane.use(c))) * (1 - ROOM) < 1 for plane in planes)

    def excess(self, function: Function, c: FloatArray) -> FloatArray:
        """Frequencies at which bounds, or the programme's own worst cases, are exceeded [Hz]."""
        limits = tuple(
            leaf.value(c) * (1 + _WORST) if leaf.worst else np.inf
            for leaf in leaf_fractions(function)
        )
        found = self._peaks_above(limits, c, 1 + ROOM / 2)
        if found.size:
            return found[:, 1]
        # between the neighbours of what comes close
        close = self._peaks_above(limits, c, _CLOSE)
        if not close.size:
            return np.zeros(0)
        points = np.unique(np.linspace(close[:, 0], close[:, 2], _BETWEEN))
        finer = self.build(self.specification, self.channel, self.grid, points)
        return finer._peaks_above(limits, c, 1 + ROOM / 2)[:, 1]

    def _peaks_above(self, limits: tuple[float, ...], c: FloatArray, level: float) -> FloatArray:
        """Local peaks above a level of their limits, each between its neighbours, (k, 3)."""
        bounds = [
            _local_peaks(constraint.frequency_hz, constraint.use(c), level)
            for constraint in self.constraints
            if isinstance(constraint, Discs | HalfPlanes)
        ]
        worst = [
            _local_peaks(leaf.frequency_hz, leaf.values(c), limit * level)
            for leaf, limit in zip(leaf_fractions(self.function), limits, strict=True)
            if leaf.worst
        ]
        return np.unique(np.concatenate([np.zeros((0, 3)), *bounds, *worst]), axis=0)


def _local_peaks(frequency_hz: FloatArray, values: FloatArray, limit: float) -> FloatArray:
    """Local peaks above a limit, with the frequencies before and after each, (k, 3)."""
    order = np.argsort(frequency_hz, kind="stable")
    f, v = frequency_hz[order], values[order]
    inner = np.r_[True, v[1:] >= v[:-1]] & np.r_[v[:-1] >= v[1:], True]
    at = np.nonzero(inner & (v > limit))[0]
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, f.size - 1)
    return np.stack([f[before], f[at], f[after]], axis=1)


def _infeasibility_error(
    specification: Specification,
    groups: tuple[tuple[Constraint, ...], ...],
    size: int,
    status: str,
) -> InfeasibleError | NumericalError:
    """Error that names a smallest set of demands that cannot hold, and how far each is off."""
    from lbt_synth.linear.lmi.conic_program import minimize_relaxation

    labels = [demand.label for demand in specification.demands]
    free = (False,) * len(groups)
    if not groups or np.max(minimize_relaxation(groups, size=size, rigid=free)) <= _RELAXED:
        return NumericalError(
            f"the programme of the shaped loop ended as {status!r}; expected an optimum. Try "
            "another number of functions.",
            status=status,
        )
    core = list(range(len(groups)))
    for candidate in range(len(groups)):  # a demand without which the rest still clashes may go
        rest = [i for i in core if i != candidate]
        if not rest:
            continue
        relaxed = minimize_relaxation(
            tuple(groups[i] for i in rest), size=size, rigid=(False,) * len(rest)
        )
        if np.max(relaxed) > _RELAXED:
            core = rest
    listing = []
    for i in core:
        relaxed = minimize_relaxation(
            tuple(groups[j] for j in core), size=size, rigid=tuple(j != i for j in core)
        )
        factor = 1 + float(relaxed[core.index(i)])
        size_text = f"{factor:.4g}" if factor > 1.001 else f"1 + {factor - 1:.1g}"
        amount = f"alone it must be relaxed by a factor of {size_text}"
        listing.append(f"{labels[i]} ({amount if np.isfinite(factor) else 'no relaxation helps'})")
    together = "cannot hold" if len(core) == 1 else "cannot hold together"
    return InfeasibleError(
        f"these demands {together} with {size} functions: {'; '.join(listing)}. Relax one of "
        f"them, or leave one out; {100 * ROOM:g} % of each bound is kept for what lies between the "
        "frequencies.",
        conflict=tuple(labels[i] for i in core),
    )
