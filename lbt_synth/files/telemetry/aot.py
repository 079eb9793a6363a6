"""Telemetry in the layout of the Adaptive Optics Telemetry standard, through ``aotpy``.

Standard: T. Gomes et al., A&A (2024), DOI 10.1051/0004-6361/202348486; version 2.0.0.
It wants commands in metres, has no field for the true phase, and describes a controller by a
control matrix and one transfer function per mode instead of a state space. :func:`lost_fields`
returns what of a telemetry is lost.
"""

from __future__ import annotations

import io
import json
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.errors import FileError, OutputError, TelemetryError
from lbt_synth.files.telemetry.telemetry import Telemetry
from lbt_synth.files.telemetry.time_filters import integrator_gains, time_filters
from lbt_synth.models import PositionLoop
from lbt_synth.storage.array_file import check_fits, error_reason, read_cards
from lbt_synth.storage.warning_filters import ignore_warnings
from lbt_synth.validation import FloatArray

_VERSION_CARD = "AOT-VERS"
_OWN_CARD = "LBTSYNTH"  # one card with what the standard has no field for, JSON
_OWN_FIELDS = (
    *("seed", "name", "controller_name", "controller_digest", "metadata"),
    *("integrator_gains", "psf_pixel_mas"),
)
_OF_SUBAPERTURES = {
    *("measurements", "control_matrix"),
    *("measurements_to_modes", "modes_to_measurements"),
}
_NM = {"m": 1e9, "um": 1e3, "nm": 1.0}
_RAD_PER_MAS = np.pi / 180 / 3600e3
_FOREIGN = "that of another program: the AOT standard does not say which exposure a row is of"
_UNSAFE = "'&/"  # characters that a FITS text over several cards does not always keep
_INSTALL = 'it needs aotpy: pip install "lbt-synth[aot]"'


def is_aot(content: bytes) -> bool:
    """Whether the first header of FITS content says that it is of the standard."""
    with suppress(ValueError):
        return bool(read_cards(io.BytesIO(content), [_VERSION_CARD]))
    return False


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
    if telemetry.commands is None:
        raise OutputError("the AOT standard holds closed loops; got an open one.", path=target)
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
    diameter, ratio, m = seen.diameter_m, seen.obstruction, seen.n_commands
    telescope = aotpy.MainTelescope(
        "Telescope",
        enclosing_diameter=diameter,
        inscribed_diameter=diameter,
        obstruction_diameter=None if diameter is None or ratio is None else diameter * ratio,
    )
    star = aotpy.NaturalGuideStar("Guide star")
    clock = aotpy.Time("Frames", frame_numbers=list(map(float, range(seen.frames))))
    if seen.times_s is not None:
        clock.timestamps = seen.times_s.tolist()
    units = _units(seen)
    images = {}
    for name, data in _arrays(seen).items():
        # series have a clock, and the precision that was chosen
        digits, time = (precision, clock) if name in units else ("float64", None)
        text, unit = name.upper().replace("_", " "), units.get(name) or None
        images[name] = aotpy.Image(text, data.astype(digits), unit=unit, time=time)
    sensor = aotpy.Pyramid(
        "Pyramid",
        source=star,
        dimensions=seen.subaperture_axes,
        n_valid_subapertures=seen.sensed.shape[1] // seen.subaperture_axes,
        n_sides=4,
        measurements=images.pop("measurements"),
        optical_gain=images.pop("optical_gain", None),
    )
    cameras = _cameras(aotpy, seen, images.pop("psf", None))
    kind = aotpy.TipTiltMirror if m == 2 else partial(aotpy.DeformableMirror, n_valid_actuators=m)
    mirror = kind("Mirror", telescope=telescope)
    loop = aotpy.ControlLoop(
        "Control loop",
        input_sensor=sensor,
        commanded_corrector=mirror,
        time=clock,
        framerate=seen.frame_rate_hz,
        delay=seen.delay_frames,
        **images,
    )
    return aotpy.AOSystem(
        ao_mode="SCAO",
        name=_to_ascii(seen.name) or None,
        strehl_ratio=seen.strehl,
        config=seen.convention
        + " Time filters: sum b_i z^i / sum a_i z^i, after the control matrix.",
        main_telescope=telescope,
        sources=[star],
        scoring_cameras=cameras,
        wavefront_sensors=[sensor],
        wavefront_correctors=[mirror],
        loops=[loop],
        metadata=_header_cards(aotpy, seen),
    )


