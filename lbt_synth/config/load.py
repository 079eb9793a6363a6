"""Read a configuration file and build the objects it describes."""

from __future__ import annotations

import difflib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from lbt_synth.config.end_to_end import end_to_end_setup
from lbt_synth.config.schema import (
    BandSection,
    FileSection,
    LocalLoopSection,
    TrueVibrationSection,
    VibrationSection,
)
from lbt_synth.endtoend import EndToEndSetup
from lbt_synth.errors import ConfigError, ProblemError
from lbt_synth.loop import Imaging
from lbt_synth.models import (
    ARModel,
    Atmosphere,
    LoopHardware,
    PositionLoop,
    SinusoidalVibration,
    Spectrum,
    TipTiltPlant,
    Truth,
    Vibration,
    ar1_turbulence,
    ar2_turbulence,
    illuminated_subapertures,
    nm_per_mas,
    pyramid_tilt_noise_nm,
    tip_tilt_plant,
)
from lbt_synth.models.prior import line_frequencies, spread_lines


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Config:
    """A configuration and what it describes.

    Attributes
    ----------
    settings : FileSection
        The file's values, checked; sections as attributes.
    plant : TipTiltPlant
        Plant of the design.
    truth : Truth
        What the loop really meets.
    imaging : Imaging
        The camera.
    atmosphere : Atmosphere
        Turbulence and telescope.
    noise_nm : float
        Measurement noise per frame [nm].
    source : pathlib.Path
        The file.
    """

    settings: FileSection
    plant: TipTiltPlant
    truth: Truth
    imaging: Imaging
    atmosphere: Atmosphere
    noise_nm: float
    source: Path

    @property
    def hardware(self) -> LoopHardware:
        """The loop."""
        return self.plant.hardware

    @property
    def end_to_end(self) -> EndToEndSetup:
        """The end-to-end simulation; raises ConfigError if the file cannot describe one."""
        try:
            return end_to_end_setup(self.settings, self.hardware, self.truth)
        except ConfigError as error:
            raise ConfigError(f"{self.source}: {error}", path=error.path) from error


def load_config(path: str | os.PathLike[str]) -> Config:
    """Read a YAML configuration file, check it and build its objects.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    Config
        The configuration.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not YAML, or a key is unknown, missing or
        has an impossible value; ``path`` on the error is that of the key.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> config.hardware.frame_rate_hz, config.plant.A.shape
    (800.0, (8, 8))
    """
    source = Path(path)
    raw = _read_yaml(source)
    try:
        settings = FileSection.model_validate(raw)
    except ValidationError as error:
        message, key = _describe(error)
        raise ConfigError(f"{source}: {message}", path=key) from error
    return _build(settings, source)


def _read_yaml(source: Path) -> dict[str, Any]:
    try:
        text = source.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"cannot read {source}: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{source} is not a text file: {error.reason}.") from error
    try:
        raw = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, ValueError, KeyError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).split("\n")[0]
        raise ConfigError(f"{source} is not valid YAML{where}: {problem}.") from error
    if not isinstance(raw, dict):
        raise ConfigError(f"{source} must hold a mapping of sections; got {type(raw).__name__}.")
    return raw


def _describe(error: ValidationError) -> tuple[str, str]:
    """One sentence on the first mistake, with the path of its key."""
    details = error.errors()
    # an unknown key tells more than the missing one that it was meant to be
    first = next((d for d in details if d["type"] == "extra_forbidden"), details[0])
    location = tuple(p for p in first["loc"] if p not in ("ar1", "ar2", "ar"))
    key = _key_path(location)
    more = f" ({len(details) - 1} more after this one.)" if len(details) > 1 else ""
    if first["type"] == "extra_forbidden":
        known = _fields_at(FileSection, location[:-1])
        close = difflib.get_close_matches(str(location[-1]), known, n=1, cutoff=0.6)
        hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}."
        return f"unknown key {key}; {hint}{more}", key
    if first["type"] == "missing":
        return f"the key {key} is missing.{more}", key
    if first["type"] == "value_error":
        return f"{key}: {first['ctx']['error']}.{more}", key
    if first["type"] == "too_short" and key.endswith("vibrations"):
        return f"{key} is empty; leave the key out for a model without vibrations.{more}", key
    if first["type"] == "union_tag_invalid":
        expected, got = first["ctx"]["expected_tags"], first["ctx"]["tag"]
        return f"{key}.kind must be one of {expected}; got {got!r}.{more}", key
    text = first["msg"][0].lower() + first["msg"][1:]
    return f"{key}: {text}; got {first['input']!r}.{more}", key


