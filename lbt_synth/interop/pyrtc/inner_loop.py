"""The loop ``predictive_integrator`` of pyRTC in numpy: the oracle of its arithmetic."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Design
from lbt_synth.interop.pyrtc.pol_filter import pol_filter
from lbt_synth.validation import FloatArray


class InnerLoop:
    """A design as pyRTC runs it: signals and commands in single precision, the filter in double.

    It starts with a flat mirror. The limit is ``predictor.command_limit`` of the configuration.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> from lbt_synth.interop.pyrtc.inner_loop import InnerLoop
    >>> loop = InnerLoop(lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5))
    >>> [float(loop.step([1.0, 0.0])[0]) for _ in range(3)]
    [0.5, 1.0, 1.5]
    """

    def __init__(self, design: Design, limit: float = np.inf) -> None:
        found = pol_filter(design)
        self._filter, self._delay = found.start(limit), found.delay_frames
        self._reconstructor = found.reconstructor.astype(np.float32)
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._filter.reset()

    def step(self, y: ArrayLike) -> FloatArray:
        """Take y(k), (m,), return u(k), (m,)."""
        residual = self._reconstructor @ np.asarray(y, dtype=np.float32)
        pol = residual + self._filter.sent[self._delay - 1].astype(np.float32)
        return self._filter.step(pol.astype(np.float64))
