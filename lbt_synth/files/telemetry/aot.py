"""Telemetry in the layout of the Adaptive Optics Telemetry standard, through ``aotpy``.

Standard: T. Gomes et al., A&A (2024), DOI 10.1051/0004-6361/202348486; version 2.0.0.
It wants commands in metres and has no field for the true phase, nor for the local loop of a mirror.
:func:`lost_fields` returns what of a telemetry is lost.
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
from lbt_synth.models import PositionLoop
from lbt_synth.storage.array_file import error_reason, open_fits, read_cards
from lbt_synth.storage.warning_filters import ignore_warnings
from lbt_synth.validation import FloatArray

_VERSION_CARD = "AOT-VERS"
_OWN_CARD = "LBTSYNTH"  # one card with what the standard has no field for, JSON
_NM = {"m": 1e9, "um": 1e3, "nm": 1.0}
_FOREIGN = "that of another program: the AOT standard does not say which exposure a row is of"
NO_LOOPS = "loop chooses a control loop of a file of the AOT standard; this is none. Leave it out."
_UNSAFE = "'&/"  # characters that a FITS text over several cards does not always keep
_INSTALL = 'it needs aotpy: pip install "lbt-synth[aot]"'


def is_aot(content: bytes) -> bool:
    """Whether the first header of FITS content says that it is of the standard."""
    with suppress(ValueError):
        return bool(read_cards(io.BytesIO(content), [_VERSION_CARD]))
    return False


def lost_fields(telemetry: Telemetry) -> tuple[str, ...]:
    """Return the fields of a telemetry that are set and that the standard does not hold."""
    without = ["residual_nm", "total_nm"]
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


def to_bytes(telemetry: Telemetry, target: Path) -> bytes:
    """Return the content of an AOT file."""
    from astropy.io import fits

    aotpy = require_aotpy(target)
    if telemetry.commands is None:
        raise OutputError("the AOT standard holds closed loops; got an open one.", path=target)
    plain, checked = io.BytesIO(), io.BytesIO()
    aotpy.AOTFITSWriter(_to_system(aotpy, telemetry)).get_hdulist().writeto(plain)
    # astropy's checksum of a table is right only once the table has been in a file
    with fits.open(io.BytesIO(plain.getvalue()), memmap=False) as units:
        for unit in units:
            unit.add_checksum(when="of this unit")
        units.writeto(checked)
    return checked.getvalue()


def _to_system(aotpy: Any, seen: Telemetry) -> Any:
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
    unit = "m" if seen.command_unit == "nm" else seen.command_unit
    units, images = {"commands": unit, "measurements": seen.measurement_unit}, {}
    for name, data in _arrays(seen).items():
        time = clock if name in units else None
        heading, unit = name.upper().replace("_", " "), units.get(name, "")
        images[name] = aotpy.Image(heading, data, unit=unit or None, time=time)
    sensor = aotpy.Pyramid(
        "Pyramid",
        source=star,
        dimensions=1,
        n_valid_subapertures=seen.measurements.shape[1],
        n_sides=4,
        measurements=images.pop("measurements"),
        optical_gain=images.pop("optical_gain", None),
    )
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
        config=seen.convention,
        main_telescope=telescope,
        sources=[star],
        wavefront_sensors=[sensor],
        wavefront_correctors=[mirror],
        loops=[loop],
        metadata=_header_cards(aotpy, seen),
    )


def _arrays(seen: Telemetry) -> dict[str, FloatArray]:
    """Return the series and matrices that there are, by aotpy's names."""
    metres = 1e-9 if seen.command_unit == "nm" else 1.0
    response, gain = seen.interaction_matrix, seen.sensor_gain
    arrays: dict[str, Any] = {
        "commands": None if seen.commands is None else metres * seen.commands,
        "measurements": seen.measurements[:, None],  # of one dimension of the subapertures
        "optical_gain": None if gain is None else np.array([gain]),
        "modes_to_measurements": None if response is None else response[:, None],
        "commands_to_modes": seen.influence_matrix,
    }
    return {name: data for name, data in arrays.items() if data is not None}


def _header_cards(aotpy: Any, seen: Telemetry) -> list[Any]:
    """Cards of the primary header, for what the tables have no place for."""
    own: dict[str, Any] = {"metadata": dict(seen.metadata), "shown_unit": seen.shown_unit}
    if seen.mirror is not None and seen.mirror_taps is not None:
        # the standard does not say what its TFZ_NUM and TFZ_DEN of a corrector act on, nor with
        # which delay
        own["mirror"], own["mirror_taps"] = asdict(seen.mirror), seen.mirror_taps.tolist()
    text = json.dumps(own, allow_nan=False)
    for sign in _UNSAFE:  # they stand only in texts, where JSON may write them by their number
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    cards = [aotpy.Metadatum(_OWN_CARD, text)]
    if seen.imaging_wavelength_um is not None:
        # aotpy 3.2.1 writes its strehl_wavelength over the Strehl ratio
        cards.append(aotpy.Metadatum("STREHL-L", 1e-6 * seen.imaging_wavelength_um))
    return cards


