"""A controller as a filter of the pseudo-open-loop history, cut after some steps.

In the loop that a design believes, the command is a stable filter Q of the pseudo-open-loop
measurement, whatever the controller (:mod:`lbt_synth.loop.youla`), and every stable Q keeps that
loop stable. At a sensor gain g, what is left out of Q must meet a small gain as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.design import Check, Design
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.interop.written_loop import ROUNDOFF, Rounding, mode_variances, proved_gains
from lbt_synth.linear import Controller, StateSpace, hinf_norm
from lbt_synth.loop import ClosedLoop, close_loop, youla_controller
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray, frozen_copy

_LONGEST = 1 << 17  # steps that are looked for
_GAINS = 9  # at which the small gain is computed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictiveFilter:
    """The filter from the pseudo-open-loop measurements to the commands of a design."""

    design: Design
    loop: ClosedLoop
    system: StateSpace

    def taps(self, steps: int) -> FloatArray:
        """Return the first values of the impulse response, (steps, m, q)."""
        values, x = [self.system.D], self.system.B
        for _ in range(steps - 1):
            values.append(self.system.C @ x)
            x = self.system.A @ x
        return np.array(values)

    def loss_bound(self, steps: int) -> float:
        """Bound the relative loss of residual, at unit sensor gain, by what is left out."""
        n, s = self.loop.hardware.modes, self.loop.commanding()
        B, D = s.B.copy(), s.D.copy()
        B[:, :n], D[:, :n] = s.A @ s.B[:, :n], s.C @ s.B[:, :n]  # measured a frame later
        left_out = replace(self.loop, system=_drop_steps(replace(s, B=B, D=D), steps))
        lost = mode_variances(self.design, left_out, slice(n))
        return float(np.max(np.sqrt(lost / mode_variances(self.design, self.loop, slice(n)))))

    def fewest_steps(self, loss: float) -> int:
        """Return the steps after which the bound on the loss is met."""
        high = 1
        while self.loss_bound(high) > loss:
            high *= 2
            if high > _LONGEST:
                raise NumericalError(
                    f"cut after {_LONGEST} steps, the filter still loses up to "
                    f"{100 * self.loss_bound(_LONGEST):.3g} % of residual; the limit is "
                    f"{100 * loss:.3g} %. Design for wider lines, or use a target with states.",
                    status="steps",
                )
        low = high // 2
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if self.loss_bound(middle) > loss else (low, middle)
        return high


def predictive_filter(design: Design) -> PredictiveFilter:
    """Return the filter of a design, whose loop must have as many commands as modes."""
    assert design.hardware is not None  # the caller refuses a design without a loop
    loop = close_loop(design.hardware, design.controller)
    loop.require_stable()
    s, n = loop.commanding(), design.hardware.modes
    return PredictiveFilter(
        design=design, loop=loop, system=replace(s, B=s.B[:, n:], D=s.D[:, n:]).balanced()
    )


def written_filter(taps: FloatArray, hardware: LoopHardware) -> tuple[Controller, Rounding]:
    """Return the controller of a filter with these taps (steps, m, m), and its rounding.

    The bound on the rounding holds for products that are added up in any order.
    """
    steps, m, _ = taps.shape
    if not np.any(taps[0]):
        raise ProblemError("the first step of the filter must not be zero. Use another target.")
    each = np.eye(m)
    parameter = Controller(
        A=frozen_copy(np.kron(np.eye(steps, k=-1), each)),
        B=frozen_copy(np.kron(np.eye(steps, 1), each)),
        C=np.hstack([np.zeros((m, m)), *taps[1:]]),
        D=taps[0],
        dt_s=hardware.dt_s,
    )
    written = youla_controller(hardware, parameter)
    # noise in the product is part of the command; noise in the history comes as a measurement does
    command = np.eye(written.n_states, m, k=-parameter.n_states)
    entry = replace(written, B=np.hstack([command, written.B]), D=np.zeros((m, 2 * m)))
    sizes = np.abs(np.hstack([*taps]))

    def variance(_gain: float, measured: FloatArray, commands: FloatArray) -> FloatArray:
        terms = sizes * np.tile(measured + commands, steps)
        largest = np.sum(terms, axis=1)
        sums = np.sum(terms**2, axis=1) + largest**2 * terms.shape[1]
        history = 3 * commands**2 + (measured + commands) ** 2
        return np.asarray(ROUNDOFF["single"] ** 2 / 3 * np.concatenate([sums, history]))

    return written, Rounding(entry=entry, variance=variance)


def small_gain_check(found: PredictiveFilter, taps: FloatArray) -> Check:
    """Check that what taps (steps, m, m) leave out of a filter cannot make its loop unstable.

    At the sensor gain g, with the sensitivity S, it is
    ``|1 - g| |S + (1 - S) / g| |left out| < 1``: the path is a delay, of norm 1 at most.
    """
    design, hardware, system = found.design, found.loop.hardware, found.system
    rounded = np.sum(np.linalg.norm(found.taps(len(taps)) - taps, ord=2, axis=(1, 2)))
    left_out = float(hinf_norm(_drop_steps(system, len(taps)))) + float(rounded)
    low, high = proved_gains(design, hardware)
    most, each = 0.0, np.eye(hardware.n_measurements)
    for gain in np.geomspace(low, high, _GAINS):
        s = close_loop(hardware, design.controller, sensor_gain=gain).output_sensitivity()
        inverse = replace(s, C=(1 - 1 / gain) * s.C, D=(1 - 1 / gain) * s.D + each / gain)
        most = max(most, float(abs(1 - gain)) * float(hinf_norm(inverse)) * left_out)
    name = f"small gain of what is left out, sensor gains {low:.4g} to {high:.4g}"
    return Check(name, most, 1.0, f"level sets at {_GAINS} gains")


def _drop_steps(system: StateSpace, steps: int) -> StateSpace:
    """Return the system whose impulse response is this one's from a step on."""
    late = system.C @ np.linalg.matrix_power(system.A, steps - 1)
    return replace(system, C=late @ system.A, D=late @ system.B)
