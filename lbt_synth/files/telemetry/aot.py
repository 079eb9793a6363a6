"""Telemetry in the layout of the Adaptive Optics Telemetry standard, through ``aotpy``.

Standard: T. Gomes et al., A&A (2024), DOI 10.1051/0004-6361/202348486; version 2.0.0.
It wants commands in metres, has no field for the true phase, and describes a controller by a
control matrix and one transfer function per mode instead of a state space. :func:`lost_fields`
returns what of a telemetry is lost.
"""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from lbt_synth.errors import FileError, OutputError, TelemetryError
from lbt_synth.files.telemetry.native_layout import check_taps
from lbt_synth.files.telemetry.telemetry import Telemetry
from lbt_synth.files.telemetry.time_filters import TimeFilters, integrator_gains, time_filters
from lbt_synth.models import PositionLoop
from lbt_synth.storage.array_file import error_reason
from lbt_synth.storage.fits import has_card
from lbt_synth.validation import FloatArray

_MakeImage: TypeAlias = Callable[..., Any]  # from a name and an array

_OWN_CARD = "LBTSYNTH"  # one card with what the standard has no field for, JSON
_OWN_FIELDS = ("seed", "name", "controller_name", "controller_digest", "metadata")
_NM = {"m": 1e9, "um": 1e3, "nm": 1.0}
_RAD_PER_MAS = np.pi / 180 / 3600e3
_FOREIGN = "that of another program: the AOT standard does not say which exposure a row is of"
_UNSAFE = "'&/"  # characters that a FITS text over several cards does not always keep
_INSTALL = 'it needs aotpy: pip install "lbt-synth[aot]"'


def is_aot(content: bytes) -> bool:
    """Whether the first header of a FITS file says that it is of the standard."""
    return has_card(content, "AOT-VERS")


def lost_fields(telemetry: Telemetry) -> tuple[str, ...]:
    """Return the fields of a telemetry that are set and that the standard does not hold."""
    without = ["residual_nm", "total_nm", "controller"]
    if telemetry.diameter_m is None:
        without.append("obstruction")  # the standard has it as a diameter
    return tuple(name for name in without if getattr(telemetry, name) is not None)


def require_aotpy(path: Path, error: type[FileError] = OutputError, verb: str = "write") -> Any:
    """Return the module; refuse to write or read a file where it is missing."""
    try:
        import aotpy
    except ImportError as missing:
        raise error(f"cannot {verb} {path}: {_INSTALL}.", path=path) from missing
    return aotpy


def to_bytes(telemetry: Telemetry, precision: str, target: Path) -> bytes:
    """Return the content of an AOT file."""
    from astropy.io import fits

    aotpy = require_aotpy(target)
    plain, checked = io.BytesIO(), io.BytesIO()
    aotpy.AOTFITSWriter(_to_system(aotpy, telemetry, precision)).get_hdulist().writeto(plain)
    # astropy's checksum of a table is right only once the table has been in a file
    with fits.open(io.BytesIO(plain.getvalue()), memmap=False) as units:
        for unit in units:
            unit.add_checksum(when="of this unit")
        units.writeto(checked)
    return checked.getvalue()


