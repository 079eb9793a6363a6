"""Build what a configuration describes: plant, truth, noise, sensors and end-to-end simulation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast

import numpy as np

from lbt_synth import models
from lbt_synth.config.schema import (
    FileSection,
    LocalLoopSection,
    OtherSensorSection,
    TrueVibrationSection,
    TurbulenceSection,
    VibrationSection,
)
from lbt_synth.errors import ConfigError, ProblemError, name_key
from lbt_synth.models.sensor import illuminated_subapertures
from lbt_synth.models.sensor_suite import Motions, Sensor, checked_motions
from lbt_synth.models.vibration import TrueVibration, spread_lines
from lbt_synth.validation import FloatArray, frozen_copy

if TYPE_CHECKING:
    from lbt_synth.interop.specula.optics import EndToEndSetup

T = TypeVar("T")
_AXES = {"tip": [(1.0, 0.0)], "tilt": [(0.0, 1.0)], "both": [(1.0, 0.0), (0.0, 1.0)]}
_USUAL_LINES = 5  # of a spread vibration, unless the file says


def require_section(settings: FileSection, name: str, reason: str) -> Any:
    """Return a section that may be left out; raise ConfigError with the reason where it is."""
    section = getattr(settings, name)
    if section is None:
        raise ConfigError(f"the key {name} is missing: {reason}.", path=name)
    return section


def count_axes(settings: FileSection) -> int:
    """Return the number of modes n: ``loop.axes``, else that of the matrices, else 2."""
    sensor, influence = settings.sensor.matrix, settings.mirror.influence_matrix
    sizes = [
        *([("sensor.matrix", "columns", len(sensor[0]))] if sensor else []),
        *([("mirror.influence_matrix", "rows", len(influence))] if influence else []),
    ]
    axes = settings.loop.axes
    if axes is None:
        return sizes[0][2] if sizes else 2
    for key, word, size in sizes:
        if size != axes:
            raise ConfigError(
                f"{key} must have {axes} {word} to match loop.axes; got {size}.", path=key
            )
    return axes


def count_measurements(settings: FileSection) -> int:
    """Return the number of measurements q: rows of ``sensor.matrix``, else one per axis."""
    sensor = settings.sensor.matrix
    return len(sensor) if sensor else count_axes(settings)


def _require_length(values: list[T], count: int, key: str, what: str) -> list[T]:
    """Return a list that must have one value for each of ``count`` axes or measurements."""
    if len(values) != count:
        raise ConfigError(
            f"{key}: must be one for all, or a list of one per {what} ({count}); got "
            f"{len(values)}.",
            path=key,
        )
    return values


def build_atmosphere(settings: FileSection) -> models.Atmosphere | None:
    """Build the atmosphere of a configuration, None if it has none."""
    air = settings.atmosphere
    if air is None:
        return None
    reason = "the turbulence of atmosphere is that over its diameter"
    return models.Atmosphere(
        diameter_m=require_section(settings, "telescope", reason).diameter_m, **air.model_dump()
    )


def _convert_mas_to_nm(settings: FileSection, mas: float, key: str) -> float:
    """Convert an angle of the file [mas] to a wavefront [nm rms]."""
    reason = f"{key} is in mas, and a wavefront in nm needs telescope.diameter_m"
    telescope = require_section(settings, "telescope", f"{reason}. Give it, or the value in nm")
    return mas * models.nm_per_mas(telescope.diameter_m)


def measurement_noise_nm(settings: FileSection) -> float | FloatArray:
    """Return the noise per frame [nm], of all measurements or of each; (b,) of samples."""
    sensor = settings.sensor
    if isinstance(sensor.noise_nm, list):
        count = count_measurements(settings)
        return frozen_copy(
            _require_length(sensor.noise_nm, count, "sensor.noise_nm", "measurement")
        )
    if sensor.noise_mas is not None:
        return _convert_mas_to_nm(settings, sensor.noise_mas, "sensor.noise_mas")
    if (pyramid := sensor.pyramid) is None:
        return sensor.noise_nm  # type: ignore[return-value]  # the schema wants one of the three
    reason = "the noise of sensor.pyramid depends on it. Give it, or sensor.noise_nm"
    telescope = require_section(settings, "telescope", reason)
    numbers = dict(pyramid)
    across = numbers.pop("subapertures_across")
    return models.pyramid_tilt_noise_nm(
        subapertures=illuminated_subapertures(across, telescope.obstruction),
        diameter_m=telescope.diameter_m,
        **numbers,
    )


def reference_gain(settings: FileSection) -> float:
    """Return the assumed gain with which a single number is compared: the mean of the gains."""
    return float(np.mean(settings.model.sensor_gain))


def true_vibrations_owner(settings: FileSection) -> Literal["model", "truth"]:
    """Return which section has the vibrations that the real loop meets."""
    return "truth" if isinstance(settings.truth.vibrations, list) else "model"


def vibration_numbers(
    settings: FileSection, owner: Literal["model", "truth"]
) -> Iterator[tuple[Any, str, dict[str, Any]]]:
    """Yield each vibration of the model or of the truth: its section, its key, its numbers."""
    rate, axes = settings.loop.frame_rate_hz, count_axes(settings)
    for i, section in enumerate(getattr(settings, owner).vibrations or ()):
        key = f"{owner}.vibrations[{i}]"
        _require_below_nyquist(section.frequency_hz, rate, f"{key}.frequency_hz")
        for direction in _directions(section, axes, key):
            place = {"frequency_hz": section.frequency_hz, "direction": direction}
            rms_nm = vibration_rms_nm(section, settings, key)
            place |= {"damping": section.damping, "rms_nm": rms_nm}
            yield section, key, place | ({"sections": section.sections} if section.sections else {})


def _directions(
    section: VibrationSection | TrueVibrationSection, axes: int, key: str
) -> list[tuple[float, ...]]:
    """Return the directions of the vibrations that one entry of a list describes."""
    if axes == 1:
        if section.axis in ("tilt", "both") or section.direction_deg is not None:
            raise ConfigError(
                f"{key}: this loop has one axis: leave axis and direction_deg out.", path=key
            )
        return [(1.0,)]
    if section.direction_deg is not None:
        angle = np.radians(section.direction_deg)
        return [(float(np.cos(angle)), float(np.sin(angle)))]
    if section.axis is None:
        needed = "expected exactly one of axis, direction_deg; got none"
        raise ConfigError(f"{key}: {needed}.", path=key)
    return [tuple(direction) for direction in _AXES[section.axis]]


def vibration_rms_nm(section: Any, settings: FileSection, key: str) -> float:
    """Return the size of a vibration [nm rms wavefront], which the file gives in nm or mas."""
    if section.rms_nm is not None:
        return section.rms_nm  # type: ignore[no-any-return]  # of a section with a size
    return _convert_mas_to_nm(settings, section.rms_mas, f"{key}.rms_mas")


def _require_below_nyquist(frequency_hz: Any, frame_rate_hz: float, key: str) -> None:
    highest_hz = np.max(frequency_hz)
    if not highest_hz < frame_rate_hz / 2:
        raise ConfigError(
            f"{key}: must lie below the Nyquist frequency {frame_rate_hz / 2:.6g} Hz; "
            f"got {highest_hz:.6g}.",
            path=key,
        )


def model_lines(settings: FileSection) -> list[tuple[Any, str, list[models.Vibration]]]:
    """Return each vibration of the model, with its lines: several if it is spread."""
    rate, lines = settings.loop.frame_rate_hz, []
    for section, key, numbers in vibration_numbers(settings, "model"):
        line = models.Vibration(**numbers)
        spread = [line]
        if section.spread_hz is not None:
            with name_key(f"{key}.spread_hz"):
                count = section.lines or _USUAL_LINES
                spread = spread_lines(line, section.spread_hz, count, name="the half width")
                spread[-1].ar_model(rate)  # the highest must lie below the Nyquist frequency
        lines.append((section, key, spread))
    return lines


def _build_true_vibrations(
    settings: FileSection, plant: models.TipTiltPlant
) -> tuple[TrueVibration, ...]:
    if true_vibrations_owner(settings) == "model":
        return plant.vibrations
    rate, lines = settings.loop.frame_rate_hz, list[TrueVibration]()
    for section, key, numbers in vibration_numbers(settings, "truth"):
        if section.kind == "resonance":
            lines.append(models.Vibration(**numbers))
            continue
        del numbers["damping"]
        if section.kind == "drift":
            _require_below_nyquist(section.end_hz, rate, f"{key}.end_hz")
        drift = {"end_hz": section.end_hz, "duration_s": section.duration_s}
        lines.append(models.SinusoidalVibration(**numbers, **drift))
    return tuple(lines)


def _frequency_errors(
    settings: FileSection, vibrations: tuple[TrueVibration, ...]
) -> tuple[float, ...] | None:
    """Return the error that is stated of each vibration [Hz], 0 beside others; None if none is."""
    sections = getattr(settings, true_vibrations_owner(settings)).vibrations or []
    if all(section.frequency_error_hz is None for section in sections):
        return None
    places = np.array([section.frequency_hz for section in sections])
    nearest = [sections[int(np.argmin(np.abs(places - line.frequency_hz)))] for line in vibrations]
    return tuple(section.frequency_error_hz or 0.0 for section in nearest)


@contextmanager
def _name_matrices() -> Iterator[None]:
    """Call the matrices of a loop by their keys in the message of a ProblemError."""
    keys = {"sensor_matrix": "sensor.matrix", "influence_matrix": "mirror.influence_matrix"}
    try:
        yield
    except ProblemError as error:
        message, named = str(error), [name for name in keys if name in str(error)]
        if isinstance(error, ConfigError) or not named:
            raise
        for name in named:
            message = message.replace(name, keys[name])
        raise ConfigError(message, path=keys[named[0]]) from error


@_name_matrices()
def build_plant(
    settings: FileSection, atmosphere: models.Atmosphere | None, noise_nm: float | FloatArray
) -> models.TipTiltPlant:
    """Build the plant of the design, with all its sensors."""
    lines, gain = model_lines(settings), settings.model.sensor_gain
    if isinstance(gain, list):
        _require_length(gain, count_measurements(settings), "model.sensor_gain", "measurement")
    plant = models.tip_tilt_plant(
        frame_rate_hz=settings.loop.frame_rate_hz,
        delay_frames=settings.loop.delay_frames,
        turbulence=_build_turbulence(settings, atmosphere, noise_nm),
        vibrations=[line for *_, spread in lines for line in spread],
        noise_nm=noise_nm,
        sensor_matrix=settings.sensor.matrix,
        influence_matrix=settings.mirror.influence_matrix,
        sensor_gain=gain,
        modes=count_axes(settings),
        mirror=_build_mirror(settings.mirror.local_loop),
    )
    if not settings.sensors:
        return plant
    with name_key("sensors"):
        sensors = tuple(_build_sensor(*entry) for entry in settings.sensors.items())
        suite = models.SensorSuite(sensors=sensors)
        motions = [(s, key, len(spread)) for s, key, spread in lines]
        return plant.with_sensors(suite, _build_motions(motions, suite))


def turbulence_sections(settings: FileSection) -> list[TurbulenceSection]:
    """Return the section of the assumed turbulence of each axis."""
    turbulence, axes = settings.model.turbulence, count_axes(settings)
    if isinstance(turbulence, list):
        return _require_length(turbulence, axes, "model.turbulence", "axis")
    return [turbulence] * axes


def _build_turbulence(
    settings: FileSection, atmosphere: models.Atmosphere | None, noise_nm: float | FloatArray
) -> models.ARModel | list[models.ARModel]:
    """Return one model for all axes, or one per axis where sections or noise differ."""
    axes, key = count_axes(settings), "model.turbulence"
    sections, listed = turbulence_sections(settings), isinstance(settings.model.turbulence, list)
    noisy = np.ndim(noise_nm) == 1 and any(section.kind == "ar2" for section in sections)
    if noisy and count_measurements(settings) != axes:
        raise ConfigError(
            f"{key}: kind ar2 is fitted above the noise of its axis, but sensor.noise_nm has one "
            f"per measurement, {np.size(noise_nm)} for {axes} axes. Give one noise for all, or "
            "kind ar.",
            path=key,
        )
    noises = np.broadcast_to(noise_nm if noisy else np.ravel(noise_nm)[0], (axes,)).tolist()
    if not listed and not noisy:
        return _build_turbulence_model(sections[0], settings, atmosphere, noises[0], key)
    keys = [f"{key}[{i}]" if listed else key for i in range(axes)]
    return [
        _build_turbulence_model(section, settings, atmosphere, noise, place)
        for section, noise, place in zip(sections, noises, keys, strict=True)
    ]


def _build_turbulence_model(
    section: TurbulenceSection,
    settings: FileSection,
    atmosphere: models.Atmosphere | None,
    noise_nm: float,
    key: str,
) -> models.ARModel:
    rate = settings.loop.frame_rate_hz
    if section.kind == "ar":
        with name_key(f"{key}.coefficients"):
            numbers = section.model_dump(exclude={"kind"})
            return models.ARModel(**numbers, frame_rate_hz=rate)
    reason = f"{key} of kind {section.kind} is computed from it. Give it, or kind ar"
    require_section(settings, "atmosphere", reason)
    air = cast(models.Atmosphere, atmosphere)
    if section.kind == "ar1":
        return models.ar1_turbulence(air, frame_rate_hz=rate)
    return models.ar2_turbulence(air, frame_rate_hz=rate, noise_nm=noise_nm)


def _build_mirror(section: LocalLoopSection | None) -> models.PositionLoop | None:
    """Build the mirror's local loop, None for a mirror that settles at once."""
    if section is None:
        return None
    numbers: dict[str, Any] = section.model_dump(exclude_none=True)
    make = (
        models.PositionLoop if section.bandwidth_hz is None else models.PositionLoop.from_bandwidth
    )
    with name_key("mirror.local_loop"):
        return make(**numbers)


