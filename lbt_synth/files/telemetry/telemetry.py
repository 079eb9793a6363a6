"""Telemetry: the series of a loop, with the facts that make them readable later."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np
import numpy.typing as npt

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.files.telemetry.fields import (
    ARRAYS,
    CONVENTION,
    FACTS,
    MOVING_CONVENTION,
    REQUIRED,
    Scalar,
    check_metadata,
)
from lbt_synth.linear import Controller
from lbt_synth.models import LoopHardware, PositionLoop
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, frozen_copy, real_array, require_instance, set_fields

_SAME_TAPS = 1e-9  # largest difference between the taps of a file and those of its mirror


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
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name in FACTS and (value is not None or each.default is not None):
                set_fields(self, **{each.name: FACTS[each.name].check(value, each.name)})
        set_fields(self, metadata=check_metadata(self.metadata))
        self._check_arrays()
        if self.mirror is not None:
            require_instance(self.mirror, PositionLoop)
            if self.delay_frames is None:
                raise ProblemError("telemetry of a mirror with dynamics needs delay_frames.")
            _ = self.mirror_taps  # what does not fit is refused
        if self.controller is not None:
            self._check_controller(self.controller)

    def _check_arrays(self) -> None:
        """Refuse arrays of other sizes than their axes have in the arrays before them."""
        same = {"sensed": "measurement", "slope": "measurement"}
        if self.slopes is not None:
            same = {"sensed": "slope", "measurement": "mode"}
        sizes: dict[str, tuple[int, str]] = {}  # of each axis, and the field that gave it
        for layer in ARRAYS:
            if (value := getattr(self, layer.field)) is None and layer.field not in REQUIRED:
                continue
            array, axes = real_array(value, layer.field), layer.axes.split(", ")
            if array.ndim == 0 and len(axes) == 2:
                array = frozen_copy(array.reshape(1, 1))
            if array.ndim != len(axes) or array.size == 0:
                raise DimensionError(
                    f"{layer.field} must be {len(axes)}-D ({layer.axes}) and not empty; got shape "
                    f"{array.shape}."
                )
            for axis, size in zip(axes, array.shape, strict=True):
                if axis in ("row", "column"):  # each image has its own
                    continue
                word = same.get(axis, axis)
                needed, giver = sizes.setdefault(word, (size, layer.field))
                if size != needed:
                    raise DimensionError(
                        f"{layer.field} must have {count_text(needed, word)} to match {giver}; "
                        f"got shape {array.shape}."
                    )
            set_fields(self, **{layer.field: array})
        if self.times_s is not None and np.any(np.diff(self.times_s) <= 0):
            raise ProblemError("times_s must rise from frame to frame.")
        if self.sensed.shape[1] % self.subaperture_axes:
            raise DimensionError(
                f"subaperture_axes must divide the {self.sensed.shape[1]} values that the sensor "
                f"gives; got {self.subaperture_axes}."
            )

    def _check_controller(self, controller: Controller) -> None:
        require_instance(controller, Controller, "controller")
        m, q = self.commands.shape[1], self.measurements.shape[1]
        if controller.D.shape != (m, q):
            raise DimensionError(
                f"controller must map {q} measurements to {m} commands; got "
                f"{controller.D.shape[1]} to {controller.D.shape[0]}."
            )
        if not math.isclose(controller.dt_s * self.frame_rate_hz, 1, rel_tol=1e-9):
            raise ProblemError(
                f"controller must run at {self.frame_rate_hz:.9g} Hz; got one for "
                f"{1 / controller.dt_s:.9g} Hz."
            )

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(self.commands.shape[0])

    @property
    def modes(self) -> int:
        """Number of modes n; that of the measurements, where no field gives it."""
        for layer in ARRAYS:
            array, axes = getattr(self, layer.field), layer.axes.split(", ")
            if array is not None and "mode" in axes:
                return int(array.shape[axes.index("mode")])
        return int(self.measurements.shape[1])

    @property
    def sensed(self) -> FloatArray:
        """What the sensor gave: the slopes, or the measurements where there are none."""
        return self.measurements if self.slopes is None else self.slopes

    @property
    def modal_response(self) -> FloatArray | None:
        """Response of the measurements to the modes, behind a reconstructor of slopes."""
        if self.slopes is None or self.interaction_matrix is None:
            return self.interaction_matrix
        return None if self.reconstructor is None else self.reconstructor @ self.interaction_matrix

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
        sensor, influence = self.modal_response, self.influence_matrix
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


def check_taps(telemetry: Telemetry, taps: npt.ArrayLike | None) -> Telemetry:
    """Return telemetry, or refuse it if its mirror does not have the taps of its file."""
    own = telemetry.mirror_taps
    if (own is None) != (taps is None):
        raise ValueError("a mirror and its taps go together; it has one of them")
    if own is not None and taps is not None:
        found = np.asarray(taps, dtype=np.float64)
        size = max(own.size, found.size)
        one, other = (np.pad(each.ravel(), (0, size - each.size)) for each in (own, found))
        if not np.allclose(one, other, rtol=0, atol=_SAME_TAPS):
            raise ValueError("its taps are not those of its mirror")
    return telemetry
