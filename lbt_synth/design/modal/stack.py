"""A stack of one-mode designs: a Kalman filter for each of many modes, and what all loops leave.

Modes with the same numbers share a design; the loops of all modes are an ensemble.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.certificate import TOLERANCE, Certificate, Check
from lbt_synth.design.filter_design import FilterDesign
from lbt_synth.design.kalman import kalman
from lbt_synth.design.result import UNCERTIFIED, require_hardware
from lbt_synth.errors import DimensionError, LbtSynthError, ProblemError, UnstableLoopError
from lbt_synth.linear import Controller
from lbt_synth.loop.budget import ensemble_residuals, residual_budget
from lbt_synth.loop.closed_loop import require_loop_rate
from lbt_synth.loop.ensemble import EnsembleVibration, LoopEnsemble, turbulence_rows
from lbt_synth.models import (
    ARModel,
    LoopHardware,
    PositionLoop,
    TipTiltPlant,
    Vibration,
    tip_tilt_plant,
)
from lbt_synth.storage.words import listing_text
from lbt_synth.validation import (
    BoolArray,
    FloatArray,
    IntArray,
    frozen_copy,
    integer,
    read_only,
    real_array,
    require_instance,
)

if TYPE_CHECKING:
    from lbt_synth.design.modal.mixed_controller import MixedController

Lines: TypeAlias = tuple[tuple[Vibration, ...], ...]
Vibrations: TypeAlias = Mapping[int, Vibration | Sequence[Vibration]]  # of some modes

_NAMED = 5  # modes that a message lists
_JOINED = "residual of each mode's loop, against that of its design"


def number_per_mode(
    value: Any, name: str, modes: int, *, zero: bool = False, at_most: float = np.inf
) -> FloatArray:
    """Return one positive number per mode, (n,), from one for all or one each."""
    given = real_array(value, name)
    if given.shape not in ((), (modes,)):
        got = f"shape {given.shape}"
        raise DimensionError(f"{name} must be one number, or one per mode ({modes}); got {got}.")
    low, high = float(np.min(given, initial=np.inf)), float(np.max(given, initial=-np.inf))
    if low < 0 or (low == 0 and not zero) or high > at_most:
        bounds = f"{'at least' if zero else 'above'} 0"
        if at_most < np.inf:
            bounds += f" and at most {at_most:g}"
        raise ProblemError(f"{name} must be {bounds}; got {low:.6g} to {high:.6g}.")
    return frozen_copy(np.broadcast_to(given, (modes,)))


def lines_per_mode(vibrations: Vibrations | None, modes: int) -> Lines:
    """Return the vibrations of each mode, along it, from a mapping of some modes."""
    lines: list[tuple[Vibration, ...]] = [()] * modes
    vibrations = {} if vibrations is None else vibrations
    if not isinstance(vibrations, Mapping):
        raise ProblemError(
            "vibrations must be a mapping from mode numbers to vibrations, such as {0: [line]}; "
            f"got {type(vibrations).__name__}."
        )
    for mode, some in vibrations.items():
        i = integer(mode, "a mode of vibrations", at_least=0, at_most=modes - 1)
        listed = (some,) if isinstance(some, Vibration) else some
        is_list = isinstance(listed, list | tuple)
        if not is_list or not all(isinstance(line, Vibration) for line in listed):
            raise ProblemError(f"mode {i} must have a list of Vibration; got {some!r}.")
        lines[i] = tuple(replace(line, direction=(1.0,)) for line in listed)
    return tuple(lines)


def mode_indices(indices: Any, name: str, n: int) -> np.ndarray:
    """Return different mode numbers from 0 to n - 1 as an integer array."""
    if isinstance(indices, str | bytes) or not np.iterable(indices):
        raise ProblemError(f"{name} must be a list of mode numbers; got {indices!r}.")
    out = [integer(index, name, at_least=0) for index in indices]
    if not out:
        raise ProblemError(f"{name} must name at least one mode; got none.")
    if len(set(out)) != len(out) or any(index >= n for index in out):
        raise ProblemError(f"{name} must be different mode numbers from 0 to {n - 1}; got {out}.")
    return np.array(out, dtype=np.intp)


def name_modes(indices: Any) -> str:
    """Text that names some modes: "mode 3", "modes 3, 7, 8 and 12 more"."""
    numbers = [str(int(i)) for i in indices]
    if len(numbers) == 1:
        return f"mode {numbers[0]}"
    if len(numbers) > _NAMED:
        numbers = [*numbers[:_NAMED], f"{len(numbers) - _NAMED} more"]
    return f"modes {listing_text(numbers)}"


@dataclass(frozen=True, slots=True, eq=False)
class Bank:
    """N controllers of the same size that share no mode.

    They are in new-state form, ``x(k+1) = A x(k) + B y(k)``, ``u(k) = C x(k+1) + D y(k)``.
    """

    modes: np.ndarray  # (N, w), modes of each controller
    A: FloatArray  # (N, s, s)
    B: FloatArray
    C: FloatArray
    D: FloatArray

    @property
    def width(self) -> int:
        """Number of modes w of each controller."""
        return int(self.modes.shape[1])

    def take(self, rows: IntArray) -> Bank:
        """Return some of the controllers."""
        return Bank(*(getattr(self, part.name)[rows] for part in fields(self)))

    def for_modes(self, modes: np.ndarray) -> Bank:
        """Return the same controllers for other modes: i becomes ``modes[i]``."""
        return replace(self, modes=modes[self.modes])

    def textbook(self) -> tuple[FloatArray, ...]:
        """Return ``A, B, C, D`` in textbook form."""
        return self.A, self.B, self.C @ self.A, self.C @ self.B + self.D


def make_banks(controllers: Sequence[Controller], which: IntArray) -> tuple[Bank, ...]:
    """Return the controllers of single modes, mode i that of ``which[i]``, by their sizes."""
    sizes = np.array([controller.n_states for controller in controllers])[which]
    out = []
    for size in np.unique(sizes):
        modes = np.flatnonzero(sizes == size)
        chosen = [controllers[i] for i in which[modes].tolist()]
        matrices = (np.stack([getattr(one, name) for one in chosen]) for name in "ABCD")
        out.append(Bank(modes[:, None], *matrices))
    return tuple(out)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalFilters:
    """A Kalman filter for each of n modes, made by :func:`modal_filters`.

    Attributes
    ----------
    designs : tuple of FilterDesign
        The different designs of one mode, each with its claims and its certificate.
    which : (n,) ndarray of int
        Design of each mode.
    rms_nm : (n,) ndarray
        Residual that each mode's loop leaves in the image under its own model [nm rms].
    certificate : Certificate
        That the stack is what its designs are: the loops of all modes, closed as arrays, leave
        what each design's loop leaves. ``rms_per_output`` is each mode's estimation error.
    """

    designs: tuple[FilterDesign, ...]
    which: IntArray
    rms_nm: FloatArray
    certificate: Certificate

    @property
    def n_modes(self) -> int:
        """Number of modes n."""
        return int(self.which.size)

    @property
    def dt_s(self) -> float:
        """Frame period [s]."""
        return self.hardware.dt_s

    @property
    def hardware(self) -> LoopHardware:
        """Loop that the filters are designed for, of one mode with a unit sensor."""
        return require_hardware(self.designs[0], "a modal filter").single_mode()

    def design(self, mode: int) -> FilterDesign:
        """Return the design of one mode, from 0; any other is a ProblemError."""
        number = integer(mode, "mode", at_least=0, at_most=self.n_modes - 1)
        return self.designs[int(self.which[number])]

    def banks(self) -> tuple[Bank, ...]:
        """Return the controllers, those of the same size together."""
        return make_banks([design.controller for design in self.designs], self.which)

    def start(self) -> MixedController:
        """Return running controllers with zero states, to be stepped frame by frame."""
        from lbt_synth.design.modal.mixed_controller import MixedController

        modes = range(self.n_modes)
        return MixedController(filter=self, gains=np.zeros(self.n_modes), filtered=modes)


def modal_filters(
    turbulence: ARModel | Sequence[ARModel],
    *,
    noise_nm: ArrayLike,
    vibrations: Vibrations | None = None,
    delay_frames: float = 2.0,
    sensor_gain: ArrayLike = 1.0,
    mirror: PositionLoop | None = None,
) -> ModalFilters:
    """Design a Kalman filter for every mode.

    Each mode is the plant of :func:`tip_tilt_plant` for a single mode, and its filter that of
    :func:`kalman`; modes with the same numbers share a design. Modes are independent: neither
    their turbulence nor their noise is correlated.

    A mirror with dynamics is treated as :func:`kalman` does: what it really did is taken out of
    the measurements, so that every loop is stable, but the command is the estimate itself, as if
    the mirror were there at once; ``rms_nm`` holds the lag that this leaves. :func:`lqg`
    designs commands that lead the mirror, one or two modes at a time.

    Parameters
    ----------
    turbulence : ARModel or sequence of ARModel
        Turbulence of each mode.
    noise_nm : float or (n,) array_like
        Standard deviation of the measurement noise of each mode per frame [nm].
    vibrations : mapping of int to Vibration or list of them, optional
        Vibrations of some modes, as means over frames; their directions play no part.
    delay_frames : float, optional
        Total delay of the loop [frames], at least 1, fractions allowed.
    sensor_gain : float or (n,) array_like, optional
        Sensor (optical) gain that the design assumes.
    mirror : PositionLoop, optional
        Dynamics of the mirror, the same for all modes; one that settles at once by default.

    Returns
    -------
    ModalFilters
        Certified designs, and the one of each mode.

    Raises
    ------
    ProblemError
        If a value is not finite, out of range, or sizes clash.
    NumericalError
        If an equation was not solved; the message names the modes.
    CertificateError
        If a design does not pass its checks; the message names the modes.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> air = lbt.models.ARModel(
    ...     coefficients=[[0.9886], [0.98]], driving_rms_nm=[89.1, 20.0], frame_rate_hz=800
    ... )
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6)
    >>> filters = lbt.design.modal.modal_filters(air, noise_nm=15.5, vibrations={0: [line]})
    >>> filters.rms_nm.round(1).tolist(), filters.design(1).certificate.passed
    ([142.5, 31.6], True)
    """
    turbulence = ARModel.stack(turbulence)
    n = turbulence.count
    noise = number_per_mode(noise_nm, "noise_nm", n)
    gain = number_per_mode(sensor_gain, "sensor_gain", n)
    lines = lines_per_mode(vibrations, n)
    numbers = np.column_stack([turbulence.coefficients, turbulence.driving_rms_nm, noise, gain])
    alike: dict[tuple[object, ...], list[int]] = {}  # modes with the same numbers
    for mode, row in enumerate(numbers):
        alike.setdefault((row.tobytes(), lines[mode]), []).append(mode)
    designs: list[FilterDesign] = []
    which, rms_nm = np.zeros(n, dtype=np.int64), np.zeros(n)
    for modes in alike.values():
        first = modes[0]
        plant = tip_tilt_plant(
            frame_rate_hz=turbulence.frame_rate_hz,
            turbulence=turbulence.take(first),
            vibrations=lines[first] or None,
            noise_nm=float(noise[first]),
            delay_frames=delay_frames,
            sensor_gain=float(gain[first]),
            modes=1,
            mirror=mirror,
        )
        design = _design_filter(plant, modes)
        which[modes] = len(designs)
        rms_nm[modes] = residual_budget(design.close(plant.hardware), plant).rms_nm
        designs.append(design)
    filters = ModalFilters(
        designs=tuple(designs),
        which=read_only(which),
        rms_nm=read_only(rms_nm),
        certificate=UNCERTIFIED,
    )
    stacked = modal_residuals(
        filters, turbulence, noise_nm=noise, vibrations=vibrations, sensor_gain=gain
    )
    errors = frozen_copy(np.array([design.rms for design in designs])[which])
    joined = replace(UNCERTIFIED, checks=(joining_check(stacked, rms_nm),), rms_per_output=errors)
    return replace(filters, certificate=joined.require("Scale these modes to sizes that occur."))


def _design_filter(plant: TipTiltPlant, modes: list[int]) -> FilterDesign:
    """Design the filter of a mode; an error names all modes that it is for."""
    try:
        return kalman(plant)
    except LbtSynthError as error:
        error.args = (f"the filter of {name_modes(modes)}: {error}",)
        raise


def joining_check(stacked: FloatArray, alone: FloatArray) -> Check:
    """Check the residuals (n,) of the loops of all modes against those of their designs."""
    apart = np.abs((stacked / alone) ** 2 - 1)
    failing = np.flatnonzero(~(apart < TOLERANCE))
    name = f"{_JOINED} ({name_modes(failing)})" if failing.size else _JOINED
    how = "relative variance, loops as arrays and one by one"
    return Check(name, float(np.max(apart)), TOLERANCE, how)


def modal_residuals(
    controller: MixedController | ModalFilters,
    turbulence: ARModel | Sequence[ARModel],
    *,
    noise_nm: ArrayLike,
    vibrations: Vibrations | None = None,
    hardware: LoopHardware | None = None,
    sensor_gain: ArrayLike = 1.0,
    frame_means: bool = False,
) -> FloatArray:
    """Exact stationary residual of each mode, with a unit sensor and a mirror of unit gain.

    Parameters
    ----------
    controller : MixedController or ModalFilters
        Controllers of the modes, without a reconstructor: y are modal coefficients.
    turbulence : ARModel or sequence of ARModel
        Turbulence of each mode, as means over frames.
    noise_nm : float or (n,) array_like
        Measurement noise of each mode per frame [nm], at least 0.
    vibrations : mapping of int to Vibration or list of them, optional
        Vibrations of some modes, as means over frames; their directions play no part.
    hardware : LoopHardware, optional
        Real delay, mirror and frame rate; its matrices play no part. By default that of the
        filters, or of the design that is the mixed controller's filter.
    sensor_gain : float or (n,) array_like, optional
        Real sensor (optical) gain, of all modes or of each.
    frame_means : bool, optional
        Whether to leave out what moves within frames, as :func:`residual_budget` does.

    Returns
    -------
    (n,) ndarray
        Residual of each mode [nm rms].

    Raises
    ------
    UnstableLoopError
        If a loop is unstable; the message names the modes.
    ProblemError
        If the controller has a reconstructor or is of another kind, sizes clash, a value is out of
        its range, no filter has a loop and none is given, or frame rates differ.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> air = lbt.models.ARModel(
    ...     coefficients=[[0.99], [0.99]], driving_rms_nm=[10.0, 5.0], frame_rate_hz=800
    ... )
    >>> control = lbt.design.modal.MixedController(gains=[0.5, 0.4])
    >>> left = lbt.design.modal.modal_residuals(control, air, noise_nm=5.0, hardware=path)
    >>> left.round(2).tolist()
    [16.44, 8.6]
    """
    path = _checked_path(controller, hardware)
    turbulence = ARModel.stack(turbulence)
    n = controller.n_modes
    if turbulence.count != n:
        raise DimensionError(f"turbulence must have {n} modes; got {turbulence.count}.")
    require_loop_rate(turbulence.frame_rate_hz, path)
    noise = number_per_mode(noise_nm, "noise_nm", n, zero=True)
    gain = number_per_mode(sensor_gain, "sensor_gain", n)
    lines = lines_per_mode(vibrations, n)
    residual, stable = np.zeros(n), np.zeros(n, dtype=np.bool_)
    for bank in controller.banks():
        counts = np.array([len(lines[mode]) for mode in bank.modes[:, 0]])
        for count in np.unique(counts):  # of vibrations, the same in an ensemble
            some = bank.take(np.flatnonzero(counts == count))
            rms, stable_loops = _residuals(
                some, path, gain, turbulence, noise, lines, frame_means=frame_means
            )
            residual[some.modes], stable[some.modes] = rms, stable_loops[:, None]
    if not stable.all():
        raise UnstableLoopError(
            "the loop of every mode must be stable; got unstable or marginal ones, "
            f"{name_modes(np.flatnonzero(~stable))}. Lower their gains, or design for this delay "
            "and sensor gain."
        )
    return read_only(residual)


def _checked_path(
    controller: MixedController | ModalFilters, hardware: LoopHardware | None
) -> LoopHardware:
    """Return the loop of one mode that a controller runs in."""
    if not hasattr(controller, "banks"):
        raise ProblemError(
            "controller must be a MixedController or ModalFilters; got "
            f"{type(controller).__name__}. Try MixedController(gains=gains)."
        )
    if getattr(controller, "reconstructor", None) is not None:
        raise ProblemError(
            "a modal loop is that of modal coefficients; got a controller with a "
            "reconstructor. Leave it out, or use simulate with the sensor's matrix."
        )
    path, dt_s = hardware or controller.hardware, controller.dt_s
    if path is None:
        raise ProblemError("hardware must be given where no filter has a loop; got None.")
    require_instance(path, LoopHardware, "hardware")
    if dt_s is not None and not np.isclose(path.dt_s, dt_s, rtol=1e-9):
        raise ProblemError(
            f"hardware must have the frame rate of the filters, {1 / dt_s:.6g} Hz; got "
            f"{path.frame_rate_hz:.6g} Hz."
        )
    return path.single_mode()


def _residuals(
    bank: Bank,
    hardware: LoopHardware,
    sensor_gain: FloatArray,
    turbulence: ARModel,
    noise_nm: FloatArray,
    lines: Lines,
    *,
    frame_means: bool,
) -> tuple[FloatArray, BoolArray]:
    """Residuals (N, w) of the loops of a bank, as an ensemble, and which loops are stable (N,).

    The hardware is that of one mode.
    """
    w, gain, columns = bank.width, sensor_gain[bank.modes], list(bank.modes.T)
    vibrations = [
        EnsembleVibration(
            frequency_hz=[lines[mode][i].frequency_hz for mode in column],
            rms_nm=[lines[mode][i].rms_nm for mode in column],
            damping=[lines[mode][i].damping for mode in column],
            direction=axis,
        )
        for axis, column in zip(np.eye(w), columns, strict=True)
        for i in range(len(lines[column[0]]))
    ]
    conditions = LoopEnsemble(
        loops=len(bank.modes),
        sensor_gain=gain[:, 0] if w == 1 else 1.0,
        noise_nm=noise_nm[bank.modes],
        turbulence=[turbulence_rows(turbulence, column) for column in columns],
        vibrations=tuple(vibrations),
        of_means=True,
    )
    if w > 1:
        sensor = np.diag(gain[0])
        hardware = replace(hardware, modes=w, sensor_matrix=sensor, influence_matrix=None)
    left = ensemble_residuals(bank.textbook(), hardware, conditions, frame_means=frame_means)
    power = left.turbulence_nm2 + left.noise_nm2 + left.random_vibration_nm2 + left.within_nm2
    return np.sqrt(np.diagonal(power, axis1=1, axis2=2)), left.stable