def _build_sensor(name: str, section: OtherSensorSection) -> Sensor:
    with name_key(f"sensors.{name}"):
        timing = {"rate_hz": section.rate_hz, "delay_frames": section.delay_frames}
        sizes = (section.noise_nm, section.noise_m_s2, section.covariance)
        (size,) = (np.array(size) for size in sizes if size is not None)
        noise = float(size) if size.ndim == 0 else size
        if section.kind == "wavefront":
            matrix = None if section.matrix is None else np.array(section.matrix)
            return models.WavefrontSensor(name=name, **timing, noise_nm=noise, sensor_matrix=matrix)
        return models.Accelerometer(
            name=name,
            **timing,
            channels=tuple(section.channels or ()),
            noise_m_s2=noise,
            highpass_hz=section.highpass_hz,
        )


def _build_motions(lines: list[tuple[Any, str, int]], suite: models.SensorSuite) -> Motions:
    """Return the motions of each line, from sections with their keys and numbers of lines."""
    motions: list[dict[str, models.Motion]] = []
    for section, key, count in lines:
        with name_key(f"{key}.accelerometers"):
            moving = {
                name: models.Motion(size=motion.motion_nm_per_nm, phase_deg=motion.phase_deg)
                for name, motion in (section.accelerometers or {}).items()
            }
            checked_motions((moving,), suite, 1)
        motions += [moving] * count
    return tuple(motions)


