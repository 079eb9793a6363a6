"""The mixed controller: a filter for some modes, an integrator for each of the others.

Agapito et al. (2008), section III: tip and tilt, where telescopes shake, go to an optimal
filter; every other mode keeps the integrator of classical modal control.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from lbt_synth.design.modal.reconstructor import Reconstructor
from lbt_synth.design.modal.stack import Bank, mode_indices, number_per_mode
from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.linear import Controller
from lbt_synth.linear.controller import RunningController
from lbt_synth.loop.simulation import SteppedController
from lbt_synth.models import LoopHardware
from lbt_synth.validation import (
    FloatArray,
    IntArray,
    float_array,
    real_array,
    require_instance,
)


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
    reconstructor : Reconstructor, optional
        From slopes to modes; by default the measurements are modal coefficients.

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
    reconstructor: Reconstructor | None = None
    _banks: tuple[Bank, ...] = field(init=False, repr=False)  # all that is linear
    _states: list[FloatArray] = field(init=False, repr=False)  # of the banks
    _running: SteppedController | None = field(init=False, repr=False)  # a filter that is not
    _modes: IntArray = field(init=False, repr=False)  # those of the filter

    def __post_init__(self) -> None:
        gains = real_array(self.gains, "gains")
        if gains.ndim != 1 or gains.size == 0:
            raise DimensionError(f"gains must be a list, one per mode; got shape {gains.shape}.")
        n = gains.size
        self.gains = number_per_mode(gains, "gains", n, zero=True)
        self.leak = number_per_mode(self.leak, "leak", n, zero=True, at_most=1)
        if self.reconstructor is not None:
            require_instance(self.reconstructor, Reconstructor)
            if (modes := self.reconstructor.n_modes) != n:
                raise DimensionError(
                    f"gains must be one per mode of the reconstructor, {modes}; got {n}."
                )
        self._modes, self._running, self._banks = np.zeros(0, dtype=np.intp), None, ()
        if self.filter is not None:
            self._modes = mode_indices(self.filtered, "filtered", n)
            self._banks, self._running = _filter_parts(self.filter, self._modes)
        self.filtered = tuple(self._modes.tolist())
        rest = np.setdiff1d(np.arange(n), self._modes)
        if rest.size:  # an integrator each
            leak, gain = self.leak[rest, None, None], self.gains[rest, None, None]
            one = np.ones_like(gain)
            self._banks = (Bank(rest[:, None], leak, gain, one, 0 * one), *self._banks)
        self.reset()

    @property
    def n_modes(self) -> int:
        """Number of modes n."""
        return int(self.gains.size)

    @property
    def dt_s(self) -> float | None:
        """Sampling period of the filter [s]; None where nothing says it."""
        holder = self.filter if hasattr(self.filter, "dt_s") else _controller_of(self.filter)
        return getattr(holder, "dt_s", None)

    @property
    def hardware(self) -> LoopHardware | None:
        """Loop that the filter is designed for, of any number of modes; None if it says none."""
        return getattr(self.filter, "hardware", None)

    @property
    def n_measurements(self) -> int:
        """Number of measurements: slopes with a reconstructor, modes without."""
        return self.n_modes if self.reconstructor is None else self.reconstructor.n_slopes

    def reset(self) -> None:
        """Set all integrators and the filter to zero."""
        self._states = [np.zeros((len(bank.A), bank.A.shape[-1], 1)) for bank in self._banks]
        if self._running is not None:
            self._running.reset()

    def step(self, y: ArrayLike) -> FloatArray:
        """Take the measurements y(k) and return the modal commands u(k), (n,).

        Parameters
        ----------
        y : (n_measurements,) array_like
            Slopes, or modal coefficients where there is no reconstructor.

        Returns
        -------
        (n,) ndarray
            Commands.

        Raises
        ------
        DimensionError
            If y has another size.
            The same for the commands of a filter that is an object of your own.
        NonFiniteError
            If a measurement is not finite; the state is then as before. Or if a command of
            the filter is not: the integrators are then as before, the filter has stepped.
        ProblemError
            If y or the commands of the filter are no real numbers.
        """
        measured, shape = float_array(y, "y"), (self.n_measurements,)
        if measured.shape != shape:
            raise DimensionError(f"y must have shape {shape}; got {measured.shape}.")
        if self.reconstructor is not None:
            measured = self.reconstructor.matrix @ measured
        if not np.isfinite(measured).all():
            raise NonFiniteError(
                "y must be finite; got NaN or an infinite value. The state is as before: hold the "
                "last command, or reset()."
            )
        command = np.zeros(self.gains.size)
        if self._running is not None:
            own = float_array(self._running.step(measured[self._modes]), "the filter's commands")
            if own.shape != self._modes.shape:
                raise DimensionError(
                    f"the filter's commands must have shape {self._modes.shape}, one per filtered "
                    f"mode; got {own.shape}."
                )
            if not np.isfinite(own).all():
                raise NonFiniteError(
                    "the filter's commands must be finite; got NaN or an infinite value. The "
                    "integrators are as before, the filter has stepped: reset()."
                )
            command[self._modes] = own
        for i, bank in enumerate(self._banks):
            entry = measured[bank.modes][..., None]
            self._states[i] = bank.A @ self._states[i] + bank.B @ entry
            command[bank.modes] = (bank.C @ self._states[i] + bank.D @ entry)[..., 0]
        return command

    def banks(self) -> tuple[Bank, ...]:
        """Return integrators and filter as banks; one that is only stepped is a ProblemError."""
        if self._running is not None:
            raise ProblemError(
                "only a filter with matrices (a design or a Controller) makes a linear "
                f"controller; got {type(self._running).__name__}."
            )
        return self._banks

    def as_controller(self, dt_s: float | None = None) -> Controller:
        """Return the same map as one linear controller, for exact analysis.

        Parameters
        ----------
        dt_s : float, optional
            Sampling period [s]; by default that of the filter, 1 where there is none.

        Returns
        -------
        Controller
            From y to u, its states those of the filter and one per integrator.

        Raises
        ------
        ProblemError
            If the filter is no linear controller of this package, or has another period.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> classical = lbt.design.modal.MixedController(gains=[0.5, 0.3])
        >>> path = lbt.LoopHardware(frame_rate_hz=800)
        >>> lbt.close_loop(path, classical.as_controller(path.dt_s)).is_stable
        True
        """
        n, banks = self.n_modes, self.banks()
        own = self.dt_s
        period = own if dt_s is None else dt_s
        if own is not None and period is not None and not np.isclose(period, own, rtol=1e-9):
            raise ProblemError(
                f"dt_s must be that of the filter, {own:.9g} s; got {period:.9g} s. Design the "
                "filter for this frame rate."
            )
        each = [
            (np.eye(n)[modes], *matrices)
            for bank in banks
            for modes, *matrices in zip(bank.modes, bank.A, bank.B, bank.C, bank.D, strict=True)
        ]
        B = np.vstack([B @ chosen for chosen, _, B, _, _ in each])
        D = sum((chosen.T @ D @ chosen for chosen, *_, D in each), np.zeros((n, n)))
        if self.reconstructor is not None:
            B, D = B @ self.reconstructor.matrix, D @ self.reconstructor.matrix
        A = block_diag(*(A for _, A, *_ in each))
        C = np.hstack([chosen.T @ C for chosen, _, _, C, _ in each])
        return Controller(A=A, B=B, C=C, D=D, dt_s=1.0 if period is None else period)


def _controller_of(given: Any) -> Any:
    """Return the controller of a design, or of one that runs; anything else as it is.

    What is stepped may have a controller of more inputs than it is given.
    """
    if isinstance(given, SteppedController) and not isinstance(given, RunningController):
        return given
    return getattr(given, "controller", given)


def _filter_parts(given: Any, modes: IntArray) -> tuple[tuple[Bank, ...], SteppedController | None]:
    """Return a filter as banks for its modes, or as an object to step."""
    if hasattr(given, "banks"):
        banks = given.banks()
        if (count := sum(bank.modes.size for bank in banks)) != modes.size:
            raise DimensionError(
                f"the filters must be for the {modes.size} filtered modes; got {count}."
            )
        return tuple(bank.for_modes(modes) for bank in banks), None
    controller = _controller_of(given)
    # a filter that runs in another form reads what its matrices do not say
    if isinstance(controller, Controller) and getattr(given, "form", "plain") == "plain":
        A, B, C, D = (getattr(controller, name) for name in "ABCD")
        if D.shape != (modes.size, modes.size):
            raise DimensionError(
                f"the filter must map the {modes.size} filtered modes to as many commands; got "
                f"{D.shape[-1]} measurements and {D.shape[-2]} commands."
            )
        return (Bank(modes[None], A[None], B[None], C[None], D[None]),), None
    if not isinstance(given, SteppedController):
        raise ProblemError(
            "filter must be a design, a Controller, an object with step(y) and reset(), or None; "
            f"got {type(given).__name__}."
        )
    return (), given
