"""cacao's predictive filter in numpy: its history, its matrix product, and its sign."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lbt_synth.errors import DimensionError
from lbt_synth.validation import FloatArray, number

LONGEST_DELAY = 8  # frames; modalfilter keeps the commands of ten frames


class AppliedFilter:
    """What ``modalfilter`` and ``applyPF`` compute in a frame, in single precision.

    The pseudo-open-loop value of a mode is its measurement less the command that was applied
    ``latency`` frames ago, interpolated between two frames. The matrix multiplies the values of the
    last frames, the newest first, all modes of a frame together; products are added one by one.
    The mirror gets the product itself: a positive command of cacao adds to the measurement, so
    that :meth:`step` returns its negative.

    The matrix (modes, steps * modes) has a row per mode of the command. The latency of cacao's
    index arithmetic is one frame more than the total delay. The limit is that of the modulus of a
    command that is applied; the history holds the applied commands.

    Examples
    --------
    A filter that gives back the last value, with its sign changed:

    >>> from lbt_synth.interop.cacao.applied_filter import AppliedFilter
    >>> last = AppliedFilter([[-1.0, 0.0]])
    >>> [float(last.step([y])[0]) for y in (1.0, 0.0, 0.0, 0.0)]
    [1.0, 0.0, 1.0, 0.0]
    """

    def __init__(self, matrix: ArrayLike, delay_frames: float = 2.0, limit: float = np.inf) -> None:
        self._matrix = np.atleast_2d(np.asarray(matrix, dtype=np.float32))
        modes, columns = self._matrix.shape
        if columns % modes or not columns:
            raise DimensionError(
                f"the matrix must have steps * {modes} columns, a row per mode; got shape "
                f"{self._matrix.shape}."
            )
        latency = np.float32(1 + number(delay_frames, "delay_frames", at_least=1))
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
        return 0.0 - u.astype(np.float64)
