"""The sequence of convex programmes that solves a specification in one basis."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.design.shaping.channel import Channel
from lbt_synth.design.shaping.frequencies import ROOM, Grid, fine_frequencies
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
_DECREASE = 1e-6  # of the objective, below which a step is the last
_LEAST_SHARE = 1e-3  # of a step that is tried
_PENALTY = 10.0  # relative rise of the objective that a relative excess of a bound is worth
_FINE = 2048
_WORST = 2e-3  # by which a worst case may exceed that of the programme's own frequencies
_CLOSE = 0.98  # of a bound, beyond which the neighbourhood is checked more finely
_BETWEEN = 33
_RELAXED = 1e-6  # relaxations below this are none


@dataclass(frozen=True, slots=True, eq=False)
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
    spec: Specification, channel: Channel, *, start: FloatArray | None = None, fineness: int = 1
) -> SequenceSolution:
    """Minimise the objective of a specification in a basis, from coefficients (n,) if given.

    A convex specification takes one programme, and another for each time that a bound is exceeded
    between its frequencies. One with terms at other sensor gains is solved for unit gain first,
    until the loop is stable at all of them, and goes on with steps to the optimum of a model of the
    objective, as far as they lower it, until the demands hold at all frequencies.
    """
    programme = _Programme(spec, channel, fineness)
    convex, values = is_convex(programme.function), []
    # the steps need coefficients whose loops are stable at all sensor gains
    if convex or start is None or not programme.is_stable(start):
        c = _minimize_at_unit_gain(programme, convex=convex)
        values.append(programme.function.value(c))
    else:
        c = start
    if not convex:
        c = _lower_objective(programme, c, values)
    solved, status = programme.solved, programme.status
    return SequenceSolution(channel, programme.grid, c, tuple(values), solved, status)


def _minimize_at_unit_gain(programme: _Programme, *, convex: bool) -> FloatArray:
    """Minimise the objective at unit gain, until all demands hold, or the loop is stable."""
    while True:
        c = programme.solve(without_denominators(programme.function))
        if not programme.refine(c) or (not convex and programme.is_stable(c)):
            return c


def _lower_objective(programme: _Programme, c: FloatArray, values: list[float]) -> FloatArray:
    """Lower the objective by steps to the optimum of its model at c; append its values."""
    while True:
        step, before = programme.solve(programme.function, start=c) - c, programme.merit(c)
        share = 1.0
        while programme.merit(c + share * step) > before and share > _LEAST_SHARE:
            share /= 2
        c = c + share * step
        values.append(programme.function.value(c))
        settled = before - programme.merit(c) <= _DECREASE * before
        if not programme.refine(c) and settled:
            return c


class _Programme:
    """The conic programme of a specification, on a grid that grows where bounds are exceeded."""

    def __init__(self, specification: Specification, channel: Channel, fineness: int) -> None:
        self.specification, self.channel = specification, channel
        self.grid = specification.grid(channel, fineness=fineness)
        self.function, self.groups = specification.compile(channel, self.grid)
        self.size, self.solved, self.status = channel.basis.size, 0, ""
        # a guess of the final objective, within a few powers of ten
        zero = 1e-4 * self.function.value(np.zeros(self.size))
        self.scale = max(4 * noise_level(specification.objective) ** 2, zero)
        self._excess = np.zeros(0)
        self._fine = self._between(fine_frequencies(channel, _FINE * fineness))

    def solve(self, function: Function, start: FloatArray | None = None) -> FloatArray:
        """Minimise a function under all demands; return the coefficients (n,)."""
        from lbt_synth.linear.lmi.conic_program import minimize

        if self.solved == _STEPS:
            raise NumericalError(
                f"the shaped loop exceeds its bounds between the {self.grid.points_hz.size} "
                f"frequencies of its programme, or does not settle, after {_STEPS} programmes. Try "
                "fewer functions, or looser bounds.",
                status="frequencies",
                residual=float(self._excess.size),
            )
        self.solved += 1
        held = _merge_groups(self.groups)
        c, self.status = minimize(function, held, size=self.size, scale=self.scale, start=start)
        if c is None:
            raise _infeasibility_error(self)
        return c

    def is_stable(self, c: FloatArray) -> bool:
        """Whether the half-planes of the sensor gains hold at all frequencies, without the room."""
        planes = [x for x in self._fine[1] if isinstance(x, HalfPlanes)]
        return all(float(np.max(plane.use(c))) * (1 - ROOM) < 1 for plane in planes)

    def merit(self, c: FloatArray) -> float:
        """Objective at coefficients c, larger where they exceed bounds."""
        bounds = [bound for group in self.groups for bound in group]
        planes = [bound for bound in bounds if isinstance(bound, Discs | HalfPlanes)]
        excess = max((float(np.max(plane.use(c))) - 1 for plane in planes), default=0.0)
        return self.function.value(c) * (1 + _PENALTY * max(excess, 0.0))

    def refine(self, c: FloatArray) -> bool:
        """Add the frequencies at which coefficients exceed bounds; return whether there are any."""
        self._excess = self._find_excess(c)
        if self._excess.size:
            self.grid = self.grid.with_points(self._excess)
            self.function, self.groups = self.specification.compile(self.channel, self.grid)
        return self._excess.size > 0

    def _find_excess(self, c: FloatArray) -> FloatArray:
        """Frequencies at which bounds, or the programme's own worst cases, are exceeded [Hz]."""
        leaves = leaf_fractions(self.function)
        limits = [leaf.value(c) * (1 + _WORST) if leaf.worst else np.inf for leaf in leaves]

        def peaks(fine: tuple[Function, tuple[Constraint, ...]], level: float) -> FloatArray:
            """Local peaks above a level of their limits, each between its neighbours, (k, 3)."""
            bounds = [bound for bound in fine[1] if isinstance(bound, Discs | HalfPlanes)]
            found = [_local_peaks(bound.frequency_hz, bound.use(c), level) for bound in bounds]
            found += [
                _local_peaks(leaf.frequency_hz, leaf.values(c), limit * level)
                for leaf, limit in zip(leaf_fractions(fine[0]), limits, strict=True)
                if leaf.worst
            ]
            return np.unique(np.concatenate([np.zeros((0, 3)), *found]), axis=0)

        found = peaks(self._fine, 1 + ROOM / 2)
        close = found if found.size else peaks(self._fine, _CLOSE)
        if found.size or not close.size:
            return close[:, 1]
        # between the neighbours of what comes close
        finer = self._between(np.unique(np.linspace(close[:, 0], close[:, 2], _BETWEEN)))
        return peaks(finer, 1 + ROOM / 2)[:, 1]

    def _between(self, points_hz: FloatArray) -> tuple[Function, tuple[Constraint, ...]]:
        """Return the objective and the constraints at other points."""
        grid = replace(self.grid, points_hz=points_hz)
        function, groups = self.specification.compile(self.channel, grid)
        return function, _merge_groups(groups)


