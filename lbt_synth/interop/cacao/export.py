"""The target cacao: a controller as a filter of the pseudo-open-loop history, cut after some steps.

At sensor gain 1 the command is a stable filter Q of the pseudo-open-loop measurement. At the gains
G, a diagonal matrix, the commands are ``Q w / D`` with ``D = 1 - (1 - G) L Q`` and the path L of
norm 1. Without a part E of Q they change by ``E w / D D'``, where ``D' = D + (1 - G) L E``: a small
gain ``|1 - G| |E / D| < 1`` keeps the loop stable. D changes by at most ``|G' - G| |Q|`` between
two gains, which bounds ``1 / |1 / D|`` there.
"""

from __future__ import annotations

import io
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lbt_synth.design import Check, Design
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.interop.pipeline import ModeDesign, Target
from lbt_synth.interop.proof import (
    LOSS,
    ROUNDOFF,
    Written,
    filter_of_history,
    mode_variances,
    proved_gains,
    scenario_gains,
)
from lbt_synth.linear import StateSpace, hinf_norm
from lbt_synth.loop import ClosedLoop, close_loop
from lbt_synth.models import LoopHardware
from lbt_synth.storage.array_file import open_fits
from lbt_synth.validation import FloatArray, integer

LONGEST_DELAY = 8  # frames; modalfilter keeps the commands of ten frames
_LONGEST = 1 << 17  # steps that are looked for
_CLOSE = 0.5  # of the least distance that is computed: a bound on all others
_ROOM = 0.98  # of the loss, for what is rounded
_MOST_NUMBERS = 100_000_000  # of the matrix: 400 MB
_SIGN = "mirror = + PFmat history; the matrix holds the controller with its sign changed"
_Numbers = tuple[NDArray[np.float32], float]  # command, step, mode of the history; delay [frames]