def build_truth(
    settings: FileSection,
    atmosphere: models.Atmosphere | None,
    noise_nm: float | FloatArray,
    plant: models.TipTiltPlant,
) -> models.Truth:
    """Build the truth: turbulence, vibrations, noise and gain of the real loop."""
    kind, suite, motions = settings.true_turbulence, plant.hardware.suite, plant.motions
    if kind == "frozen_flow":
        hint = "truth.turbulence: frozen_flow is its spectrum. Give it, or truth.turbulence: model"
        require_section(settings, "atmosphere", hint)
    one = plant.turbulence[0]
    same = all(model is one for model in plant.turbulence)
    spectra: dict[str, models.Spectrum | tuple[models.ARModel, ...] | None] = {
        "frozen_flow": atmosphere,
        "model": one if same else plant.turbulence,
        "none": None,
    }
    vibrations = _build_true_vibrations(settings, plant)
    if suite.sensors and true_vibrations_owner(settings) == "truth":
        lines = [(section, key, 1) for section, key, _ in vibration_numbers(settings, "truth")]
        motions = _build_motions(lines, suite)
    return models.Truth(
        turbulence=spectra[kind],
        vibrations=vibrations,
        motions=motions if suite.sensors else (),
        noise_nm=noise_nm,
        sensor_gain=settings.truth.sensor_gain / reference_gain(settings),
        frequency_errors_hz=_frequency_errors(settings, vibrations),
    )


