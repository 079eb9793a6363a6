"""Telemetry: the series of a loop, with the facts that make them readable later."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.files.telemetry.conventions import CONVENTION, MOVING_CONVENTION
from lbt_synth.linear import Controller
from lbt_synth.models import LoopHardware, PositionLoop
from lbt_synth.validation import (
    FloatArray,
    frozen_copy,
    integer,
    matrix,
    number,
    real_array,
    require_instance,
    set_fields,
)

Scalar: TypeAlias = str | float | int | bool

_BOUNDED: dict[str, dict[str, Any]] = {
    "delay_frames": {"at_least": 0, "at_most": 1000},
    "psf_pixel_mas": {"above": 0},
    "imaging_wavelength_um": {"above": 0},
    "strehl": {"at_least": 0, "at_most": 1},
    "sensor_gain": {"above": 0},
    "diameter_m": {"above": 0},
    "obstruction": {"at_least": 0, "below": 1},
}
_MODE_AXES = {
    "residual_nm": 1,
    "total_nm": 1,
    "interaction_matrix": 1,
    "reconstructor": 0,
    "influence_matrix": 0,
    "mode_maps": 0,
}
_UNITS = ("command_unit", "measurement_unit", "slope_unit")
_LENGTHS = ("pm", "um", "mm", "m")
_LONGEST_UNIT = 24


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Telemetry:
    """Series of a loop, simulated or measured, and the facts of the loop.

    Row k of every series belongs to frame k, in the convention of :class:`LoopHardware`::

        y(k)       = sensor_gain S phi_res(k-1) + noise(k)
        phi_res(k) = phi_tot(k) - N u(k-d+1)

    with S the interaction and N the influence matrix, each the identity where it is not
    given. With a ``mirror`` it is ``phi_tot(k) - N (c[0] u(k) + c[1] u(k-1) + ...)`` with the
    taps c of :attr:`mirror_taps`. Where the slopes are recorded, they are
    ``sensor_gain S phi_res(k-1) + noise(k)``, and ``y(k)`` is the reconstructor times
    ``slopes(k)``.

    Parameters
    ----------
    frame_rate_hz : float
        Frame rate [Hz].
    commands : (frames, m) array_like
        Commands u(k), in ``command_unit``.
    measurements : (frames, q) array_like
        Measurements y(k), in ``measurement_unit``: coefficients of the modes, or what the
        sensor gave where no ``slopes`` are beside them.
    delay_frames : float, optional
        Total delay d [frames]; None if it is not known.
    mirror : PositionLoop, optional
        Dynamics of the mirror, as in :class:`LoopHardware`; a mirror that settles at once by
        default. It needs a delay of at least one frame.
    residual_nm, total_nm : (frames, n) array_like, optional
        Phase after and before the correction [nm], known to simulations only.
    slopes : (frames, s) array_like, optional
        What the sensor gave, of which the measurements are the modal coefficients (q = n).
    interaction_matrix : (s, n) array_like, optional
        Response S of the slopes to the modes; of the measurements, where there are no slopes.
    reconstructor : (n, s) array_like, optional
        From slopes to modes.
    influence_matrix : (n, m) array_like, optional
        Response N of the modes to the commands.
    mode_maps : (n, h, w) array_like, optional
        The modes as maps over the pupil, of rms 1.
    psf : (h, w) array_like, optional
        Image of the camera.
    psf_pixel_mas : float, optional
        Its pixel [mas].
    imaging_wavelength_um : float, optional
        Wavelength of the image and of the Strehl ratio [um].
    strehl : float, optional
        Strehl ratio, in [0, 1].
    times_s : (frames,) array_like, optional
        Time of each frame [s], rising; Unix time where it is of the sky.
    subaperture_axes : int, optional
        Values that a subaperture of the sensor gives: the slopes (the measurements, where
        there are no slopes) are that many blocks of one value per subaperture.
    command_unit, measurement_unit, slope_unit : str, optional
        Units; "nm" is rms of wavefront, and the only unit of length of the first two.
    sensor_gain : float, optional
        Real gain of the sensor as a factor on the interaction matrix.
    controller : Controller, optional
        The controller that ran, new-state form, from y(k) to u(k).
    controller_name : str, optional
        Its name.
    controller_digest : str, optional
        SHA-256 of its gain file, as sha256sum prints it.
    integrator_gains : (m,) array_like, optional
        Gain of each command's integrator.
    diameter_m, obstruction : float, optional
        Telescope diameter [m], and that of its central obstruction as a fraction of it.
    seed : int, optional
        Seed of a simulation.
    name : str, optional
        Name of the system.
    metadata : mapping of str to str, float, int or bool, optional
        Anything else.

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

    frame_rate_hz: float
    commands: FloatArray
    measurements: FloatArray
    delay_frames: float | None = None
    mirror: PositionLoop | None = None
    residual_nm: FloatArray | None = None
    total_nm: FloatArray | None = None
    slopes: FloatArray | None = None
    interaction_matrix: FloatArray | None = None
    reconstructor: FloatArray | None = None
    influence_matrix: FloatArray | None = None
    mode_maps: FloatArray | None = None
    psf: FloatArray | None = None
    psf_pixel_mas: float | None = None
    imaging_wavelength_um: float | None = None
    strehl: float | None = None
    times_s: FloatArray | None = None
    subaperture_axes: int = 1
    command_unit: str = "nm"
    measurement_unit: str = "nm"
    slope_unit: str = ""
    sensor_gain: float | None = None
    controller: Controller | None = None
    controller_name: str | None = None
    controller_digest: str | None = None
    integrator_gains: FloatArray | None = None
    diameter_m: float | None = None
    obstruction: float | None = None
    seed: int | None = None
    name: str = ""
    metadata: Mapping[str, Scalar] = field(default_factory=dict)

    def __post_init__(self) -> None:
        set_fields(self, frame_rate_hz=number(self.frame_rate_hz, "frame_rate_hz", above=0))
        for name, value in self._given(_BOUNDED).items():
            set_fields(self, **{name: number(value, name, **_BOUNDED[name])})
        if self.seed is not None:
            set_fields(self, seed=integer(self.seed, "seed", at_least=0))
        if self.mirror is not None:
            require_instance(self.mirror, PositionLoop)
            if self.delay_frames is None:
                raise ProblemError("telemetry of a mirror with dynamics needs delay_frames.")
            _ = self.mirror_taps  # what does not fit is refused
        self._check_series()
        self._check_matrices()
        self._check_words()
        self._check_controller()

    def _given(self, names: Iterable[str]) -> dict[str, Any]:
        """Return those of some fields that are set."""
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    def _check_series(self) -> None:
        commands = matrix(self.commands, "commands")
        if commands.size == 0:
            raise DimensionError(
                f"commands must have a frame and a command at least; got {commands.shape}."
            )
        set_fields(self, commands=commands)
        rows = (len(commands), f"to match commands {commands.shape}")
        others = self._given(("residual_nm", "total_nm", "slopes"))
        for name, value in {"measurements": self.measurements, **others}.items():
            series = matrix(value, name, rows=rows)
            if series.shape[1] == 0:
                raise DimensionError(f"{name} must have a column at least; got {series.shape}.")
            set_fields(self, **{name: series})
        if self.times_s is not None:
            times = real_array(self.times_s, "times_s")
            if times.shape != (self.frames,):
                raise DimensionError(
                    f"times_s must have shape ({self.frames},) to match commands "
                    f"{commands.shape}; got {times.shape}."
                )
            if np.any(np.diff(times) <= 0):
                raise ProblemError("times_s must rise from frame to frame.")
            set_fields(self, times_s=times)
        axes = integer(self.subaperture_axes, "subaperture_axes", at_least=1)
        if self.sensed.shape[1] % axes:
            raise DimensionError(
                f"subaperture_axes must divide the {self.sensed.shape[1]} values that the sensor "
                f"gives; got {axes}."
            )
        set_fields(self, subaperture_axes=axes)

    def _check_matrices(self) -> None:
        s, m = self.sensed.shape[1], self.commands.shape[1]
        sensed = (s, "to match what the sensor gives")
        commanded = (m, f"to match commands {self.commands.shape}")
        sizes: dict[str, dict[str, Any]] = {
            "interaction_matrix": {"rows": sensed},
            "reconstructor": {"cols": sensed},
            "influence_matrix": {"cols": commanded},
        }
        for name, value in self._given(sizes).items():
            set_fields(self, **{name: matrix(value, name, **sizes[name])})
        dimensions = {"mode_maps": 3, "psf": 2}
        for name, value in self._given(dimensions).items():
            image = real_array(value, name)
            if image.ndim != dimensions[name] or image.size == 0:
                raise DimensionError(
                    f"{name} must be {dimensions[name]}-D and not empty; got shape {image.shape}."
                )
            set_fields(self, **{name: image})
        counts = self._mode_counts()
        if len(set(counts.values())) > 1:
            found = ", ".join(f"{count} in {name}" for name, count in counts.items())
            raise DimensionError(f"the number of modes must be the same everywhere; got {found}.")
        if 0 in counts.values():
            raise DimensionError("there must be one mode at least; got none.")

    def _mode_counts(self) -> dict[str, int]:
        """Return the number of modes according to each field that has it."""
        counts = {
            name: int(array.shape[_MODE_AXES[name]])
            for name, array in self._given(_MODE_AXES).items()
        }
        if self.slopes is not None:
            counts["measurements, of which there are slopes"] = int(self.measurements.shape[1])
        return counts

    def _check_words(self) -> None:
        for name in _UNITS:
            unit = getattr(self, name)
            if (
                not isinstance(unit, str)
                or not (unit.isascii() and (unit.isprintable() and unit.strip() == unit))
                or len(unit) > _LONGEST_UNIT
                or "'" in unit  # a FITS card does not keep it in every place
            ):
                raise ProblemError(
                    f"{name} must be a word of at most {_LONGEST_UNIT} ASCII signs without a "
                    f"quote; got {unit!r}."
                )
            if name != "slope_unit" and unit in _LENGTHS:
                raise ProblemError(f"{name} must be nm for lengths; got {unit!r}. Convert them.")
        if not self.command_unit:
            raise ProblemError("command_unit must not be empty; write 1 for pure numbers.")
        for name in ("name", "controller_name", "controller_digest"):
            text = getattr(self, name)
            if not isinstance(text, str) and (name == "name" or text is not None):
                raise ProblemError(f"{name} must be a text; got {text!r}.")
        if not isinstance(self.metadata, Mapping):
            raise ProblemError(f"metadata must be a mapping; got {type(self.metadata).__name__}.")
        checked = {
            _check_key(key): _check_scalar(value, key) for key, value in self.metadata.items()
        }
        set_fields(self, metadata=MappingProxyType(checked))

    def _check_controller(self) -> None:
        m, q = self.commands.shape[1], self.measurements.shape[1]
        if self.integrator_gains is not None:
            gains = real_array(self.integrator_gains, "integrator_gains")
            if gains.shape != (m,):
                raise DimensionError(
                    f"integrator_gains must have shape ({m},), one per command; got {gains.shape}."
                )
            set_fields(self, integrator_gains=gains)
        k = self.controller
        if k is None:
            return
        if not isinstance(k, Controller):
            raise ProblemError(f"controller must be a Controller; got {type(k).__name__}.")
        if k.D.shape != (m, q):
            raise DimensionError(
                f"controller must map {q} measurements to {m} commands; got {k.D.shape[1]} to "
                f"{k.D.shape[0]}."
            )
        if not math.isclose(k.dt_s * self.frame_rate_hz, 1, rel_tol=1e-9):
            raise ProblemError(
                f"controller must run at {self.frame_rate_hz:.9g} Hz; got one for "
                f"{1 / k.dt_s:.9g} Hz."
            )

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(self.commands.shape[0])

    @property
    def modes(self) -> int:
        """Number of modes n; that of the measurements, where no field gives it."""
        return next(iter(self._mode_counts().values()), int(self.measurements.shape[1]))

    @property
    def sensed(self) -> FloatArray:
        """What the sensor gave: the slopes, or the measurements where there are none."""
        return self.measurements if self.slopes is None else self.slopes

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
        n, q, m = self.modes, self.measurements.shape[1], self.commands.shape[1]
        sensor, influence = self.interaction_matrix, self.influence_matrix
        if self.slopes is not None and sensor is not None:
            sensor = (
                None if self.reconstructor is None else frozen_copy(self.reconstructor @ sensor)
            )
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


def _check_key(key: Any) -> str:
    if not isinstance(key, str) or not key:
        raise ProblemError(f"the keys of metadata must be words; got {key!r}.")
    return key


def _check_scalar(value: Any, key: Any) -> Scalar:
    out = value.item() if isinstance(value, np.generic) else value
    if not isinstance(out, str | float | int | bool):
        raise ProblemError(
            f"metadata must hold texts, numbers and truth values; got {type(value).__name__} for "
            f"{key!r}."
        )
    if isinstance(out, float) and not math.isfinite(out):
        raise NonFiniteError(f"metadata must be finite; got {out} for {key!r}.")
    return out
