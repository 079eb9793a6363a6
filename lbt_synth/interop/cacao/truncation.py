"""A controller as a filter of the pseudo-open-loop history, cut after some steps.

In the loop that a design believes, the command is a stable filter Q of the pseudo-open-loop
measurement, whatever the controller (:func:`lbt_synth.loop.youla_controller`), and every stable Q
keeps that loop stable. At the sensor gain g, with the path L of norm 1, the commands are
``Q w / D`` with ``D = 1 - (1 - g) L Q``. Without a part E of Q they change by ``E w / D D'``, where
``D' = D + (1 - g) L E``: no more than a small gain, ``|1 - g| |E / D| < 1``, allows.

For all gains of an interval: ``|1 - g| |1 / D|`` is one over the least singular value, over
frequency, of ``p - L Q``, ``p = 1 / (1 - g)``. That distance changes by no more than p does, which
bounds it between two gains.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from lbt_synth.design import Check, Design
from lbt_synth.errors import NumericalError
from lbt_synth.interop.written_loop import (
    ROUNDOFF,
    Rounding,
    mode_variances,
    prove_written,
    proved_gains,
    scenario_gains,
)
from lbt_synth.linear import Controller, StateSpace, hinf_norm
from lbt_synth.loop import ClosedLoop, close_loop, youla_controller
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray

_LONGEST = 1 << 17  # steps that are looked for
_CLOSE = 0.5  # of the least distance that is computed: a bound on all others
_ROOM = 0.98  # of the loss, for what is rounded


class _Steering(NamedTuple):
    """The loop of a design at a sensor gain, and 1 / D, the filter to the pseudo-open loop."""

    loop: ClosedLoop
    inverse: StateSpace
    peak: float  # norm of 1 / D


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictiveFilter:
    """The filter from the pseudo-open-loop measurements to the commands of a design."""

    design: Design
    hardware: LoopHardware
    system: StateSpace
    _steering: dict[float, _Steering] = field(default_factory=dict)

    def taps(self, steps: int) -> FloatArray:
        """Return the first values of the impulse response, (steps, m, m)."""
        values, x = [self.system.D], self.system.B
        for _ in range(steps - 1):
            values.append(self.system.C @ x)
            x = self.system.A @ x
        return np.array(values)

    def at(self, gain: float) -> _Steering:
        """Return the loop at a sensor gain, made once."""
        if gain not in self._steering:
            loop = close_loop(self.hardware, self.design.controller, sensor_gain=gain)
            s, each = loop.output_sensitivity(), np.eye(self.hardware.modes)
            inverse = replace(s, C=(1 - 1 / gain) * s.C, D=(1 - 1 / gain) * s.D + each / gain)
            self._steering[gain] = _Steering(loop, inverse, float(hinf_norm(inverse)))
        return self._steering[gain]

    @cached_property
    def interval(self) -> tuple[float, float]:
        """Sensor gains for which the small gain is proved."""
        return proved_gains(self.design, self.hardware)

    def least_distance(self, enough: float) -> float:
        """Return a lower bound on the distance of L Q from ``1 / (1 - g)`` within the interval.

        Where one is found that is not above ``enough``, it is returned.
        """
        least = float("inf")
        for end, stop in self._places():
            own = self._distance(end)
            if stop is None:  # beyond this place the distance is larger than at the end
                stop = float(np.copysign(float(hinf_norm(self.system)) + own, end))
            parts = [((end, own), (stop, self._distance(stop)))]
            while parts:
                (a, at_a), (b, at_b) = parts.pop()
                least = min(least, at_a, at_b)
                if least <= enough:
                    return least
                if (at_a + at_b - abs(b - a)) / 2 < _CLOSE * least:
                    middle = (a + b) / 2
                    between = middle, self._distance(middle)
                    parts += [((a, at_a), between), (between, (b, at_b))]
        return _CLOSE * least

    def _places(self) -> list[tuple[float, float | None]]:
        """Return the intervals of ``1 / (1 - g)``; at g = 1 one goes on without end."""
        low, high = self.interval
        out: list[tuple[float, float | None]] = []
        if low < 1:
            out.append((1 / (1 - low), 1 / (1 - high) if high < 1 else None))
        if high > 1:
            out.append((1 / (1 - high), 1 / (1 - low) if low > 1 else None))
        return out

    def _distance(self, place: float) -> float:
        return abs(place) / self.at(1 - 1 / place).peak

    @cached_property
    def sizes_nm(self) -> dict[float, tuple[float, float]]:
        """The rms of the pseudo-open loop, all modes, and that of the least residual of a mode.

        At each sensor gain of the proof.
        """
        every, sizes = slice(self.hardware.modes), {}
        for gain in scenario_gains(self.design):
            if self.interval[0] <= gain <= self.interval[1]:
                loop, s, _ = self.at(gain)
                pol = replace(s, B=np.hstack([gain * s.B, s.B]), D=np.hstack([gain * s.D, s.D]))
                seen, left = (
                    mode_variances(self.design, one, every)
                    for one in (replace(loop, system=pol), loop)
                )
                sizes[gain] = float(np.sqrt(np.sum(seen))), float(np.sqrt(np.min(left)))
        return sizes

    def fewest_steps(self, loss: float) -> int:
        """Return the steps after which what is cut off costs at most that part of the residual."""
        high = 1
        while not self._is_enough(high, loss):
            high *= 2
            if high > _LONGEST:
                raise NumericalError(
                    f"the filter must lose at most {100 * loss:.3g} % of residual; cut after "
                    f"{_LONGEST} steps it may still lose more. Design for wider lines, or use a "
                    "target with states.",
                    status="steps",
                    residual=_LONGEST,
                )
        low = high // 2
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if self._is_enough(middle, loss) else (middle, high)
        return high

    def _is_enough(self, steps: int, loss: float) -> bool:
        cut = CutFilter(whole=self, steps=steps)
        if cut.norm > loss or cut.small_gain >= 1:
            return False
        return all(
            cut.residual_nm(gain) <= _ROOM * loss * own for gain, (_, own) in self.sizes_nm.items()
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class CutFilter:
    """What a filter that is cut after some steps lacks, and the taps that are left, as rounded."""

    whole: PredictiveFilter
    steps: int
    taps: FloatArray | None = None  # (steps, m, m)

    @cached_property
    def norm(self) -> float:
        """Bound on the norm of what is left out: what is cut off, and what taps are rounded by."""
        system = self.whole.system
        late = system.C @ np.linalg.matrix_power(system.A, self.steps - 1)
        norm = float(hinf_norm(replace(system, C=late @ system.A, D=late @ system.B)))
        if self.taps is not None:
            off = self.whole.taps(self.steps) - self.taps
            norm += float(np.sum(np.linalg.norm(off, ord=2, axis=(1, 2))))
        return norm

    def _gain_around(self, gain: float) -> float:
        return abs(1 - gain) * self.whole.at(gain).peak * self.norm

    @cached_property
    def small_gain(self) -> float:
        """Bound on the gain around the loop of what is left out; below 1 it keeps that stable."""
        return self.norm / self.whole.least_distance(self.norm)

    def _peak(self, gain: float) -> float:
        """Bound on 1 / D' at a sensor gain."""
        around = self._gain_around(gain)
        return self.whole.at(gain).peak / (1 - around) if around < 1 else float("inf")

    def response(self, gain: float) -> float:
        """Bound the change of the sensitivities at a sensor gain."""
        return max(gain, 1.0) * self.norm * self.whole.at(gain).peak * self._peak(gain)

    def residual_nm(self, gain: float) -> float:
        """Bound the rms of the residual's change at a sensor gain, over all modes."""
        return self._peak(gain) * self.norm * self.whole.sizes_nm[gain][0]

    def prove(self) -> tuple[Check, ...]:
        """Check the loop around the filter, in single precision, with products in any order."""
        assert self.taps is not None  # what is proved has been rounded
        checks = prove_written(self.whole.design, *self._as_computed(self.taps), left_out=self)
        low, high = self.whole.interval
        name = f"small gain of what is left out, sensor gains {low:.4g} to {high:.4g}"
        return (*checks, Check(name, self.small_gain, 1.0, "level sets, bound between gains"))

    def _as_computed(self, taps: FloatArray) -> tuple[Controller, Rounding]:
        """Return the filter of the design as a controller, and the rounding of the taps' sums."""
        hardware, s = self.whole.hardware, self.whole.system
        m, n = hardware.modes, s.n_states
        # the last command is a state
        parameter = Controller(
            A=np.block([[s.A, np.zeros((n, m))], [s.C, np.zeros((m, m))]]),
            B=np.vstack([s.B, s.D]),
            C=np.eye(m, n + m, k=n),
            D=np.zeros((m, m)),
            dt_s=s.dt_s,
        )
        written = youla_controller(hardware, parameter)
        # noise in the product is part of the command; noise in the history comes as a measurement
        command = np.eye(written.n_states, m, k=-n)
        entry = replace(written, B=np.hstack([command, written.B]), D=np.zeros((m, 2 * m)))
        sizes = np.abs(np.hstack([*taps]))

        def variance(_gain: float, measured: FloatArray, commands: FloatArray) -> FloatArray:
            terms = sizes * np.tile(measured + commands, len(taps))
            largest = np.sum(terms, axis=1)
            sums = np.sum(terms**2, axis=1) + largest**2 * terms.shape[1]
            history = 3 * commands**2 + (measured + commands) ** 2
            return np.asarray(ROUNDOFF["single"] ** 2 / 3 * np.concatenate([sums, history]))

        return written, Rounding(entry=entry, variance=variance)


def predictive_filter(design: Design, hardware: LoopHardware) -> PredictiveFilter:
    """Return the filter of a design, whose loop must have as many commands as modes."""
    loop = close_loop(hardware, design.controller)
    loop.require_stable()
    s, n = loop.commanding(), hardware.modes
    system = replace(s, B=s.B[:, n:], D=s.D[:, n:]).balanced()
    return PredictiveFilter(design=design, hardware=hardware, system=system)
