"""Telemetry: the series of a loop, with the facts that make them readable later."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple, TypeAlias

import numpy as np

from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.models import LoopHardware, PositionLoop
from lbt_synth.storage.display_unit import require_unit
from lbt_synth.storage.words import count_text
from lbt_synth.validation import (
    FloatArray,
    Obstruction,
    Positive,
    check_fields,
    float_array,
    frozen_copy,
    real_array,
    set_fields,
)

Scalar: TypeAlias = str | float | int | bool
_LENGTHS = ("pm", "um", "mm", "m")
_LONGEST_UNIT = 24


class Layer(NamedTuple):
    """One array: its field, its axes in numpy's order, its unit and its meaning.

    A unit that begins with an underscore is read from the field of that name.
    """

    field: str
    axes: str
    unit: str
    meaning: str

    @property
    def is_series(self) -> bool:
        """Whether it has one row per frame."""
        return self.axes.startswith("frame")

    def unit_in(self, telemetry: Any) -> str:
        """Return the unit that it has in a telemetry."""
        return str(getattr(telemetry, self.unit[1:])) if self.unit[:1] == "_" else self.unit


LAYERS = {  # by their names in files
    "COMMANDS": Layer("commands", "frame, command", "_command_unit", "u(k)"),
    "MEASURE": Layer(
        "measurements", "frame, measurement", "_measurement_unit", "y(k), of the exposure of k-1"
    ),
    "RESIDUAL": Layer("residual_nm", "frame, mode", "nm", "phi_res(k), corrected phase"),
    "TOTAL": Layer("total_nm", "frame, mode", "nm", "phi_tot(k), before correction"),
    "TIMES": Layer("times_s", "frame", "s", "time of each frame"),
    "INTERACT": Layer("interaction_matrix", "measurement, mode", "", "S"),
    "INFLUENC": Layer("influence_matrix", "mode, command", "", "N"),
}
REQUIRED = ("measurements",)
_WITH_GAPS = ("commands", "measurements")  # in which NaN is a value that was lost
FACTS: Mapping[str, tuple[str, str, str]] = {  # with their cards in a FITS header, and units
    "frame_rate_hz": ("RATE_HZ", "Hz", "frame rate"),
    "delay_frames": ("DELAY", "frames", "total delay"),
    "sensor_gain": ("SENSGAIN", "", "sensor gain"),
    "imaging_wavelength_um": ("WAVELEN", "um", "imaging wavelength"),
    "diameter_m": ("DIAMETER", "m", "telescope diameter"),
    "obstruction": ("OBSTRUCT", "", "central obstruction"),
    "command_unit": ("CMDUNIT", "", "of the commands"),
    "measurement_unit": ("MEASUNIT", "", "of the measurements"),
    "shown_unit": ("SHOWUNIT", "", "in which people see the wavefront"),
}


def _check_unit(value: Any, name: str) -> None:
    fits = isinstance(value, str) and len(value) <= _LONGEST_UNIT and value.strip() == value
    # a FITS card does not keep a quote in every place
    if not fits or not (value.isascii() and value.isprintable()) or "'" in value:
        raise ProblemError(
            f"{name} must be a word of at most {_LONGEST_UNIT} ASCII signs without a quote; got "
            f"{value!r}."
        )
    if value in _LENGTHS:
        raise ProblemError(f"{name} must be nm for lengths; got {value!r}. Convert them.")
    if name == "command_unit" and not value:
        raise ProblemError("command_unit must not be empty; write 1 for pure numbers.")


def _check_metadata(metadata: Any) -> Mapping[str, Scalar]:
    """Return metadata of words and scalars that nobody can change."""
    if not isinstance(metadata, Mapping):
        raise ProblemError(f"metadata must be a mapping; got {type(metadata).__name__}.")
    out: dict[str, Scalar] = {}
    for key, value in metadata.items():
        if not isinstance(key, str) or not key:
            raise ProblemError(f"the keys of metadata must be words; got {key!r}.")
        out[key] = value.item() if isinstance(value, np.generic) else value
        if not isinstance(out[key], str | float | int | bool):
            raise ProblemError(
                "metadata must hold texts, numbers and truth values; got "
                f"{type(value).__name__} for {key!r}."
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise NonFiniteError(f"metadata must be finite; got {value} for {key!r}.")
    return MappingProxyType(out)


_CONVENTION = (
    "Row k of every series is frame k of 1/frame_rate_hz. "
    "y(k) = sensor_gain S phi_res(k-1) + noise(k): the measurement of frame k is of the exposure "
    "of frame k-1. u(k) is the command computed from y up to y(k). "
    "phi_res(k) = phi_tot(k) - phi_cor(k), {correction}. S is the interaction matrix, N the "
    "influence matrix, each the identity where it is not given. "
    "Units: nm rms of wavefront, unless a unit is given."
)
CONVENTION = _CONVENTION.format(
    correction="phi_cor(k) = N u(k-d+1), d = delay_frames from the "
    "middle of an exposure to the middle of the command computed from it; for d = j+1+f, "
    "phi_cor(k) = N ((1-f) u(k-j) + f u(k-j-1))"
)
MOVING_CONVENTION = _CONVENTION.format(
    correction="phi_cor(k) = N (c0 u(k) + c1 u(k-1) + c2 u(k-2) + ...) with the mirror taps c "
    "recorded here: the weights of the commands in the position of a mirror that does not settle "
    "at once, averaged over exposure k. They hold the whole delay: d = delay_frames as it would be "
    "with a mirror that settles at once, and the mirror's lag after it"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Telemetry:
    """Series of a loop, simulated or measured, and the facts of the loop.

    Row k of every series belongs to frame k, in the convention of :class:`LoopHardware`::

        y(k)       = sensor_gain S phi_res(k-1) + noise(k)
        phi_res(k) = phi_tot(k) - N u(k-d+1)

    with S the interaction and N the influence matrix, each the identity where it is not
    given. With a ``mirror`` it is ``phi_tot(k) - N (c[0] u(k) + c[1] u(k-1) + ...)`` with the
    taps c of :attr:`mirror_taps`.

    Parameters
    ----------
    frame_rate_hz : float
        Frame rate [Hz].
    measurements : (frames, q) array_like
        Measurements y(k), in ``measurement_unit``. NaN where they were lost.
    commands : (frames, m) array_like, optional
        Commands u(k), in ``command_unit``, NaN where they were lost; None for an open loop.
    delay_frames : float, optional
        Total delay d [frames]; None if it is not known.
    mirror : PositionLoop, optional
        Dynamics of the mirror, as in :class:`LoopHardware`; a mirror that settles at once by
        default. It needs a delay of at least one frame.
    residual_nm, total_nm : (frames, n) array_like, optional
        Phase after and before the correction [nm], known to simulations only.
    times_s : (frames,) array_like, optional
        Time of each frame [s], rising; Unix time where it is of the sky.
    interaction_matrix : (q, n) array_like, optional
        Response S of the measurements to the modes.
    influence_matrix : (n, m) array_like, optional
        Response N of the modes to the commands.
    sensor_gain : float, optional
        Real gain of the sensor as a factor on the interaction matrix.
    command_unit, measurement_unit : str, optional
        Units; "nm" is rms of wavefront, and the only unit of length.
    shown_unit : str, optional
        Unit in which people see the wavefront: nm, um, mas or urad; all values stay in nm.
    diameter_m, obstruction : float, optional
        Telescope diameter [m], and that of its central obstruction as a fraction of it.
    imaging_wavelength_um : float, optional
        Wavelength of the camera [um].
    metadata : mapping of str to str, float, int or bool, optional
        What else is to be kept: the controller that ran, the digest of its gain file, a seed.

    Raises
    ------
    ProblemError
        If sizes clash, or a value is not finite, out of range or of another kind; or if the
        mirror does not fit the frame rate.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> seen = lbt.files.Telemetry(
    ...     frame_rate_hz=800,
    ...     delay_frames=2,
    ...     commands=[[0.0], [1.5]],
    ...     measurements=[[3.0], [2.0]],
    ...     metadata={"target": "none"},
    ... )
    >>> seen.frames, seen.modes, seen.commands.flags.writeable
    (2, 1, False)
    """

    frame_rate_hz: Positive
    measurements: FloatArray
    commands: FloatArray | None = None
    delay_frames: Annotated[float, ("at_least", 0), ("at_most", 1000)] | None = None
    mirror: PositionLoop | None = None
    residual_nm: FloatArray | None = None
    total_nm: FloatArray | None = None
    times_s: FloatArray | None = None
    interaction_matrix: FloatArray | None = None
    influence_matrix: FloatArray | None = None
    sensor_gain: Positive | None = None
    command_unit: str = "nm"
    measurement_unit: str = "nm"
    shown_unit: str = "nm"
    diameter_m: Positive | None = None
    obstruction: Obstruction | None = None
    imaging_wavelength_um: Positive | None = None
    metadata: Mapping[str, Scalar] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return two lines: what was recorded, and how the loop ran."""
        series = [layer.field for layer in LAYERS.values() if layer.axes.startswith("frame,")]
        series = [name for name in series if getattr(self, name) is not None]
        delay = "unknown" if self.delay_frames is None else f"{self.delay_frames:g} frames"
        return (
            f"<Telemetry: {self.frames} frames of {', '.join(series)},\n"
            f" {count_text(self.modes, 'mode')} at {self.frame_rate_hz:g} Hz, delay {delay}>"
        )

    def __post_init__(self) -> None:
        check_fields(self, metadata=_check_metadata(self.metadata))
        for name in ("command_unit", "measurement_unit"):
            _check_unit(getattr(self, name), name)
        require_unit(self.shown_unit)
        self._check_arrays()
        if self.mirror is not None:
            if self.delay_frames is None:
                raise ProblemError("telemetry of a mirror with dynamics needs delay_frames.")
            _ = self.mirror_taps  # what does not fit is refused

    def _check_arrays(self) -> None:
        """Refuse arrays of other sizes than their axes have in the arrays before them."""
        sizes: dict[str, tuple[int, str]] = {}  # of each axis, and the field that gave it
        for layer in LAYERS.values():
            if (value := getattr(self, layer.field)) is None and layer.field not in REQUIRED:
                continue
            axes = layer.axes.split(", ")
            if layer.field in _WITH_GAPS:
                array = frozen_copy(float_array(value, layer.field))
                real_array(
                    np.nan_to_num(array, nan=0.0, posinf=np.inf, neginf=-np.inf), layer.field
                )
            else:
                array = real_array(value, layer.field)
            if array.ndim == 0 and len(axes) == 2:
                array = frozen_copy(array.reshape(1, 1))
            if array.ndim != len(axes) or array.size == 0:
                raise DimensionError(
                    f"{layer.field} must be {len(axes)}-D ({layer.axes}) and not empty; got shape "
                    f"{array.shape}."
                )
            for axis, size in zip(axes, array.shape, strict=True):
                needed, giver = sizes.setdefault(axis, (size, layer.field))
                if size != needed:
                    raise DimensionError(
                        f"{layer.field} must have {count_text(needed, axis)} to match {giver}; "
                        f"got shape {array.shape}."
                    )
            set_fields(self, **{layer.field: array})
        if self.times_s is not None and np.any(np.diff(self.times_s) <= 0):
            raise ProblemError("times_s must rise from frame to frame.")

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(self.measurements.shape[0])

    @property
    def n_commands(self) -> int:
        """Number of commands; that of the modes in an open loop."""
        return self.modes if self.commands is None else int(self.commands.shape[1])

    @property
    def modes(self) -> int:
        """Number of modes n; that of the measurements, where no field gives it."""
        for layer in LAYERS.values():
            array, axes = getattr(self, layer.field), layer.axes.split(", ")
            if array is not None and "mode" in axes:
                return int(array.shape[axes.index("mode")])
        return int(self.measurements.shape[1])

    @property
    def mirror_taps(self) -> FloatArray | None:
        """Weights c of ``phi_cor(k) = N (c[0] u(k) + c[1] u(k-1) + ...)``, if there is a mirror."""
        if self.mirror is None or self.delay_frames is None:
            return None
        return LoopHardware(
            frame_rate_hz=self.frame_rate_hz, delay_frames=self.delay_frames, mirror=self.mirror
        ).mirror_taps

    @property
    def convention(self) -> str:
        """Meaning of the rows, in sentences that are stored in files."""
        return CONVENTION if self.mirror is None else MOVING_CONVENTION

    @property
    def hardware(self) -> LoopHardware:
        """The loop according to the telemetry, at sensor gain 1.

        Raises
        ------
        ProblemError
            If the delay is not known, or the response to the modes is not.
        """
        if self.delay_frames is None:
            raise ProblemError("this telemetry does not tell the delay of its loop.")
        n, q, m = self.modes, self.measurements.shape[1], self.n_commands
        sensor, influence = self.interaction_matrix, self.influence_matrix
        for what, name, missing, size in (
            ("measurements", "interaction", sensor is None, q),
            ("commands", "influence", influence is None, m),
        ):
            if missing and size != n:
                raise ProblemError(
                    f"this telemetry has {size} {what} of {n} modes, and no {name}_matrix."
                )
        return LoopHardware(
            frame_rate_hz=self.frame_rate_hz,
            delay_frames=self.delay_frames,
            sensor_matrix=np.eye(n) if sensor is None else sensor,
            influence_matrix=np.eye(n) if influence is None else influence,
            mirror=self.mirror,
        )