def build_end_to_end_setup(
    settings: FileSection, hardware: models.LoopHardware, truth: models.Truth
) -> EndToEndSetup:
    """Build the simulation that a configuration describes; refuse one that describes none."""
    from lbt_synth.interop.specula.optics import EndToEndSetup  # half of the time of a design

    hint = "an end-to-end simulation needs it"
    telescope, air = (require_section(settings, x, hint) for x in ("telescope", "atmosphere"))
    pyramid, modes = settings.sensor.pyramid, settings.mirror.modes
    calibrated = "must be left out for an end-to-end simulation, which calibrates it in nanometres"
    turbulence, screens = settings.true_turbulence, "must be a length: phase screens have an end"
    needs = "for an end-to-end simulation"
    for key, right, why in (
        ("sensor.pyramid", pyramid is not None, f"is missing; {hint}"),
        ("atmosphere.outer_scale_m", air.outer_scale_m is not None, f"{screens}. Try 25"),
        ("truth.turbulence", turbulence == "frozen_flow", f"must be frozen_flow {needs}"),
        ("loop.axes", hardware.modes == 2, f"must be 2, tip and tilt, {needs}"),
        ("mirror.modes", modes is not None, f"is missing; {hint}"),
        ("sensor.matrix", settings.sensor.matrix is None, calibrated),
        ("mirror.influence_matrix", settings.mirror.influence_matrix is None, calibrated),
    ):
        if not right:
            raise ConfigError(f"{key} {why}.", path=key)
    sensing: dict[str, Any] = {} if pyramid is None else pyramid.model_dump()
    # the optics do not depend on the sensor gain that the design assumes
    modal = replace(hardware, sensor_matrix=None, influence_matrix=None, modes=2)
    with name_key("end_to_end"):
        return EndToEndSetup(
            hardware=modal,
            sensing_wavelength_um=sensing.pop("wavelength_um"),
            imaging_wavelength_um=settings.imaging.wavelength_um,
            modes=modes or 0,
            vibrations=truth.vibrations,
            motions=truth.motions,
            seed=settings.simulation.seed,
            **telescope.model_dump(),
            **air.model_dump(),
            **sensing,
            **settings.end_to_end.model_dump(),
        )
