"""The mixed controller: a filter for some modes, an integrator for each of the others.

Agapito et al. (2008), section III: tip and tilt, where telescopes shake, go to an optimal
filter; every other mode keeps the integrator of classical modal control.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.modal.stack import ModalFilters, number_per_mode
from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.linear import Controller
from lbt_synth.loop.simulation import SteppedController
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray, float_array, integer, real_array


class _Bank(NamedTuple):
    """N controllers of one size: ``x(k+1) = A x(k) + B y(k)``, ``u(k) = C x(k+1) + D y(k)``."""

    modes: np.ndarray  # (N, w), modes of each controller
    A: FloatArray  # (N, s, s)
    B: FloatArray
    C: FloatArray
    D: FloatArray


@dataclass(slots=True, kw_only=True, eq=False)
class MixedController:
    """Controller of n modes with a state: ``step(y) -> u`` once a frame, and ``reset()``.

    A mode that is not filtered has its own integrator, ``u(k) = leak u(k-1) + gain y(k)``
    with y the modal coefficient of the residual. The modes of ``filtered``, in that
    order, are the measurements and the commands of the filter.

    Parameters
    ----------
    filter : Design, Controller, ModalFilters, object with ``step(y)`` and ``reset()``, optional
        Controller of the filtered modes, such as a Kalman design of a tip/tilt plant. An
        object with a state is stepped as it is. Without one all modes have integrators.
    gains : (n,) array_like
        Integrator gain of each mode, at least 0; those of filtered modes play no part.
    filtered : sequence of int, optional
        Modes of the filter; they play no part if there is none.
    leak : float or (n,) array_like, optional
        Leak of the integrators, 0 to 1; 1 for pure integrators.

    Raises
    ------
    DimensionError
        If sizes clash.
    ProblemError
        If a value is not finite or out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=15.5)
    >>> control = lbt.design.modal.MixedController(
    ...     filter=lbt.kalman(plant), gains=[0.0, 0.0, 0.5, 0.3]
    ... )
    >>> [float(u.round(3)) for u in control.step([0.0, 0.0, 10.0, 10.0])]
    [0.0, 0.0, 5.0, 3.0]
    >>> [float(u.round(3)) for u in control.step([0.0, 0.0, 10.0, 10.0])]
    [0.0, 0.0, 10.0, 6.0]
    """

    filter: Any = None
    gains: FloatArray
    filtered: Sequence[int] = (0, 1)
    leak: Any = 1.0
    _banks: tuple[_Bank, ...] = field(init=False, repr=False)  # all that is linear
    _states: list[FloatArray] = field(init=False, repr=False)  # of the banks
    _running: SteppedController | None = field(init=False, repr=False)  # a filter that is not

    def __post_init__(self) -> None:
        gains = real_array(self.gains, "gains")
        if gains.ndim != 1 or gains.size == 0:
            raise DimensionError(f"gains must be a list, one per mode; got shape {gains.shape}.")
        n = gains.size
        self.gains = number_per_mode(gains, "gains", n, at_least=0)
        self.leak = number_per_mode(self.leak, "leak", n, at_least=0, at_most=1)
        modes = np.zeros(0, dtype=np.intp)
        self._running, self._banks = None, ()
        if self.filter is not None:
            listed = [integer(i, "filtered", at_least=0, at_most=n - 1) for i in self.filtered]
            if not listed or len(set(listed)) != len(listed):
                raise ProblemError(
                    f"filtered must be different mode numbers, at least one; got {listed}."
                )
            modes = np.array(listed, dtype=np.intp)
            self._banks, self._running = _filter_parts(self.filter, modes)
        self.filtered = tuple(modes.tolist())
        others = np.setdiff1d(np.arange(n), modes)
        if others.size:  # an integrator each
            leak, gain = self.leak[others, None, None], self.gains[others, None, None]
            one = np.ones_like(gain)
            self._banks = (_Bank(others[:, None], leak, gain, one, 0 * one), *self._banks)
        self.reset()

    @property
    def n_modes(self) -> int:
        """Number of modes n."""
        return int(self.gains.size)

    @property
    def hardware(self) -> LoopHardware | None:
        """Loop that the filter is designed for, of any number of modes; None if it says none."""
        return getattr(self.filter, "hardware", None)

    def reset(self) -> None:
        """Set all integrators and the filter to zero."""
        self._states = [np.zeros((len(bank.A), bank.A.shape[-1], 1)) for bank in self._banks]
        if self._running is not None:
            self._running.reset()

    def step(self, y: ArrayLike) -> FloatArray:
        """Take the modal coefficients y(k), (n,), and return the modal commands u(k), (n,).

        A measurement that is not finite raises a NonFiniteError; the state is then as before.
        """
        measured = float_array(y, "y")
        if measured.shape != self.gains.shape:
            raise DimensionError(f"y must have shape {self.gains.shape}; got {measured.shape}.")
        if not np.isfinite(measured).all():
            raise NonFiniteError(
                "y must be finite; got NaN or an infinite value. The state is as before: hold the "
                "last command, or reset()."
            )
        command = np.zeros(self.gains.size)
        if self._running is not None:
            modes = list(self.filtered)
            filtered = float_array(self._running.step(measured[modes]), "the filter's command")
            if filtered.shape != (len(modes),):
                raise DimensionError(
                    f"the filter's command must have shape ({len(modes)},); got {filtered.shape}."
                )
            command[modes] = filtered
        for i, bank in enumerate(self._banks):
            entry = measured[bank.modes][..., None]
            self._states[i] = bank.A @ self._states[i] + bank.B @ entry
            command[bank.modes] = (bank.C @ self._states[i] + bank.D @ entry)[..., 0]
        return command


def _filter_parts(
    given: Any, modes: np.ndarray
) -> tuple[tuple[_Bank, ...], SteppedController | None]:
    """Return a filter as banks for its modes, or as an object to step."""
    if isinstance(given, ModalFilters):
        if given.n_modes != modes.size:
            raise DimensionError(
                f"the filters must be for the {modes.size} filtered modes; got {given.n_modes}."
            )
        controllers = [design.controller for design in given.designs]
        sizes = np.array([controller.n_states for controller in controllers])[given.which]
        banks = []
        for size in np.unique(sizes):
            some = np.flatnonzero(sizes == size)
            alike = [controllers[i] for i in given.which[some].tolist()]
            matrices = (np.stack([getattr(one, name) for one in alike]) for name in "ABCD")
            banks.append(_Bank(modes[some, None], *matrices))
        return tuple(banks), None
    if isinstance(given, SteppedController):
        return (), given
    controller = getattr(given, "controller", given)
    if not isinstance(controller, Controller):
        raise ProblemError(
            "filter must be a design, a Controller, an object with step(y) and reset(), or None; "
            f"got {type(given).__name__}."
        )
    A, B, C, D = (getattr(controller, name) for name in "ABCD")
    if D.shape != (modes.size, modes.size):
        raise DimensionError(
            f"the filter must map the {modes.size} filtered modes to as many commands; got "
            f"{D.shape[-1]} measurements and {D.shape[-2]} commands."
        )
    return (_Bank(modes[None], A[None], B[None], C[None], D[None]),), None