class AppliedFilter:
    """What ``modalfilter`` and ``applyPF`` compute in a frame, in single precision.

    The matrix (modes, steps * modes) multiplies the pseudo-open-loop values of the last frames, the
    newest first: measurements less the commands, clipped at the limit, that were applied
    ``latency`` frames ago, which in cacao's index arithmetic is a frame more than the delay.
    """

    def __init__(self, matrix: ArrayLike, delay_frames: float = 2.0, limit: float = np.inf) -> None:
        cube = np.atleast_2d(np.asarray(matrix, dtype=np.float32))
        self._matrix = cube.reshape(len(cube), -1)
        latency = np.float32(1 + delay_frames)
        self._whole, self._limit = int(latency), np.float32(limit)
        self._older = np.float32(latency - self._whole)  # weight of the older of two frames
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        modes, columns = self._matrix.shape
        self._history: NDArray[np.float32] = np.zeros((columns // modes, modes), np.float32)
        self._applied: NDArray[np.float32] = np.zeros((self._whole, modes), np.float32)

    def step(self, y: ArrayLike) -> FloatArray:
        """Take y(k), (modes,), return u(k) with the sign of our controllers, (modes,)."""
        newer, older = self._applied[-2:]
        late = (self._older * older).astype(np.float64)  # the sum of both is in double precision
        past = (late + (1.0 - float(self._older)) * newer.astype(np.float64)).astype(np.float32)
        self._history[1:] = self._history[:-1].copy()
        self._history[0] = np.asarray(y, dtype=np.float32) - past
        products = self._matrix * self._history.ravel()
        u = np.clip(np.add.accumulate(products, axis=1)[:, -1], -self._limit, self._limit)
        self._applied[1:] = self._applied[:-1].copy()
        self._applied[0] = u
        return 0.0 - u.astype(np.float64)  # a positive command of cacao adds to the measurement


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictiveFilter:
    """The filter Q of a design; ``norm`` bounds the part E that it lacks once it is cut."""

    design: Design
    hardware: LoopHardware
    system: StateSpace
    _steering: dict[float, tuple[ClosedLoop, StateSpace, float]] = field(default_factory=dict)

    def taps(self, steps: int) -> FloatArray:
        """Return the first values of the impulse response, (steps, m, m)."""
        values, x = [self.system.D], self.system.B
        for _ in range(steps - 1):
            values.append(self.system.C @ x)
            x = self.system.A @ x
        return np.array(values)

    def gains(self, gain: float) -> FloatArray:
        """Return the real sensor gains at one relative to the design's, (m, m)."""
        return np.asarray(gain * self.hardware.sensor)

    def off(self, gain: float) -> float:
        """Return how far the gains are from those that cacao counts with, ``|1 - G|``."""
        return float(np.max(np.abs(np.diag(self.gains(gain)) - 1)))

    def at(self, gain: float) -> tuple[ClosedLoop, StateSpace, float]:
        """Return the loop at a sensor gain, the filter 1 / D and its norm, made once."""
        if gain not in self._steering:
            loop = close_loop(self.hardware, self.design.controller, sensor_gain=gain)
            s, back = loop.path("noise", "reading"), np.linalg.inv(self.gains(gain))
            rest = np.eye(len(back)) - back
            inverse = replace(s, C=rest @ s.C, D=rest @ s.D + back)
            self._steering[gain] = loop, inverse, float(hinf_norm(inverse))
        return self._steering[gain]

    @cached_property
    def interval(self) -> tuple[float, float]:
        """Sensor gains for which the small gain is proved."""
        return proved_gains(self.design, self.hardware)

    def least_distance(self, enough: float) -> float:
        """Bound ``1 / |1 - G| |1 / D|`` over the interval, or return one not above enough."""
        steepness = float(np.max(self.hardware.sensor)) * float(hinf_norm(self.system))
        low, high = self.interval
        intervals, least = [(low, high)], float("inf")
        while intervals:
            a, b = intervals.pop()
            off = max(self.off(a), self.off(b))  # convex: largest at an end
            if off == 0:
                continue
            least = min(least, *(self._distance(gain) for gain in (a, b)))
            if least <= enough:
                return least
            inverses = 1 / self.at(a)[2] + 1 / self.at(b)[2]
            if (inverses - steepness * (b - a)) / 2 < _CLOSE * least * off:
                middle = (a + b) / 2
                intervals += [(a, middle), (middle, b)]
        return _CLOSE * least

    def _distance(self, gain: float) -> float:
        off = self.off(gain)
        return 1 / (off * self.at(gain)[2]) if off > 0 else float("inf")

    @cached_property
    def sizes_nm(self) -> dict[float, tuple[float, float]]:
        """The rms of the pseudo-open loop and the least residual of a mode, by sensor gain."""
        every, sizes = slice(self.hardware.modes), {}
        for gain in scenario_gains(self.design):
            if self.interval[0] <= gain <= self.interval[1]:
                loop, s, _ = self.at(gain)
                G = self.gains(gain)
                pol = replace(s, B=np.hstack([s.B @ G, s.B]), D=np.hstack([s.D @ G, s.D]))
                seen, residual = (
                    mode_variances(self.design, one, every)
                    for one in (replace(loop, system=pol), loop)
                )
                sizes[gain] = float(np.sqrt(np.sum(seen))), float(np.sqrt(np.min(residual)))
        return sizes

    def fewest_steps(self, loss: float) -> int:
        """Return the steps after which what is cut off costs at most that part of the residual."""

        def is_enough(steps: int) -> bool:
            norm = self.cut_norm(steps)
            return (norm <= loss and self.small_gain(norm) < 1) and all(
                self.residual_nm(gain, norm) <= _ROOM * loss * least_nm
                for gain, (_, least_nm) in self.sizes_nm.items()
            )

        high = 1
        while not is_enough(high):
            high *= 2
            if high > _LONGEST:
                raise NumericalError(
                    f"the filter must lose at most {100 * loss:.3g} % of residual; cut after "
                    f"{_LONGEST} steps it may still lose more. Design for wider lines, or use a "
                    "target with states.",
                    status="steps",
                    residual=_LONGEST,
                )
        return bisect_left(range(high), True, lo=high // 2 + 1, key=is_enough)

    def cut_norm(self, steps: int, taps: FloatArray | None = None) -> float:
        """Bound the norm of what is cut off after some steps, and what taps are rounded by."""
        late = self.system.C @ np.linalg.matrix_power(self.system.A, steps - 1)
        rest = replace(self.system, C=late @ self.system.A, D=late @ self.system.B)
        norm = float(hinf_norm(rest))
        if taps is not None:
            off = self.taps(steps) - taps
            norm += float(np.sum(np.linalg.norm(off, ord=2, axis=(1, 2))))
        return norm

    def small_gain(self, norm: float) -> float:
        """Bound the gain around the loop of what is left out; below 1 it keeps that stable."""
        return norm / self.least_distance(norm)

    def _peak(self, gain: float, norm: float) -> float:
        """Bound 1 / D' at a sensor gain."""
        around = self.off(gain) * self.at(gain)[2] * norm
        return self.at(gain)[2] / (1 - around) if around < 1 else float("inf")

    def response(self, gain: float, norm: float) -> float:
        """Bound the change of the sensitivities at a sensor gain."""
        largest = max(float(np.max(self.gains(gain))), 1.0)
        return largest * norm * self.at(gain)[2] * self._peak(gain, norm)

    def residual_nm(self, gain: float, norm: float) -> float:
        """Bound the rms of the residual's change at a sensor gain, over all modes."""
        return self._peak(gain, norm) * norm * self.sizes_nm[gain][0]

    def as_computed(self, taps: FloatArray) -> Written:
        """Return the filter as a controller, and the rounding of sums of its taps in any order."""
        hardware = replace(self.hardware, sensor_matrix=None)
        controller, entry = filter_of_history(hardware, self.system)
        sizes, norm = np.abs(np.hstack([*taps])), self.cut_norm(len(taps), taps)

        def variance(_gain: float, measured: FloatArray, commands: FloatArray) -> FloatArray:
            terms = sizes * np.tile(measured + commands, len(taps))
            largest = np.sum(terms, axis=1)
            sums = np.sum(terms**2, axis=1) + largest**2 * terms.shape[1]
            history = 3 * commands**2 + (measured + commands) ** 2
            return np.asarray(ROUNDOFF["single"] ** 2 / 3 * np.concatenate([sums, history]))

        low, high = self.interval
        name = f"small gain of what is left out, sensor gains {low:.4g} to {high:.4g}"
        how = "level sets, bound between gains"
        return Written(
            controllers={frozenset(): controller},
            entry=entry,
            variance=variance,
            residual_change_nm=partial(self.residual_nm, norm=norm),
            response_change=partial(self.response, norm=norm),
            checks=(Check(name, self.small_gain(norm), 1.0, how),),
        )


@lru_cache(maxsize=8)
def predictive_filter(design: Design) -> PredictiveFilter:
    """Return the filter of a design; refuse a loop that cacao's history does not know."""
    hardware = design.hardware
    if hardware is None or hardware.mirror is not None or hardware.delay_frames > LONGEST_DELAY:
        raise ProblemError(
            "the mirror must settle at once, with a total delay of at most "
            f"{LONGEST_DELAY} frames: cacao's history knows a delay alone. Use another target."
        )
    loop = close_loop(replace(hardware, sensor_matrix=None), design.controller)
    if not loop.is_stable:
        raise ProblemError(
            "cacao counts with a sensor gain of 1, at which the loop of this design is unstable. "
            "Divide the reconstructor by the sensor gain, and design for a gain of 1."
        )
    system = loop.path("noise", "command").balanced()
    return PredictiveFilter(design=design, hardware=hardware, system=system)


def _round(designs: Sequence[Design], *, steps: int | None, **_: Any) -> list[_Numbers]:
    """Return the matrix of each design, all of the same length."""
    filters = [predictive_filter(design) for design in designs]
    fewest = max(2, *(one.fewest_steps(LOSS) for one in filters)) if steps is None else steps
    count = integer(fewest, "steps", at_least=2)
    delay = filters[0].hardware.delay_frames
    return [(-one.taps(count).swapaxes(0, 1).astype(np.float32), delay) for one in filters]


def _join(numbers: Sequence[_Numbers], parts: Sequence[ModeDesign], count: int) -> _Numbers:
    """Return the matrix of all modes; refuse one that no computer multiplies in a frame."""
    (first, delay), *_ = numbers
    steps = first.shape[1]
    if steps * count**2 > _MOST_NUMBERS:
        raise NumericalError(
            f"the matrix must have at most {_MOST_NUMBERS:,} numbers; got {steps} steps of {count} "
            "modes. Give fewer steps or modes, or make a robust design that is a filter of finite "
            "length: pole 0, states null, and as many functions as steps.",
            status="steps",
            residual=steps,
        )
    whole = np.zeros((count, steps, count), dtype=np.float32)
    for (cube, _), part in zip(numbers, parts, strict=True):
        for modes in part.copies:
            whole[np.ix_(modes, range(steps), modes)] = cube
    return whole, delay


def _write(
    place: Path, whole: _Numbers, design: Design, origin: Sequence[str], **_: Any
) -> dict[Path, bytes]:
    """Return a FITS file with the matrix as its primary image, which milk loads as a stream."""
    from astropy.io import fits

    modes, steps, _columns = whole[0].shape
    unit = fits.PrimaryHDU(data=whole[0].reshape(modes, -1))
    unit.header["METHOD"] = design.method, "synthesis"
    unit.header["STEPS"] = steps, "frames of history, the newest first"
    unit.header["MODES"] = modes, "modes of a frame"
    for line in (*origin, _SIGN):
        unit.header.add_comment(line)
    unit.add_checksum(when="of this unit")
    buffer = io.BytesIO()
    unit.writeto(buffer)
    return {place: buffer.getvalue()}


def _read(files: Mapping[Path, bytes], like: _Numbers) -> _Numbers:
    """Return the matrix that a file holds."""
    with open_fits(next(iter(files.values()))) as units:
        return np.array(units[0].data, dtype=np.float32).reshape(like[0].shape), like[1]


TARGET = Target(
    precision="single",
    options={"steps": None, "modes": None, "other_gain": None},
    round=_round,
    write=_write,
    read=_read,
    computed=lambda design, numbers: predictive_filter(design).as_computed(
        -numbers[0].swapaxes(0, 1).astype(np.float64)
    ),
    start=lambda numbers, limit: AppliedFilter(numbers[0], numbers[1], limit),
    join=_join,
    facts=lambda whole, **_: {
        "steps": whole[0].shape[1],
        "latency_frames": whole[1] + 1,
        "sign": _SIGN,
    },
    hint="Give more steps, or none to have them chosen; or use a target with states, such as c.",
    endings=(".fits",),
)