def _cameras(aotpy: Any, seen: Telemetry, picture: Any) -> list[Any]:
    """Return the camera that took the image, if there is one."""
    if picture is None:
        return []
    pixel = None if seen.psf_pixel_mas is None else seen.psf_pixel_mas * _RAD_PER_MAS
    detector = aotpy.Detector("Camera detector", pixel_intensities=picture, pixel_scale=pixel)
    return [aotpy.ScoringCamera("Camera", detector=detector, wavelength=_wavelength_m(seen))]


def _units(seen: Telemetry) -> dict[str, str]:
    """Return the unit of each series, by aotpy's names."""
    unit = "m" if seen.command_unit == "nm" else seen.command_unit
    return {
        "commands": unit,
        "residual_commands": unit,
        "measurements": seen.measurement_unit if seen.slopes is None else seen.slope_unit,
        "modal_coefficients": seen.measurement_unit,
    }


def _arrays(seen: Telemetry) -> dict[str, FloatArray]:
    """Return the series, matrices, images and time filters that there are, by aotpy's names."""
    metres, axes = 1e-9 if seen.command_unit == "nm" else 1.0, seen.subaperture_axes
    back, response, filters = seen.reconstructor, seen.interaction_matrix, _filters(seen)
    arrays: dict[str, Any] = {
        "commands": None if seen.commands is None else metres * seen.commands,
        "measurements": seen.sensed,
        "modal_coefficients": None if seen.slopes is None else seen.measurements,
        "optical_gain": None if seen.sensor_gain is None else [seen.sensor_gain],
        "modes": seen.mode_maps,
        "measurements_to_modes": back,
        "modes_to_measurements": None if response is None else response.T,
        "commands_to_modes": seen.influence_matrix,
        "psf": None if seen.psf is None else [seen.psf],
    }
    if filters is not None:
        matrix, numerators, denominators = filters
        control: FloatArray | None = matrix
        if seen.slopes is not None:
            control = None if back is None else matrix @ back
        arrays |= {
            "residual_commands": metres * seen.measurements @ matrix.T,
            "control_matrix": control,
            "time_filter_num": numerators,
            "time_filter_den": denominators,
        }
    out = {name: np.asarray(data) for name, data in arrays.items() if data is not None}
    for name in _OF_SUBAPERTURES & out.keys():
        # (rows, s) to (rows, d, s_v), d values from each of s_v subapertures
        out[name] = out[name].reshape(len(out[name]), axes, -1)
    if response is not None:  # (s_v, d, n)
        out["modes_to_measurements"] = out["modes_to_measurements"].transpose(2, 1, 0)
    return out


def _header_cards(aotpy: Any, seen: Telemetry) -> list[Any]:
    """Cards of the primary header, for what the tables have no place for."""
    own = {name: getattr(seen, name) for name in _OWN_FIELDS} | {"metadata": dict(seen.metadata)}
    if seen.integrator_gains is not None:
        own["integrator_gains"] = seen.integrator_gains.tolist()
    if seen.psf is not None:  # beside the image
        own["psf_pixel_mas"] = None
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


def _filters(seen: Telemetry) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    if seen.controller is not None:
        return time_filters(seen.controller)
    gains, (m, q) = seen.integrator_gains, (seen.n_commands, seen.measurements.shape[1])
    if gains is None or m != q:
        return None
    return np.eye(m), np.outer(gains, [0.0, 1.0]), np.tile([-1.0, 1.0], (m, 1))


def _wavelength_m(seen: Telemetry) -> float | None:
    return None if seen.imaging_wavelength_um is None else seen.imaging_wavelength_um * 1e-6


def _to_ascii(text: str) -> str:
    safe = (c if c.isascii() and c.isprintable() and c not in _UNSAFE else "?" for c in text)
    return "".join(safe).strip()


def from_bytes(content: bytes, source: Path) -> Telemetry:
    """Read the first control loop that has series, and what describes it."""
    aotpy = require_aotpy(source, TelemetryError, "read")
    with ignore_warnings():  # foreign files deviate in many small ways
        try:
            check_fits(content)
            # other files and addresses that this one refers to are not opened
            reader = aotpy.AOTFITSReader(io.BytesIO(content), externals="disallow", memmap=False)
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
    fields = _loop_fields(loops[0]) | _system_fields(system)
    if len(loops) > 1:
        fields["metadata"] = {**fields["metadata"], "aot_loop": loops[0].uid}
    return Telemetry(**fields)