def _to_system(aotpy: Any, seen: Telemetry, precision: str) -> Any:
    """Describe telemetry as an ``AOSystem`` of aotpy."""
    obstruction = None
    if seen.diameter_m is not None and seen.obstruction is not None:
        obstruction = seen.diameter_m * seen.obstruction
    telescope = aotpy.MainTelescope(
        "Telescope",
        enclosing_diameter=seen.diameter_m,
        inscribed_diameter=seen.diameter_m,
        obstruction_diameter=obstruction,
    )
    star = aotpy.NaturalGuideStar("Guide star")
    clock = aotpy.Time("Frames", frame_numbers=list(map(float, range(seen.frames))))
    if seen.times_s is not None:
        clock.timestamps = seen.times_s.tolist()

    def image(
        name: str, data: npt.NDArray[Any] | None, unit: str = "", *, timed: bool = False
    ) -> Any:
        if data is None:
            return None
        stored = data.astype(np.float32 if timed and precision == "float32" else np.float64)
        return aotpy.Image(name, stored, unit=unit or None, time=clock if timed else None)

    sensor = _sensor(aotpy, seen, image, star)
    m = seen.commands.shape[1]
    if m == 2:
        mirror = aotpy.TipTiltMirror("Mirror", telescope=telescope)
    else:
        mirror = aotpy.DeformableMirror("Mirror", telescope=telescope, n_valid_actuators=m)
    loop = aotpy.ControlLoop(
        "Control loop",
        input_sensor=sensor,
        commanded_corrector=mirror,
        time=clock,
        framerate=seen.frame_rate_hz,
        delay=seen.delay_frames,
        **_loop_images(seen, image),
    )
    return aotpy.AOSystem(
        ao_mode="SCAO",
        name=_to_ascii(seen.name) or None,
        strehl_ratio=seen.strehl,
        config=seen.convention
        + " Time filters: sum b_i z^i / sum a_i z^i, after the control matrix.",
        main_telescope=telescope,
        sources=[star],
        scoring_cameras=_cameras(aotpy, seen, image),
        wavefront_sensors=[sensor],
        wavefront_correctors=[mirror],
        loops=[loop],
        metadata=_header_cards(aotpy, seen),
    )


def _sensor(aotpy: Any, seen: Telemetry, image: _MakeImage, star: Any) -> Any:
    axes, subapertures = seen.subaperture_axes, seen.sensed.shape[1] // seen.subaperture_axes
    unit = seen.measurement_unit if seen.slopes is None else seen.slope_unit
    measured = seen.sensed.reshape(seen.frames, axes, subapertures)
    gain = None if seen.sensor_gain is None else np.array([seen.sensor_gain])
    return aotpy.Pyramid(
        "Pyramid",
        source=star,
        dimensions=axes,
        n_valid_subapertures=subapertures,
        n_sides=4,
        measurements=image("MEASUREMENTS", measured, unit, timed=True),
        optical_gain=image("OPTICAL GAIN", gain),
    )


def _loop_images(seen: Telemetry, image: _MakeImage) -> dict[str, Any]:
    """Series, matrices and time filters of a control loop, by aotpy's names."""
    metres, unit = (1e-9, "m") if seen.command_unit == "nm" else (1.0, seen.command_unit)
    axes, modal, matrix = seen.subaperture_axes, None, None
    numerators, denominators, residual = None, None, None
    if (filters := _filters(seen)) is not None:
        matrix, numerators, denominators = filters.matrix, filters.numerators, filters.denominators
        residual = metres * seen.measurements @ matrix.T
    if seen.slopes is not None:
        modal = seen.measurements
        if matrix is not None:
            matrix = None if seen.reconstructor is None else matrix @ seen.reconstructor
    response = seen.interaction_matrix
    if response is not None:  # (s, n) to (s_v, d, n)
        response = response.reshape(axes, -1, response.shape[1]).transpose(1, 0, 2)
    back = _split_by_subaperture(seen.reconstructor, axes)
    return {
        "commands": image("COMMANDS", metres * seen.commands, unit, timed=True),
        "time_filter_num": image("TIME FILTER NUM", numerators),
        "time_filter_den": image("TIME FILTER DEN", denominators),
        "modes": image("MODES", seen.mode_maps),
        "modal_coefficients": image("MODAL COEFFICIENTS", modal, seen.measurement_unit, timed=True),
        "control_matrix": image("CONTROL MATRIX", _split_by_subaperture(matrix, axes)),
        "residual_commands": image("RESIDUAL COMMANDS", residual, unit, timed=True),
        "measurements_to_modes": image("MEASUREMENTS TO MODES", back),
        "modes_to_measurements": image("MODES TO MEASUREMENTS", response),
        "commands_to_modes": image("COMMANDS TO MODES", seen.influence_matrix),
    }


def _cameras(aotpy: Any, seen: Telemetry, image: _MakeImage) -> list[Any]:
    """Return the camera that took the image, if there is one."""
    if seen.psf is None:
        return []
    pixel = None if seen.psf_pixel_mas is None else seen.psf_pixel_mas * _RAD_PER_MAS
    detector = aotpy.Detector(
        "Camera detector", pixel_intensities=image("PSF", seen.psf[None]), pixel_scale=pixel
    )
    return [aotpy.ScoringCamera("Camera", detector=detector, wavelength=_wavelength_m(seen))]