def _merge_groups(groups: tuple[tuple[Constraint, ...], ...]) -> tuple[Constraint, ...]:
    """Return the constraints of all demands, as few as possible."""
    return merge_constraints(tuple(constraint for group in groups for constraint in group))


def _local_peaks(frequency_hz: FloatArray, values: FloatArray, limit: float) -> FloatArray:
    """Local peaks above a limit, with the frequencies before and after each, (k, 3)."""
    order = np.argsort(frequency_hz, kind="stable")
    f, v = frequency_hz[order], values[order]
    inner = np.r_[True, v[1:] >= v[:-1]] & np.r_[v[:-1] >= v[1:], True]
    at = np.nonzero(inner & (v > limit))[0]
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, f.size - 1)
    return np.stack([f[before], f[at], f[after]], axis=1)


def _infeasibility_error(programme: _Programme) -> InfeasibleError | NumericalError:
    """Error that names a smallest set of demands that cannot hold, and how far each is off."""
    from lbt_synth.linear.lmi.conic_program import minimize_relaxation

    groups, size = programme.groups, programme.size

    def relaxations(chosen: list[int], relaxed: Container[int]) -> FloatArray:
        rigid = tuple(i not in relaxed for i in chosen)
        return minimize_relaxation(tuple(groups[i] for i in chosen), size=size, rigid=rigid)

    labels = [demand.label for demand in programme.specification.demands]
    core = list(range(len(groups)))
    if not groups or np.max(relaxations(core, core)) <= _RELAXED:
        return NumericalError(
            f"the programme of the shaped loop ended as {programme.status!r}; expected an optimum. "
            "Try another number of functions.",
            status=programme.status,
        )
    for candidate in range(len(groups)):  # a demand without which the rest still clashes may go
        rest = [i for i in core if i != candidate]
        if rest and np.max(relaxations(rest, rest)) > _RELAXED:
            core = rest
    listing = []
    for place, i in enumerate(core):
        factor = 1 + float(relaxations(core, [i])[place])
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