def _key_path(location: tuple[int | str, ...]) -> str:
    out = ""
    for part in location:
        out += f"[{part}]" if isinstance(part, int) else f".{part}" if out else str(part)
    return out


def _fields_at(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Names of the keys known at a place of the schema."""
    here: list[type[BaseModel]] = [model]
    for part in location:
        if isinstance(part, int):
            continue
        found: list[type[BaseModel]] = []
        for section in here:
            field = section.model_fields.get(str(part))
            if field is not None:
                found += _models_in(field.annotation)
        here = found
    return sorted({name for section in here for name in section.model_fields})


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for arg in getattr(annotation, "__args__", ()) for m in _models_in(arg)]


def _build(settings: FileSection, source: Path) -> Config:
    try:
        atmosphere = Atmosphere(
            seeing_arcsec=settings.atmosphere.seeing_arcsec,
            seeing_wavelength_um=settings.atmosphere.seeing_wavelength_um,
            outer_scale_m=settings.atmosphere.outer_scale_m,
            wind_speed_m_s=settings.atmosphere.wind_speed_m_s,
            diameter_m=settings.telescope.diameter_m,
        )
        noise_nm = _noise_nm(settings)
        plant = _plant(settings, atmosphere, noise_nm)
        truth = _truth(settings, atmosphere, noise_nm, plant)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}", path=error.path) from error
    except ProblemError as error:
        raise ConfigError(f"{source}: {error}") from error
    except ArithmeticError as error:
        raise ConfigError(
            f"{source}: some value is far from any telescope: {error}. Check the units."
        ) from error
    imaging = Imaging(
        diameter_m=settings.telescope.diameter_m,
        obstruction=settings.telescope.obstruction,
        wavelength_um=settings.imaging.wavelength_um,
        other_modes=settings.imaging.other_modes_strehl,
    )
    return Config(
        settings=settings,
        plant=plant,
        truth=truth,
        imaging=imaging,
        atmosphere=atmosphere,
        noise_nm=noise_nm,
        source=source,
    )


def _noise_nm(settings: FileSection) -> float:
    sensor, telescope = settings.sensor, settings.telescope
    if sensor.noise_nm is not None:
        return sensor.noise_nm
    if sensor.noise_mas is not None:
        return sensor.noise_mas * nm_per_mas(telescope.diameter_m)
    pyramid = sensor.pyramid
    assert pyramid is not None  # the schema wants exactly one of the three
    return pyramid_tilt_noise_nm(
        photons=pyramid.photons,
        read_noise_electrons=pyramid.read_noise_electrons,
        modulation_lambda_over_d=pyramid.modulation_lambda_over_d,
        subapertures=illuminated_subapertures(pyramid.subapertures_across, telescope.obstruction),
        wavelength_um=pyramid.wavelength_um,
        diameter_m=telescope.diameter_m,
    )


def _plant(settings: FileSection, atmosphere: Atmosphere, noise_nm: float) -> TipTiltPlant:
    loop, model = settings.loop, settings.model
    turbulence: ARModel
    if model.turbulence.kind == "ar1":
        turbulence = ar1_turbulence(atmosphere, frame_rate_hz=loop.frame_rate_hz)
    elif model.turbulence.kind == "ar2":
        turbulence = ar2_turbulence(atmosphere, frame_rate_hz=loop.frame_rate_hz, noise_nm=noise_nm)
    else:
        try:
            turbulence = ARModel(
                coefficients=np.array(model.turbulence.coefficients),
                driving_rms_nm=model.turbulence.driving_rms_nm,
                frame_rate_hz=loop.frame_rate_hz,
            )
        except ProblemError as error:
            key = "model.turbulence.coefficients"
            raise ConfigError(f"{key}: {error}", path=key) from error
    lines: list[Vibration] | None = None
    if model.vibrations is not None:
        lines = []
        for i, section in enumerate(model.vibrations):
            key = f"model.vibrations[{i}].frequency_hz"
            _below_nyquist(section.frequency_hz, loop.frame_rate_hz, key)
            for direction in _directions(section):
                line = Vibration(
                    frequency_hz=section.frequency_hz,
                    damping=section.damping,
                    rms_nm=rms_nm(section, settings),
                    direction=direction,
                )
                lines += _spread(line, section, loop.frame_rate_hz, i)
    return tip_tilt_plant(
        frame_rate_hz=loop.frame_rate_hz,
        delay_frames=loop.delay_frames,
        turbulence=turbulence,
        vibrations=lines,
        noise_nm=noise_nm,
        sensor_matrix=settings.sensor.matrix,
        influence_matrix=settings.mirror.influence_matrix,
        sensor_gain=model.sensor_gain,
        mirror=_mirror(settings.mirror.local_loop),
    )


def _mirror(section: LocalLoopSection | None) -> PositionLoop | None:
    """Return the mirror's local loop, None for a mirror that settles at once."""
    if section is None:
        return None
    given: dict[str, Any] = {k: v for k, v in section.model_dump().items() if v is not None}
    make = PositionLoop if section.bandwidth_hz is None else PositionLoop.of_bandwidth
    try:
        return make(**given)
    except ProblemError as error:
        key = "mirror.local_loop"
        raise ConfigError(f"{key}: {error}", path=key) from error


def _spread(
    line: Vibration, section: VibrationSection, frame_rate_hz: float, index: int
) -> list[Vibration]:
    """Return the lines that stand for a vibration of the model."""
    if section.spread_hz is None:
        return [line]
    key = f"model.vibrations[{index}].spread_hz"
    try:
        frequencies = line_frequencies(
            line.frequency_hz, section.spread_hz, section.lines or 5, name="the half width"
        )
        made = spread_lines(line, frequencies)
        made[-1].ar_model(frame_rate_hz)
    except ProblemError as error:
        raise ConfigError(f"{key}: {error}", path=key) from error
    return made


def _truth(
    settings: FileSection, atmosphere: Atmosphere, noise_nm: float, plant: TipTiltPlant
) -> Truth:
    lines: list[Vibration | SinusoidalVibration] = []
    for i, section in enumerate(settings.truth.vibrations):
        key = f"truth.vibrations[{i}].frequency_hz"
        _below_nyquist(section.frequency_hz, settings.loop.frame_rate_hz, key)
        for direction in _directions(section):
            size: dict[str, Any] = {
                "frequency_hz": section.frequency_hz,
                "rms_nm": rms_nm(section, settings),
                "direction": direction,
            }
            if section.damping is None:
                lines.append(SinusoidalVibration(**size))
            else:
                lines.append(Vibration(**size, damping=section.damping))
    spectra: dict[str, Spectrum | None] = {
        "frozen_flow": atmosphere,
        "model": plant.turbulence[0],
        "none": None,
    }
    # the plant's sensor matrix holds the gain that the design assumes
    return Truth(
        turbulence=spectra[settings.truth.turbulence],
        vibrations=tuple(lines),
        noise_nm=noise_nm,
        sensor_gain=settings.truth.sensor_gain / settings.model.sensor_gain,
    )


def rms_nm(
    section: VibrationSection | TrueVibrationSection | BandSection, settings: FileSection
) -> float:
    """Return the deviation of a vibration [nm rms wavefront], given in nm or in mas."""
    if section.rms_nm is not None:
        return section.rms_nm
    assert section.rms_mas is not None  # the schema wants exactly one of the two
    return section.rms_mas * nm_per_mas(settings.telescope.diameter_m)


def _directions(
    section: VibrationSection | TrueVibrationSection,
) -> list[tuple[float, float]]:
    if section.direction_deg is not None:
        angle = np.radians(section.direction_deg)
        return [(float(np.cos(angle)), float(np.sin(angle)))]
    axes = {"tip": [(1.0, 0.0)], "tilt": [(0.0, 1.0)], "both": [(1.0, 0.0), (0.0, 1.0)]}
    return axes[section.axis or "both"]


def _below_nyquist(frequency_hz: float, frame_rate_hz: float, key: str) -> None:
    if not frequency_hz < frame_rate_hz / 2:
        raise ConfigError(
            f"{key}: must lie below the Nyquist frequency {frame_rate_hz / 2:.6g} Hz; "
            f"got {frequency_hz:.6g}.",
            path=key,
        )
