"""A specification solved in one basis by convex programmes, and again with few functions."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.design.shaping.channel import Channel, mode_loop
from lbt_synth.design.shaping.frequencies import ROOM, Grid, fine_frequencies
from lbt_synth.design.shaping.specification import Specification
from lbt_synth.design.shaping.terms import frequency_costs, noise_level
from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.linear import Controller
from lbt_synth.linear.convex_functions import (
    Discs,
    Function,
    HalfPlanes,
    merge_constraints,
    total_value,
)
from lbt_synth.validation import FloatArray

_STEPS = 24
_DECREASE = 1e-6  # of the objective, below which a step is the last
_LEAST_SHARE = 1e-3  # of a step that is tried
_PENALTY = 10.0  # relative rise of the objective that a relative excess of a bound is worth
_FINE = 2048  # frequencies, at least, at which bounds are looked at between those of a programme
_NOTHING_NM2 = 1e-6  # a residual of a picometre, with which none is compared
_MISS = 2e-3  # by which an objective or a worst case may exceed that of the programme's frequencies
_FLAT = 0.1  # weight of the whole response, beside the spectra: demands hold at all frequencies
_RELAXED = 1e-6  # relaxations below this are none


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModeSolution:
    """A specification solved in one basis."""

    channel: Channel
    grid: Grid  # of the last programme
    coefficients: FloatArray  # (n,)
    objectives_nm2: tuple[float, ...]  # at the optimum for unit gain, and after each programme
    status: str  # what the solver said of the last programme
    objective_nm: float  # root of the objective in the real loop

    @property
    def parameter(self) -> Controller:
        """The Youla parameter."""
        return self.channel.basis.parameter(self.coefficients)


def solve_mode(
    spec: Specification, channel: Channel, *, start: FloatArray | None = None
) -> ModeSolution:
    """Solve a specification in a basis, from coefficients (n,) if given.

    A convex specification takes one programme, and another for each time that a bound is exceeded
    between its frequencies. One with terms at other sensor gains is solved for unit gain first,
    until the loop is stable at all of them, and goes on with steps to the optimum of a model of the
    objective, as far as they lower it, until the demands hold at all frequencies. The grid becomes
    finer until its objective is that of the real loop, which keeps all demands.
    """
    miss = np.inf
    for fineness in (1, 2, 4):
        programme = _Programme(spec, channel, fineness)
        c, values = _minimise(programme, start)
        loop = mode_loop(channel.hardware, channel.basis.parameter(c))
        exact = spec.measured_nm2(loop)
        miss = abs(values[-1] - exact) / max(exact, _NOTHING_NM2)
        if miss < _MISS and all(check.passed for check in spec.checks(loop)):
            return ModeSolution(
                channel=channel,
                grid=programme.grid,
                coefficients=c,
                objectives_nm2=tuple(values),
                status=programme.status,
                objective_nm=float(np.sqrt(exact)),
            )
    raise NumericalError(
        f"the objective over the frequencies of the programme misses that of the real loop by "
        f"{miss:.2g}, expected {_MISS:g}, or a bound is exceeded between them. Try "
        "fewer functions, a smoother spectrum, or wider bands.",
        status="quadrature",
    )


def _minimise(programme: _Programme, start: FloatArray | None) -> tuple[FloatArray, list[float]]:
    """Return coefficients, and the objective over the grid after each programme."""
    convex = all(part.steering is None for part in programme.function)
    # the steps need coefficients whose loops are stable at all sensor gains
    if not convex and start is not None and programme.is_stable(start):
        return _lower_objective(programme, start, [])
    while True:  # at unit gain, until all demands hold, or the loop is stable
        c = programme.solve(tuple(replace(part, steering=None) for part in programme.function))
        if not programme.refine(c) or (not convex and programme.is_stable(c)):
            break
    values = [total_value(programme.function, c)]
    return (c, values) if convex else _lower_objective(programme, c, values)


def _lower_objective(
    programme: _Programme, c: FloatArray, values: list[float]
) -> tuple[FloatArray, list[float]]:
    """Lower the objective by steps to the optimum of its model at c; append its values."""
    while True:
        step, before = programme.solve(programme.function, start=c) - c, programme.merit(c)
        share = 1.0
        while programme.merit(c + share * step) > before and share > _LEAST_SHARE:
            share /= 2
        c = c + share * step
        values.append(total_value(programme.function, c))
        settled = before - programme.merit(c) <= _DECREASE * before
        if not programme.refine(c) and settled:
            return c, values


class _Programme:
    """The conic programme of a specification, on a grid that grows where bounds are exceeded."""

    def __init__(self, specification: Specification, channel: Channel, fineness: int) -> None:
        self.specification, self.channel = specification, channel
        self.grid = specification.grid(channel, fineness=fineness)
        self.function, self.groups = specification.compile(channel, self.grid)
        self.size, self.solved, self.status = channel.basis.size, 0, ""
        # a guess of the final objective, within a few powers of ten
        zero = 1e-4 * total_value(self.function, np.zeros(self.size))
        self.scale = max(4 * noise_level(specification.terms) ** 2, zero)
        self._excess = np.zeros(0)
        fine = replace(self.grid, points_hz=fine_frequencies(channel, _FINE * fineness))
        function, groups = specification.compile(channel, fine)
        self._fine = function, merge_constraints(groups)

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
        held = merge_constraints(self.groups)
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
        return total_value(self.function, c) * (1 + _PENALTY * max(excess, 0.0))

    def refine(self, c: FloatArray) -> bool:
        """Add the frequencies at which coefficients exceed bounds; return whether there are any."""
        self._excess = self._find_excess(c)
        if self._excess.size:
            self.grid = replace(self.grid, points_hz=np.union1d(self.grid.points_hz, self._excess))
            self.function, self.groups = self.specification.compile(self.channel, self.grid)
        return self._excess.size > 0

    def _find_excess(self, c: FloatArray) -> FloatArray:
        """Frequencies at which bounds, or the programme's own worst cases, are exceeded [Hz]."""
        function, constraints = self._fine
        uses = [
            (fine.frequency_hz, fine.values(c) / (coarse.value(c) * (1 + _MISS)))
            for coarse, fine in zip(self.function, function, strict=True)
            if fine.worst
        ]
        uses += [
            (bound.frequency_hz, bound.use(c))
            for bound in constraints
            if isinstance(bound, Discs | HalfPlanes)
        ]
        peaks = [_local_peaks(f, use, 1 + ROOM / 2) for f, use in uses]
        return np.unique(np.concatenate([np.zeros(0), *peaks]))