def _system_fields(system: Any) -> dict[str, Any]:
    """Fields that belong to the whole system."""
    facts: dict[str, Any] = {"name": system.name or "", "strehl": system.strehl_ratio}
    facts["metadata"] = {"timing": _FOREIGN}
    for datum in system.metadata:
        if datum.key == _OWN_CARD:
            own = json.loads(datum.value)
            facts |= {name: own[name] for name in _OWN_FIELDS}
            if "mirror" in own:
                facts["mirror"] = PositionLoop(**own["mirror"])
    telescope = system.main_telescope
    if telescope is not None:
        facts["diameter_m"] = telescope.enclosing_diameter or telescope.inscribed_diameter
        if facts["diameter_m"] and telescope.obstruction_diameter is not None:
            facts["obstruction"] = telescope.obstruction_diameter / facts["diameter_m"]
    wavelength = system.strehl_wavelength
    for camera in system.scoring_cameras[:1]:
        wavelength = camera.wavelength if wavelength is None else wavelength
        frames = _data(getattr(camera.detector, "pixel_intensities", None))
        if frames is not None:
            facts["psf"] = frames.mean(axis=0) if frames.ndim == 3 else frames
            if camera.detector.pixel_scale is not None:
                facts["psf_pixel_mas"] = camera.detector.pixel_scale / _RAD_PER_MAS
    facts["imaging_wavelength_um"] = None if wavelength is None else wavelength * 1e6
    return facts


def _loop_fields(loop: Any) -> dict[str, Any]:
    """Fields that belong to a loop and its sensor."""
    sensor, modal, clock = loop.input_sensor, loop.modal_coefficients, loop.time
    commands, command_unit = _in_nm(loop.commands, "m")
    gain, response = _data(sensor.optical_gain), _data(loop.modes_to_measurements)
    sensed, back = _data(sensor.measurements), _data(loop.measurements_to_modes)
    fields: dict[str, Any] = {
        "commands": commands,
        "command_unit": command_unit,
        "delay_frames": loop.delay,
        "subaperture_axes": sensed.shape[1] if sensed.ndim == 3 else 1,
        "influence_matrix": _data(loop.commands_to_modes),
        "mode_maps": _data(loop.modes),
        "interaction_matrix": response,
        "reconstructor": None if back is None else back.reshape(len(back), -1),
        "sensor_gain": None if gain is None else float(np.mean(gain)),
        "times_s": getattr(clock or loop.commands.time, "timestamps", None) or None,
    }
    fields["frame_rate_hz"] = _frame_rate(loop, fields["times_s"])
    y, fields["measurement_unit"] = _in_nm(sensor.measurements if modal is None else modal)
    fields["measurements"] = y.reshape(len(y), -1) if modal is None else y
    if modal is not None:
        fields["slopes"] = sensed.reshape(len(sensed), -1)
        fields["slope_unit"] = sensor.measurements.unit or ""
    if response is not None and response.ndim == 3:  # (s_v, d, n) to (d s_v, n)
        fields["interaction_matrix"] = response.transpose(1, 0, 2).reshape(-1, response.shape[2])
    filters = [_data(loop.time_filter_num), _data(loop.time_filter_den)]
    if all(each is not None for each in filters):
        gains = integrator_gains(*map(np.atleast_2d, filters))
        if gains is not None and len(gains) in (1, commands.shape[-1]):  # one row serves all
            fields["integrator_gains"] = np.broadcast_to(gains, commands.shape[-1:])
    return fields


def _frame_rate(loop: Any, times: list[float] | None) -> float:
    for rate in (loop.framerate, getattr(loop.input_sensor.detector, "frame_rate", None)):
        if rate is not None:
            return float(rate)
    if times is not None and len(times) > 1 and times[-1] > times[0]:
        return float((len(times) - 1) / (times[-1] - times[0]))
    raise KeyError("the frame rate")


def _data(image: Any) -> Any:
    return None if image is None else np.asarray(image.data, dtype=np.float64)


def _in_nm(image: Any, unit: str = "") -> tuple[FloatArray, str]:
    """Return lengths in nm, and other values in their own unit, or in a default one."""
    unit = image.unit or unit
    factor = _NM.get(unit)
    return (_data(image), unit) if factor is None else (factor * _data(image), "nm")
