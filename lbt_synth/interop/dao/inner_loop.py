"""The inner loop of a dao real-time computer in numpy: the oracle of its matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lbt_synth.errors import DimensionError
from lbt_synth.validation import FloatArray


class InnerLoop:
    """Per mode, ``u(k) = sum b_j y(k-j) + sum a_i u(k-i)``, in single precision.

    The products are added one by one, in the order of the matrix's rows. The voltages are
    ``-to_actuators u``; where one exceeds the limit it is clipped, and the memory holds the
    commands that were applied.

    The matrix (2 M + 1, modes) has rows ``b_0 .. b_M``, then ``a_1 .. a_M``; ``to_actuators``
    (actuators, modes) is the identity by default, and the limit that of a voltage's modulus.

    Examples
    --------
    An integrator, ``u(k) = u(k-1) + 0.5 y(k)``, and its clipped memory:

    >>> from lbt_synth.interop.dao.inner_loop import InnerLoop
    >>> loop = InnerLoop([[0.5], [0.0], [1.0]], limit=0.75)
    >>> [float(loop.step([1.0])[0]) for _ in range(3)]
    [0.5, 0.75, 0.75]
    >>> float(loop.step([-1.0])[0])
    0.25
    """

    def __init__(
        self,
        matrix: ArrayLike,
        to_actuators: ArrayLike | None = None,
        limit: float = np.inf,
    ) -> None:
        self._rows = np.asarray(matrix, dtype=np.float32)
        if self._rows.ndim != 2 or len(self._rows) % 2 == 0:
            raise DimensionError(
                "the matrix must have 2 M + 1 rows and one column per mode; got shape "
                f"{self._rows.shape}."
            )
        modes = self._rows.shape[1]
        given = np.eye(modes) if to_actuators is None else to_actuators
        self._to_actuators = np.asarray(given, dtype=np.float32)
        if self._to_actuators.ndim != 2 or self._to_actuators.shape[1] != modes:
            raise DimensionError(
                f"to_actuators must have {modes} columns, one per mode; got shape "
                f"{self._to_actuators.shape}."
            )
        self._to_modes = np.linalg.pinv(self._to_actuators).astype(np.float32)
        self._limit = np.float32(limit)
        self._past = len(self._rows) // 2  # M
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._memory: NDArray[np.float32] = np.zeros_like(self._rows)

    def step(self, y: ArrayLike) -> FloatArray:
        """Take y(k), (modes,), return the commands that were applied, (modes,)."""
        memory, first = self._memory, self._past + 1
        memory[1:first] = memory[: first - 1].copy()
        memory[0] = y
        u = np.add.accumulate(self._rows * memory, axis=0)[-1]
        voltages = -(self._to_actuators @ u)
        if np.any(np.abs(voltages) > self._limit):
            u = -(self._to_modes @ np.clip(voltages, -self._limit, self._limit))
        memory[first + 1 :] = memory[first:-1].copy()
        memory[first : first + 1] = u  # nothing to write at M = 0
        return np.asarray(u, dtype=np.float64)