def _header_cards(aotpy: Any, seen: Telemetry) -> list[Any]:
    """Cards of the primary header, for what the tables have no place for."""
    own = {name: getattr(seen, name) for name in _OWN_FIELDS} | {"metadata": dict(seen.metadata)}
    gains = seen.integrator_gains
    own["integrator_gains"] = None if gains is None else gains.tolist()
    own["psf_pixel_mas"] = seen.psf_pixel_mas if seen.psf is None else None
    if seen.mirror is not None and seen.mirror_taps is not None:
        # the standard does not say what its TFZ_NUM and TFZ_DEN of a corrector act on, nor with
        # which delay
        own["mirror"], own["mirror_taps"] = asdict(seen.mirror), seen.mirror_taps.tolist()
    if seen.controller is not None:
        own["controller_states"] = seen.controller.n_states
    text = json.dumps(own, allow_nan=False)
    for sign in _UNSAFE:  # they stand only in texts, where JSON may write them by their number
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    cards = [aotpy.Metadatum(_OWN_CARD, text)]
    if (wavelength := _wavelength_m(seen)) is not None:
        # aotpy 3.2.1 writes its strehl_wavelength over the Strehl ratio
        cards.append(aotpy.Metadatum("STREHL-L", wavelength))
    return cards


def _filters(seen: Telemetry) -> TimeFilters | None:
    if seen.controller is not None:
        return time_filters(seen.controller)
    gains, (m, q) = seen.integrator_gains, (seen.commands.shape[1], seen.measurements.shape[1])
    if gains is None or m != q:
        return None
    return TimeFilters(
        matrix=np.eye(m),
        numerators=np.outer(gains, [0.0, 1.0]),
        denominators=np.tile([-1.0, 1.0], (m, 1)),
    )


def _split_by_subaperture(matrix: FloatArray | None, axes: int) -> FloatArray | None:
    """Reshape (rows, s) to (rows, d, s_v), d values from each of s_v subapertures."""
    return None if matrix is None else matrix.reshape(len(matrix), axes, -1)


def _wavelength_m(seen: Telemetry) -> float | None:
    wavelength = seen.imaging_wavelength_um
    return None if wavelength is None else wavelength * 1e-6


def _to_ascii(text: str) -> str:
    safe = (c if c.isascii() and c.isprintable() and c not in _UNSAFE else "?" for c in text)
    return "".join(safe).strip()


def from_bytes(content: bytes, source: Path) -> Telemetry:
    """Read the first control loop that has series, and what describes it."""
    aotpy = require_aotpy(source, TelemetryError, "read")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # foreign files deviate in many small ways
        try:
            # other files and addresses that this one refers to are not opened
            warnings.filterwarnings("error", message=".*verification failed")  # of a checksum
            reader = aotpy.AOTFITSReader(
                io.BytesIO(content), externals="disallow", memmap=False, checksum=True
            )
            system = reader.get_system()
        except Exception as error:  # damage and deviations, in whatever way they show
            raise TelemetryError(
                f"{source} is no file of the AOT standard, or it is damaged: "
                f"{error_reason(error)}.",
                path=source,
            ) from error
    loops = [
        loop
        for loop in system.loops
        if getattr(loop, "input_sensor", None) is not None
        and loop.commands is not None
        and loop.input_sensor.measurements is not None
    ]
    if not loops:
        raise TelemetryError(
            f"{source} has no control loop with commands and measurements.", path=source
        )
    fields = _series_fields(loops[0]) | _system_fields(system)
    if len(loops) > 1:
        fields["metadata"] = {**fields["metadata"], "aot_loop": loops[0].uid}
    taps = fields.pop("mirror_taps", None)
    return check_taps(Telemetry(**fields), taps)