def from_bytes(content: bytes, source: Path, wanted: str | int | None = None) -> Telemetry:
    """Read a control loop that has series, the first or that of a name or number, as telemetry."""
    aotpy = require_aotpy(source, TelemetryError, "read")
    with ignore_warnings():  # foreign files deviate in many small ways
        try:
            with open_fits(content):  # refuses what is cut or belies a checksum
                pass
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
    names = [loop.uid for loop in loops]
    keys = [*names, *map(str, range(len(names)))]  # a name that is a number comes first
    if (key := str(0 if wanted is None else wanted)) not in keys:
        raise TelemetryError(
            f"{source} has the control loops {', '.join(names)}, from 0; got {wanted!r}.",
            path=source,
        )
    place = keys.index(key) % len(names)
    fields = _loop_fields(loops[place]) | _system_fields(system)
    if len(loops) > 1:
        taken = {"aot_loop": names[place], "aot_loops": ", ".join(names)}
        fields["metadata"] = {**fields["metadata"], **taken}
    return Telemetry(**fields)


def _system_fields(system: Any) -> dict[str, Any]:
    """Fields that belong to the whole system."""
    told = {"timing": _FOREIGN, "name": system.name, "strehl": system.strehl_ratio}
    facts: dict[str, Any] = {"metadata": {name: text for name, text in told.items() if text}}
    for datum in system.metadata:
        if datum.key == _OWN_CARD:
            own = json.loads(datum.value)
            facts |= {"metadata": own["metadata"], "shown_unit": own.get("shown_unit", "nm")}
            if "mirror" in own:
                facts["mirror"] = PositionLoop(**own["mirror"])
    telescope = system.main_telescope
    if telescope is not None:
        facts["diameter_m"] = telescope.enclosing_diameter or telescope.inscribed_diameter
        if facts["diameter_m"] and telescope.obstruction_diameter is not None:
            facts["obstruction"] = telescope.obstruction_diameter / facts["diameter_m"]
    wavelengths = [system.strehl_wavelength, *(c.wavelength for c in system.scoring_cameras[:1])]
    for wavelength in (w for w in reversed(wavelengths) if w is not None):
        facts["imaging_wavelength_um"] = wavelength * 1e6
    return facts


def _loop_fields(loop: Any) -> dict[str, Any]:
    """Fields of a loop; measurements are its modes, or what two commands correct, or slopes."""
    sensor, modal, clock = loop.input_sensor, loop.modal_coefficients, loop.time
    command_unit, influence = loop.commands.unit or "m", _data(loop.commands_to_modes)
    gain, response = _data(sensor.optical_gain), _data(loop.modes_to_measurements)
    control, image = _data(loop.control_matrix), sensor.measurements if modal is None else modal
    y, unit = _data(image).reshape(len(image.data), -1), image.unit or ""
    if response is not None and response.ndim == 3:  # (s_v, d, n) to (d s_v, n)
        response = response.transpose(1, 0, 2).reshape(-1, response.shape[2])
    if modal is not None and response is not None:
        back = _data(loop.measurements_to_modes)
        response = None if back is None else back.reshape(len(back), -1) @ response
    elif control is not None and len(control) <= 2 and modal is response is influence is None:
        y, unit = y @ control.reshape(len(control), -1).T, command_unit
    times = getattr(clock or loop.commands.time, "timestamps", None) or [0.0]
    fields: dict[str, Any] = {
        **_in_nm("command", _data(loop.commands), command_unit),
        **_in_nm("measurement", y, unit),
        "delay_frames": loop.delay,
        "influence_matrix": influence,
        "interaction_matrix": response,
        "sensor_gain": None if gain is None else float(np.mean(gain)),
        "times_s": times if any(times) else None,  # stamps that are all zero are none
    }
    fields["frame_rate_hz"] = _frame_rate(loop, fields["times_s"])
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


def _in_nm(name: str, series: FloatArray, unit: str) -> dict[str, Any]:
    """Return a series with its unit: lengths in nm, other values in their own."""
    factor, unit = (1.0, unit) if unit not in _NM else (_NM[unit], "nm")
    return {f"{name}s": factor * series, f"{name}_unit": unit}
