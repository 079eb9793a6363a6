"""Write configuration files with comments: settings as they are, or an identified system."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import YAMLError

from lbt_synth.config.schema import FileSection, describe_error
from lbt_synth.errors import ProblemError
from lbt_synth.identification import IdentifiedModel
from lbt_synth.identification.accelerometers.transfers import AccelerometerTransfers
from lbt_synth.models import ARModel
from lbt_synth.validation import number

_AXES = ("tip", "tilt")
_NAME = "accelerometer"  # of the instrument that all channels make
_DIRECTIONS = {(1.0, 0.0): "tip", (0.0, 1.0): "tilt"}
RAISED = "raised to the least that a configuration has"
_LEAST_NM = 1e-3  # of noise and lines in a configuration
_KIND_COMMENTS = {"line": "", "broad": "broad; ", "turbulence": "part of the turbulence; "}
_COLUMN = 40  # where comments begin
_LONGEST_LINE = 10**9  # a list stays on its line


def config_text(settings: FileSection, comments: Mapping[str, str] | None = None) -> str:
    """Return the YAML of a configuration: what was set, with all digits, read again as it is.

    Comments are by the paths of keys, such as ``model.vibrations[0].rms_nm``, and stand at the ends
    of their lines; that of ``""`` heads the file, and may have several lines.
    """
    content, comments = settings.model_dump(exclude_unset=True), comments or {}
    document = _commented(content, "", comments)
    for key in list(document)[1:]:  # sections stand apart
        document.yaml_set_comment_before_after_key(key, before="\n")
    if head := comments.get("", ""):
        document.yaml_set_start_comment(head)
    yaml, stream = YAML(), io.StringIO()
    yaml.indent(mapping=2, sequence=4, offset=2)
    yaml.width = _LONGEST_LINE
    yaml.dump(document, stream)
    text = stream.getvalue()
    try:
        again = FileSection.model_validate(YAML(typ="safe", pure=True).load(text))
    except (YAMLError, ValueError) as error:
        raise ProblemError(
            f"the configuration cannot be written so that it is read again: {error}"
        ) from error
    if again.model_dump(exclude_unset=True) != content:
        raise ProblemError("the configuration would not be read again as it is; it was changed.")
    return text


def turbulence_content(model: ARModel) -> dict[str, Any]:
    """Return an auto-regressive model as the section of a configuration."""
    coefficients, driving_rms_nm = model.coefficients.tolist(), model.driving_rms_nm
    return {"kind": "ar", "coefficients": coefficients, "driving_rms_nm": driving_rms_nm}


def _commented(value: Any, path: str, comments: Mapping[str, str]) -> Any:
    """Return a value with its comments for ruamel."""
    if isinstance(value, dict):
        section = CommentedMap()
        for key, inner in value.items():
            place = f"{path}.{key}" if path else key
            section[key] = _commented(inner, place, comments)
            if comment := comments.get(place):
                section.yaml_add_eol_comment(comment, key, column=_COLUMN)
        return section
    if not isinstance(value, list):
        return value
    entries = CommentedSeq()
    for i, inner in enumerate(value):
        place = f"{path}[{i}]"
        entries.append(_commented(inner, place, comments))
        if comment := comments.get(place):
            depth = path.count(".") + 1
            entries.yaml_set_comment_before_after_key(i, before=comment, indent=2 * depth)
    if not (value and isinstance(value[0], dict)):
        entries.fa.set_flow_style()
    return entries


def identified_config(
    model: IdentifiedModel,
    *,
    diameter_m: float | None = None,
    obstruction: float | None = None,
    wavelength_um: float = 2.2,
    other_modes_strehl: float = 1.0,
    title: str = "An identified system.",
    accelerometers: AccelerometerTransfers | None = None,
    units: str = "nm",
) -> tuple[FileSection, dict[str, str]]:
    """Return the configuration of an identified system, and standard errors by paths of keys.

    The truth is the model. Channels of accelerometers that show no line are left out.
    """
    axes = tuple(model.axes)
    if len(axes) not in (1, 2):
        raise ProblemError(f"a configuration has one or two axes; got a model of {len(axes)}.")
    comments = {
        "": title,
        "sensor.noise_nm": _error_comment("nm", [axis.noise_error_nm for axis in axes]),
    }
    content = _known_content(
        len(axes), model.frame_rate_hz, model.delay_frames, diameter_m, obstruction
    )
    content |= {} if units == "nm" else {"units": units}
    noises = [_raised(axis.noise_nm, "sensor.noise_nm", comments) for axis in axes]
    content["sensor"] = {"noise_nm": noises}
    if model.mirror is not None:
        content["mirror"] = {"local_loop": asdict(model.mirror)}
    vibrations = _vibration_sections(model, comments)
    if accelerometers is not None and accelerometers.used:
        content["sensors"] = {_NAME: _accelerometer_section(accelerometers, model, comments)}
        _add_motions(vibrations, accelerometers, comments)
    content["model"] = {"turbulence": []}
    for index, (name, axis) in enumerate(zip(_AXES, axes, strict=False)):
        turbulence = axis.turbulence
        content["model"]["turbulence"].append(turbulence_content(turbulence))
        comments[f"model.turbulence[{index}]"] = f"{name}, rms {turbulence.rms_nm:.4g} nm"
    content["truth"] = {"turbulence": "model"}
    if vibrations:
        content["model"]["vibrations"] = vibrations
        content["truth"]["vibrations"] = "model"
    gains = [float(axis.sensor_gain) for axis in axes]
    if any(gain != 1 for gain in gains):
        content["model"]["sensor_gain"] = gains
        content["truth"]["sensor_gain"] = float(np.mean(gains))
        comments["model.sensor_gain"] = _error_comment(
            "", [axis.sensor_gain_error or 0.0 for axis in axes]
        )
    content["imaging"] = {"wavelength_um": wavelength_um}
    if other_modes_strehl != 1:
        content["imaging"]["other_modes_strehl"] = other_modes_strehl
    return _validated(content), {key: text for key, text in comments.items() if text}


def require_writable_facts(
    axes: int,
    frame_rate_hz: float | None,
    delay_frames: float | None,
    *,
    diameter_m: float | None = None,
    obstruction: float | None = None,
    wavelength_um: float = 2.2,
) -> None:
    """Refuse facts that no configuration can hold, before a model is identified for it."""
    rate_hz, delay = frame_rate_hz or 1.0, delay_frames or 1.0  # what is not known is found
    content = _known_content(axes, rate_hz, delay, diameter_m, obstruction)
    turbulence = {"kind": "ar", "coefficients": [0.9], "driving_rms_nm": 1.0}
    content |= {"sensor": {"noise_nm": 1.0}, "model": {"turbulence": turbulence}}
    _validated(content | {"imaging": {"wavelength_um": wavelength_um}})


def _known_content(
    axes: int,
    frame_rate_hz: float,
    delay_frames: float,
    diameter_m: float | None,
    obstruction: float | None,
) -> dict[str, Any]:
    """Return what a configuration says that is not identified."""
    if obstruction is not None and diameter_m is None:
        raise ProblemError(
            "obstruction is a fraction of diameter_m, which is missing. Give both, or neither."
        )
    content: dict[str, Any] = {"version": 1}
    if diameter_m is not None:
        content["telescope"] = {"diameter_m": diameter_m}
        if obstruction is not None:
            content["telescope"]["obstruction"] = obstruction
    content["loop"] = {"axes": axes} if axes == 1 else {}
    content["loop"] |= {
        "frame_rate_hz": number(frame_rate_hz, "frame_rate_hz", above=0),
        "delay_frames": number(delay_frames, "delay_frames", at_least=1),
    }
    return content


def _validated(content: dict[str, Any]) -> FileSection:
    try:
        return FileSection.model_validate(content)
    except ValidationError as error:
        raise ProblemError(
            f"the model cannot be written as a configuration: {describe_error(error)[0]}"
        ) from error


def _raised(value_nm: float, path: str, comments: dict[str, str]) -> float:
    """Return a size that a configuration can hold, with a comment where it is not as it was."""
    if 0 <= value_nm < _LEAST_NM:
        comments[path] = f"{RAISED}, from {value_nm:.2g} nm"
    return float(max(value_nm, _LEAST_NM)) if value_nm >= 0 else float(value_nm)


def _vibration_sections(model: IdentifiedModel, comments: dict[str, str]) -> list[dict[str, Any]]:
    """Return all vibrations, tip first, and add their errors to ``comments``."""
    sections: list[dict[str, Any]] = []
    for line in model.parts:
        path = f"model.vibrations[{len(sections)}]"
        frequency_error = _error_comment("Hz", [line.frequency_error_hz])
        comments[f"{path}.frequency_hz"] = _KIND_COMMENTS[line.kind] + frequency_error
        comments[f"{path}.damping"] = _error_comment("", [line.damping_error])
        comments[f"{path}.rms_nm"] = _error_comment("nm", [line.rms_error_nm])
        entry: dict[str, Any] = {}
        if len(model.axes) > 1 and line.direction in _DIRECTIONS:
            entry["axis"] = _DIRECTIONS[line.direction]
        elif len(model.axes) > 1:
            entry["direction_deg"] = line.direction_deg
            error = _error_comment("degrees", [line.direction_error_deg or 0.0])
            comments[f"{path}.direction_deg"] = error
        for key in ("frequency_hz", "damping"):
            entry[key] = float(getattr(line, key))
        entry["rms_nm"] = _raised(line.rms_nm, f"{path}.rms_nm", comments)
        if line.sections > 1:
            entry["sections"] = line.sections
        sections.append(entry)
    return sections


def _accelerometer_section(
    transfers: AccelerometerTransfers, model: IdentifiedModel, comments: dict[str, str]
) -> dict[str, Any]:
    """Return the section of the channels that are used, and comment on their delay."""
    age, path = transfers.loop_age(model.delay_frames), f"sensors.{_NAME}.delay_frames"
    comments[path] = f"readings come {age - 1} frames after the wavefront's"
    if age != transfers.age_frames:
        apart = transfers.age_frames - 1
        comments[path] = f"not known: the clocks were {apart} frames apart; give the real delay"
    return {
        "kind": "accelerometer",
        "rate_hz": float(model.frame_rate_hz),
        "delay_frames": float(age + model.delay_frames - 1),
        "channels": [row.channel for row in transfers.used],
        "noise_m_s2": [float(row.noise_m_s2) for row in transfers.used],
    }


def _add_motions(
    vibrations: list[dict[str, Any]], transfers: AccelerometerTransfers, comments: dict[str, str]
) -> None:
    """Add to each vibration how the channels that show it move with it, with errors."""
    for row in transfers.transfers:
        if not row.useful:
            continue
        moving = vibrations[row.line].setdefault("accelerometers", {})
        values = {"motion_nm_per_nm": row.motion_nm_per_nm, "phase_deg": row.phase_deg}
        moving[row.channel] = values
        path = f"model.vibrations[{row.line}].accelerometers.{row.channel}"
        comments[f"{path}.motion_nm_per_nm"] = _error_comment("", [row.motion_error_nm_per_nm])
        comments[f"{path}.phase_deg"] = _error_comment("degrees", [row.phase_error_deg])


def _error_comment(unit: str, errors: Sequence[float]) -> str:
    """Return standard errors as a comment, empty if none is known."""
    is_known = [math.isfinite(error) and error > 0 for error in errors]
    if not any(is_known):
        return ""
    texts = [f"{e:.2g}" if ok else "not known" for e, ok in zip(errors, is_known, strict=True)]
    return f"standard error {', '.join(texts)} {unit}".rstrip()