def _system_fields(system: Any) -> dict[str, Any]:
    """Fields that belong to the whole system."""
    facts: dict[str, Any] = {"name": system.name or "", "strehl": system.strehl_ratio}
    facts["metadata"] = {"timing": _FOREIGN}
    for datum in system.metadata:
        if datum.key == _OWN_CARD:
            own = json.loads(datum.value)
            facts |= {
                name: own[name] for name in (*_OWN_FIELDS, "integrator_gains", "psf_pixel_mas")
            }
            if "mirror" in own:
                facts["mirror"] = PositionLoop(**own["mirror"])
                facts["mirror_taps"] = own["mirror_taps"]
    telescope = system.main_telescope
    if telescope is not None:
        facts["diameter_m"] = telescope.enclosing_diameter or telescope.inscribed_diameter
        if facts["diameter_m"] and telescope.obstruction_diameter is not None:
            facts["obstruction"] = telescope.obstruction_diameter / facts["diameter_m"]
    wavelength = system.strehl_wavelength
    for camera in system.scoring_cameras[:1]:
        wavelength = camera.wavelength if wavelength is None else wavelength
        detector = camera.detector
        if detector is not None and detector.pixel_intensities is not None:
            frames = np.asarray(detector.pixel_intensities.data, dtype=np.float64)
            facts["psf"] = frames.mean(axis=0) if frames.ndim == 3 else frames
            if detector.pixel_scale is not None:
                facts["psf_pixel_mas"] = detector.pixel_scale / _RAD_PER_MAS
    facts["imaging_wavelength_um"] = None if wavelength is None else wavelength * 1e6
    return facts


def _series_fields(loop: Any) -> dict[str, Any]:
    """Fields that belong to a loop and its sensor."""
    sensor = loop.input_sensor
    measured, unit = _image_data(sensor.measurements), sensor.measurements.unit
    commands, command_unit = _to_nm(_image_data(loop.commands), loop.commands.unit or "m")
    fields: dict[str, Any] = {
        "commands": commands,
        "command_unit": command_unit,
        "delay_frames": loop.delay,
        "subaperture_axes": measured.shape[1] if measured.ndim == 3 else 1,
        "influence_matrix": _image_data(loop.commands_to_modes),
        "mode_maps": _image_data(loop.modes),
    }
    flat = measured.reshape(len(measured), -1)
    if loop.modal_coefficients is not None:
        modal = loop.modal_coefficients
        fields["slopes"], fields["slope_unit"] = flat, unit or ""
        fields["measurements"], fields["measurement_unit"] = _to_nm(
            _image_data(modal), modal.unit or ""
        )
    else:
        fields["measurements"], fields["measurement_unit"] = _to_nm(flat, unit or "")
    back = _image_data(loop.measurements_to_modes)
    fields["reconstructor"] = None if back is None else back.reshape(len(back), -1)
    response = _image_data(loop.modes_to_measurements)
    if response is not None:
        if response.ndim == 3:  # (s_v, d, n) to (d s_v, n)
            response = response.transpose(1, 0, 2).reshape(-1, response.shape[2])
        fields["interaction_matrix"] = response
    if sensor.optical_gain is not None:
        fields["sensor_gain"] = float(np.mean(_image_data(sensor.optical_gain)))
    clock = loop.time or loop.commands.time
    if clock is not None and clock.timestamps:
        fields["times_s"] = clock.timestamps
    fields["frame_rate_hz"] = _frame_rate(loop, fields.get("times_s"))
    if loop.time_filter_num is not None and loop.time_filter_den is not None:
        pair = (np.atleast_2d(_image_data(f)) for f in (loop.time_filter_num, loop.time_filter_den))
        gains = integrator_gains(*pair)
        m = commands.shape[-1]
        if gains is not None and len(gains) in (1, m):  # one row serves all
            fields["integrator_gains"] = np.broadcast_to(gains, (m,))
    return fields


def _frame_rate(loop: Any, times: list[float] | None) -> float:
    if loop.framerate is not None:
        return float(loop.framerate)
    detector = loop.input_sensor.detector
    if detector is not None and detector.frame_rate is not None:
        return float(detector.frame_rate)
    if times is not None and len(times) > 1 and times[-1] > times[0]:
        return float((len(times) - 1) / (times[-1] - times[0]))
    raise KeyError("the frame rate")


def _image_data(image: Any) -> Any:
    return None if image is None else np.asarray(image.data, dtype=np.float64)


def _to_nm(values: FloatArray, unit: str) -> tuple[FloatArray, str]:
    """Return lengths in nm, and other values in their own unit."""
    factor = _NM.get(unit)
    return (values, unit) if factor is None else (factor * values, "nm")
