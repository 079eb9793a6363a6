"""A stack of one-mode designs: a Kalman filter for each of many modes, equal modes the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.filter_design import FilterDesign
from lbt_synth.design.kalman import kalman
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import DimensionError, LbtSynthError, ProblemError
from lbt_synth.loop import residual_budget
from lbt_synth.models import ARModel, LoopHardware, Vibration, tip_tilt_plant
from lbt_synth.models.loop_hardware import require_loop_rate
from lbt_synth.storage.words import listing_text
from lbt_synth.validation import (
    FloatArray,
    IntArray,
    frozen_copy,
    integer,
    number,
    read_only,
    real_array,
    require_instance,
)

Lines: TypeAlias = tuple[tuple[Vibration, ...], ...]
Vibrations: TypeAlias = Mapping[int, Vibration | Sequence[Vibration]]  # of some modes

_NAMED = 5  # modes that a message lists


def number_per_mode(value: Any, name: str, modes: int, **bounds: Any) -> FloatArray:
    """Return one number per mode, (n,), from one for all or one each, all within bounds."""
    values = real_array(value, name)
    if values.shape not in ((), (modes,)):
        got = f"shape {values.shape}"
        raise DimensionError(f"{name} must be one number, or one per mode ({modes}); got {got}.")
    for extreme in (np.min(values), np.max(values)):
        number(extreme, name, **bounds)
    return frozen_copy(np.broadcast_to(values, (modes,)))


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


def name_modes(indices: Any) -> str:
    """Text that names some modes: "mode 3", "modes 3, 7, 8 and 12 more"."""
    numbers = [str(int(i)) for i in indices]
    if len(numbers) == 1:
        return f"mode {numbers[0]}"
    if len(numbers) > _NAMED:
        numbers = [*numbers[:_NAMED], f"{len(numbers) - _NAMED} more"]
    return f"modes {listing_text(numbers)}"


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
    """

    designs: tuple[FilterDesign, ...]
    which: IntArray
    rms_nm: FloatArray

    @property
    def n_modes(self) -> int:
        """Number of modes n."""
        return int(self.which.size)

    @property
    def hardware(self) -> LoopHardware:
        """Loop that the filters are designed for, of one mode with a unit sensor."""
        return require_hardware(self.designs[0], "a modal filter").single_mode()

    def design(self, mode: int) -> FilterDesign:
        """Return the design of one mode, from 0; any other is a ProblemError."""
        place = integer(mode, "mode", at_least=0, at_most=self.n_modes - 1)
        return self.designs[int(self.which[place])]


def modal_filters(
    turbulence: ARModel | Sequence[ARModel],
    *,
    hardware: LoopHardware,
    noise_nm: ArrayLike,
    vibrations: Vibrations | None = None,
    sensor_gain: ArrayLike = 1.0,
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
    hardware : LoopHardware
        Delay, mirror and frame rate of all modes; its matrices play no part.
    noise_nm : float or (n,) array_like
        Standard deviation of the measurement noise of each mode per frame [nm].
    vibrations : mapping of int to Vibration or list of them, optional
        Vibrations of some modes, as means over frames; their directions play no part.
    sensor_gain : float or (n,) array_like, optional
        Sensor (optical) gain that the design assumes.

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
    >>> filters = lbt.design.modal.modal_filters(
    ...     air,
    ...     hardware=lbt.LoopHardware(frame_rate_hz=800),
    ...     noise_nm=15.5,
    ...     vibrations={0: [line]},
    ... )
    >>> filters.rms_nm.round(1).tolist(), filters.design(1).certificate.passed
    ([142.5, 31.6], True)
    """
    require_instance(hardware, LoopHardware, "hardware")
    turbulence = ARModel.stack(turbulence)
    require_loop_rate(turbulence.frame_rate_hz, hardware)
    n = turbulence.count
    noise = number_per_mode(noise_nm, "noise_nm", n, above=0)
    gain = number_per_mode(sensor_gain, "sensor_gain", n, above=0)
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
            vibrations=lines[first],
            noise_nm=float(noise[first]),
            delay_frames=hardware.delay_frames,
            sensor_gain=float(gain[first]),
            modes=1,
            mirror=hardware.mirror,
        )
        try:
            design = kalman(plant)
        except LbtSynthError as error:
            error.args = (f"the filter of {name_modes(modes)}: {error}",)
            raise
        which[modes] = len(designs)
        rms_nm[modes] = residual_budget(design.close(plant.hardware), plant).rms_nm
        designs.append(design)
    return ModalFilters(designs=tuple(designs), which=read_only(which), rms_nm=read_only(rms_nm))
