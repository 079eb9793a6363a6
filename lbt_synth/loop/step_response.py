"""What a loop does after a step of the wavefront."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.loop.closed_loop import ClosedLoop
from lbt_synth.loop.simulation.run import filter_series
from lbt_synth.validation import FloatArray, frozen_copy, integer

SHOWN_FRAMES = 120  # of a response, unless more are asked for
_SETTLED = 0.05  # part of the step


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopStep:
    """Response of an axis to a step of one on it.

    Attributes
    ----------
    axis : int
        The axis, from 0.
    time_s : (k,) ndarray
        Time after the step [s].
    residual : (k,) ndarray
        Residual of that axis, as a part of the step.
    command : (k,) ndarray
        Command of the same number, as a part of the step.
    """

    axis: int
    time_s: FloatArray
    residual: FloatArray
    command: FloatArray

    @property
    def overshoot_percent(self) -> float:
        """How far the correction goes beyond the step [%]."""
        return 100 * max(0.0, float(-np.min(self.residual)))

    @property
    def settling_s(self) -> float:
        """Time after which the residual stays within 5 % of the step [s]; nan if it does not."""
        outside = np.flatnonzero(np.abs(self.residual) > _SETTLED)
        after = int(outside[-1]) + 1 if outside.size else 0
        return float(self.time_s[after]) if after < self.time_s.size else float("nan")


def step_response(loop: ClosedLoop, *, axis: int = 0, frames: int = SHOWN_FRAMES) -> LoopStep:
    """Return the response of a loop to a step of the wavefront.

    Parameters
    ----------
    loop : ClosedLoop
        The loop.
    axis : int, optional
        Axis on which the step is, from 0.
    frames : int, optional
        Frames from the step on.

    Returns
    -------
    LoopStep
        Without other disturbances or noise.

    Raises
    ------
    ProblemError
        If there is no such axis, or no frame.

    Examples
    --------
    Nothing reaches the mirror within the two frames of delay:

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> loop = lbt.close_loop(path, lbt.integrator(path, gain=0.5).controller)
    >>> lbt.loop.step_response(loop, frames=5).residual.tolist()
    [1.0, 1.0, 0.5, 0.0, -0.25]
    """
    n = loop.hardware.modes
    own = integer(axis, "axis", at_least=0, below=n)
    inputs = np.zeros((integer(frames, "frames", at_least=1), n + loop.hardware.n_measurements))
    inputs[:, own] = 1.0
    outputs = filter_series(loop.system, inputs)
    return LoopStep(
        axis=own,
        time_s=frozen_copy(np.arange(len(inputs)) / loop.hardware.frame_rate_hz),
        residual=frozen_copy(outputs[:, own]),
        command=frozen_copy(outputs[:, n + min(own, loop.hardware.n_commands - 1)]),
    )