def _local_peaks(frequency_hz: FloatArray, values: FloatArray, limit: float) -> FloatArray:
    """Return the frequencies of local peaks above a limit, (k,)."""
    order = np.argsort(frequency_hz, kind="stable")
    f, v = frequency_hz[order], values[order]
    inner = np.r_[True, v[1:] >= v[:-1]] & np.r_[v[:-1] >= v[1:], True]
    return np.asarray(f[inner & (v > limit)])


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


def reduce_mode(
    spec: Specification, long: ModeSolution, most: int, tolerance: float
) -> ModeSolution:
    """Solve with as few functions as keep the objective of a long parameter within a tolerance."""
    accepted, losses = None, [np.inf]
    for size in range(most, 0, -1):
        shorter = solve_with_few(spec, long, size)
        losses.append(np.inf if shorter is None else shorter.objective_nm / long.objective_nm - 1)
        if losses[-1] <= tolerance:
            accepted = shorter
        elif size < most and losses[-2] > tolerance:  # two in a row: a size alone may be unlucky
            break
    if accepted is not None:
        return accepted
    states = most + long.channel.hardware.mirror_system.whole.n_states
    best, advice = "none was feasible", f"Try states={2 * states}."
    if np.isfinite(loss := min(losses)):
        best = f"the best lost {100 * loss:.3g} %"
        advice = f"Try states={2 * states} or loss={1.1 * loss:.2g}."
    raise InfeasibleError(
        f"no controller of {states} states per mode came within {100 * tolerance:.3g} % of the "
        f"long parameter's {long.objective_nm:.4g} nm (root of the whole objective): {best}. "
        f"{advice}"
    )


def solve_with_few(spec: Specification, long: ModeSolution, size: int) -> ModeSolution | None:
    """Solve with the few functions that a long parameter needs most; None where they fail.

    The response counts at each frequency as much as an error of it costs.
    """
    channel, f, w = long.channel, long.grid.nodes_hz, long.grid.weights_hz
    basis, nyquist = channel.basis, channel.nyquist_hz
    noise = noise_level(spec.terms) ** 2 / nyquist
    cost = w * (frequency_costs(spec.terms, f, 2 * nyquist) + noise)
    weight = np.sqrt(cost / np.sum(cost) + _FLAT**2 * w / nyquist)
    few, start = basis.truncated(long.coefficients, size, f, weight)
    shorter = Channel(hardware=channel.hardware, basis=few)
    try:
        return solve_mode(spec, shorter, start=start)
    except (InfeasibleError, NumericalError):
        return None
