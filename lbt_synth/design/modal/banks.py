"""Banks: many small controllers of the same size, computed together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError
from lbt_synth.validation import FloatArray, float_array


@dataclass(frozen=True, slots=True, eq=False)
class Bank:
    """Controllers in new-state form, ``x(k+1) = A x(k) + B y(k)``, ``u(k) = C x(k+1) + D y(k)``."""

    modes: np.ndarray  # (N, w), modes that each controller measures and commands
    A: FloatArray  # (N, s, s)
    B: FloatArray  # (N, s, w)
    C: FloatArray  # (N, w, s)
    D: FloatArray  # (N, w, w)

    @property
    def width(self) -> int:
        """Number of modes w of each controller."""
        return int(self.modes.shape[1])

    def for_modes(self, modes: np.ndarray) -> Bank:
        """Return the same controllers for other modes: i becomes ``modes[i]``."""
        return replace(self, modes=modes[self.modes])


@dataclass(slots=True, eq=False)
class RunningBanks:
    """Banks with their states: ``step(y) -> u`` once a frame, and ``reset()``.

    Every mode belongs to one controller.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.design.modal.banks import Bank, RunningBanks
    >>> one = np.ones((2, 1, 1))
    >>> bank = Bank(np.array([[1], [0]]), one, one, one, 0 * one)
    >>> run = RunningBanks((bank,), 2)
    >>> [run.step([1.0, 2.0]).tolist() for _ in range(2)]
    [[1.0, 2.0], [2.0, 4.0]]
    """

    banks: Sequence[Bank]
    n_modes: int
    _states: list[FloatArray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Set all states to zero."""
        self._states = [np.zeros((len(bank.A), bank.A.shape[-1], 1)) for bank in self.banks]

    def step(self, y: Any) -> FloatArray:
        """Take the measurements y(k), (n,), and return the commands u(k), (n,)."""
        measured = float_array(y, "y")
        if measured.shape != (self.n_modes,):
            raise DimensionError(f"y must have shape ({self.n_modes},); got {measured.shape}.")
        command = np.zeros(self.n_modes)
        for i, bank in enumerate(self.banks):
            entry = measured[bank.modes][..., None]
            self._states[i] = bank.A @ self._states[i] + bank.B @ entry
            command[bank.modes] = (bank.C @ self._states[i] + bank.D @ entry)[..., 0]
        return command
