"""Build the plant, the truth and the noise that a configuration describes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal

import numpy as np

from lbt_synth.config.axes import (
    count_axes,
    count_measurements,
    require_length,
    vibration_directions,
)
from lbt_synth.config.schema import (
    Ar1Section,
    Ar2Section,
    ArSection,
    AtmosphereSection,
    FileSection,
    LocalLoopSection,
    TelescopeSection,
    VibrationSection,
)
from lbt_synth.errors import ConfigError, name_key
from lbt_synth.models import (
    ARModel,
    Atmosphere,
    DriftingVibration,
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
from lbt_synth.models.plant.frequency_prior import line_frequencies, spread_lines
from lbt_synth.models.vibration import TrueVibration
from lbt_synth.validation import FloatArray, frozen_copy

WEATHER = ("seeing_arcsec", "wind_speed_m_s", "outer_scale_m")  # keys of FrozenFlows


def require_telescope(settings: FileSection, reason: str) -> TelescopeSection:
    """Return the section ``telescope``; raise ConfigError with the reason if it is missing."""
    if settings.telescope is None:
        raise ConfigError(f"the key telescope is missing: {reason}.", path="telescope")
    return settings.telescope


def require_atmosphere(settings: FileSection, reason: str) -> AtmosphereSection:
    """Return the section ``atmosphere``; raise ConfigError with the reason if it is missing."""
    if settings.atmosphere is None:
        raise ConfigError(f"the key atmosphere is missing: {reason}.", path="atmosphere")
    return settings.atmosphere


def convert_mas_to_nm(settings: FileSection, mas: float, key: str) -> float:
    """Convert an angle of the file [mas] to a wavefront [nm rms]."""
    reason = f"{key} is in mas, and a wavefront in nm needs telescope.diameter_m"
    telescope = require_telescope(settings, f"{reason}. Give it, or the value in nm")
    return mas * nm_per_mas(telescope.diameter_m)


def build_atmosphere(settings: FileSection) -> Atmosphere | None:
    """Build the atmosphere of a configuration, None if it has none."""
    air = settings.atmosphere
    if air is None:
        return None
    telescope = require_telescope(
        settings, "the turbulence of atmosphere is that over its diameter"
    )
    weather = {name: getattr(air.per_sample, name) for name in WEATHER}
    rest = air.model_dump(exclude=set(WEATHER))
    return Atmosphere(diameter_m=telescope.diameter_m, **rest, **weather)


def measurement_noise_nm(settings: FileSection) -> float | FloatArray:
    """Return the noise per frame [nm], of all measurements or of each; (b,) of samples."""
    sensor = settings.sensor.per_sample
    if isinstance(sensor.noise_nm, list):
        count = count_measurements(settings)
        return frozen_copy(require_length(sensor.noise_nm, count, "sensor.noise_nm", "measurement"))
    if sensor.noise_nm is not None:
        return sensor.noise_nm
    if sensor.noise_mas is not None:
        return convert_mas_to_nm(settings, sensor.noise_mas, "sensor.noise_mas")
    pyramid = settings.sensor.pyramid
    assert pyramid is not None  # the schema wants exactly one of the three
    telescope = require_telescope(
        settings, "the noise of sensor.pyramid depends on it. Give it, or sensor.noise_nm"
    )
    varying = ("photons", "read_noise_electrons", "modulation_lambda_over_d")
    return map_distinct(
        pyramid_tilt_noise_nm,
        subapertures=illuminated_subapertures(pyramid.subapertures_across, telescope.obstruction),
        diameter_m=telescope.diameter_m,
        **pyramid.model_dump(exclude={"subapertures_across", *varying}),
        **{name: getattr(pyramid.per_sample, name) for name in varying},
    )


def map_distinct(function: Callable[..., float], **numbers: Any) -> float | FloatArray:
    """Apply a function of numbers to each distinct combination of those that are arrays (b,)."""
    arrays = {name: value for name, value in numbers.items() if np.ndim(value)}
    if not arrays:
        return function(**numbers)
    distinct, which = np.unique(np.stack([*arrays.values()], axis=1), axis=0, return_inverse=True)
    rows = (dict(zip(arrays, row, strict=True)) for row in distinct.tolist())
    found = np.array([function(**numbers | row) for row in rows])
    return np.asarray(found[which.reshape(-1)])


def assumed_gains(settings: FileSection) -> FloatArray:
    """Return the sensor gains that the design assumes, one per measurement, (q,) or (b, q)."""
    return _gain_per_measurement(settings, settings.model.per_sample.sensor_gain)


def _gain_per_measurement(settings: FileSection, given: Any) -> FloatArray:
    count = count_measurements(settings)
    if isinstance(given, list):
        return frozen_copy(require_length(given, count, "model.sensor_gain", "measurement"))
    return frozen_copy(np.repeat(np.expand_dims(given, -1), count, axis=-1))


def reference_gain(settings: FileSection) -> float:
    """Return the assumed gain with which a single number is compared: the mean of the gains."""
    given = settings.model.per_sample.sensor_gain
    return float(np.mean(assumed_gains(settings))) if isinstance(given, list) else given


def build_plant(
    settings: FileSection, atmosphere: Atmosphere | None, noise_nm: float | FloatArray
) -> TipTiltPlant:
    """Build the plant of the design."""
    loop = settings.loop
    lines: list[Vibration] | None = None if settings.model.vibrations is None else []
    for section, key, numbers in vibration_numbers(settings, "model"):
        assert lines is not None  # there are vibrations
        lines += spread_vibration(Vibration(**numbers), section, loop.frame_rate_hz, key)
    return tip_tilt_plant(
        frame_rate_hz=loop.frame_rate_hz,
        delay_frames=loop.per_sample.delay_frames,
        turbulence=_build_turbulence(settings, atmosphere, noise_nm),
        vibrations=lines,
        noise_nm=noise_nm,
        sensor_matrix=settings.sensor.matrix,
        influence_matrix=settings.mirror.influence_matrix,
        sensor_gain=assumed_gains(settings),
        modes=count_axes(settings),
        mirror=_build_mirror(settings.mirror.local_loop),
    )


def vibration_numbers(
    settings: FileSection, owner: Literal["model", "truth"]
) -> Iterator[tuple[Any, str, dict[str, Any]]]:
    """Yield each vibration of the model or of the truth: its section, its key, its numbers."""
    rate, axes = settings.loop.frame_rate_hz, count_axes(settings)
    for i, section in enumerate(getattr(settings, owner).vibrations or ()):
        key = f"{owner}.vibrations[{i}]"
        # the lines of a spread vibration are chosen for one frequency, damping and size
        numbers = section if getattr(section, "spread_hz", None) else section.per_sample
        _require_below_nyquist(numbers.frequency_hz, rate, f"{key}.frequency_hz")
        for direction in vibration_directions(section, axes, key):
            rms_nm = vibration_rms_nm(numbers, settings, key)
            given = {"frequency_hz": numbers.frequency_hz, "damping": numbers.damping}
            yield section, key, {**given, "rms_nm": rms_nm, "direction": direction}


def true_vibrations_owner(settings: FileSection) -> Literal["model", "truth"]:
    """Return which section has the vibrations that the real loop meets."""
    return "truth" if isinstance(settings.truth.vibrations, list) else "model"


def turbulence_sections(settings: FileSection) -> list[Ar1Section | Ar2Section | ArSection]:
    """Return the section of the assumed turbulence of each axis."""
    given, axes = settings.model.turbulence, count_axes(settings)
    if isinstance(given, list):
        return require_length(given, axes, "model.turbulence", "axis")
    return [given] * axes


def require_one_model_turbulence(settings: FileSection, *, but_flows: bool = False) -> None:
    """Declare that samples evaluated together share what the model's turbulence is computed from.

    With ``but_flows`` the models of kind ar1 are computed for each sample.
    """
    for section in turbulence_sections(settings):
        if isinstance(section, Ar2Section):  # fitted above the noise
            settings.sensor.require_one_value()
        if settings.atmosphere is not None and (
            isinstance(section, Ar2Section) or (isinstance(section, Ar1Section) and not but_flows)
        ):
            settings.atmosphere.require_one_value()


def _build_turbulence(
    settings: FileSection, atmosphere: Atmosphere | None, noise_nm: float | FloatArray
) -> ARModel | list[ARModel]:
    """Return one model for all axes, or one per axis where sections or noise differ."""
    axes, key = count_axes(settings), "model.turbulence"
    sections, listed = turbulence_sections(settings), isinstance(settings.model.turbulence, list)
    noisy = np.ndim(noise_nm) == 1 and any(isinstance(s, Ar2Section) for s in sections)
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
    return [
        _build_turbulence_model(
            section, settings, atmosphere, noise, f"{key}[{i}]" if listed else key
        )
        for i, (section, noise) in enumerate(zip(sections, noises, strict=True))
    ]


def _build_turbulence_model(
    section: Ar1Section | Ar2Section | ArSection,
    settings: FileSection,
    atmosphere: Atmosphere | None,
    noise_nm: float,
    key: str,
) -> ARModel:
    rate = settings.loop.frame_rate_hz
    if isinstance(section, ArSection):
        with name_key(f"{key}.coefficients"):
            return ARModel(
                coefficients=np.array(section.coefficients),
                driving_rms_nm=section.driving_rms_nm,
                frame_rate_hz=rate,
            )
    require_atmosphere(
        settings, f"{key} of kind {section.kind} is computed from it. Give it, or kind ar"
    )
    assert atmosphere is not None  # built from the section, which is there
    if isinstance(section, Ar1Section):
        return ar1_turbulence(atmosphere, frame_rate_hz=rate)
    return ar2_turbulence(atmosphere, frame_rate_hz=rate, noise_nm=noise_nm)


def _build_mirror(section: LocalLoopSection | None) -> PositionLoop | None:
    """Build the mirror's local loop, None for a mirror that settles at once."""
    if section is None:
        return None
    given: dict[str, Any] = {k: v for k, v in section.model_dump().items() if v is not None}
    make = PositionLoop if section.bandwidth_hz is None else PositionLoop.from_bandwidth
    with name_key("mirror.local_loop"):
        return make(**given)


def spread_vibration(
    line: Vibration, section: VibrationSection, frame_rate_hz: float, key: str
) -> list[Vibration]:
    """Return the lines that represent a vibration of the model: several if it is spread."""
    if section.spread_hz is None:
        return [line]
    with name_key(f"{key}.spread_hz"):
        frequencies = line_frequencies(
            line.frequency_hz, section.spread_hz, section.lines or 5, name="the half width"
        )
        lines = spread_lines(line, frequencies)
        lines[-1].ar_model(frame_rate_hz)  # the highest must lie below the Nyquist frequency
    return lines


def build_truth(
    settings: FileSection,
    atmosphere: Atmosphere | None,
    noise_nm: float | FloatArray,
    plant: TipTiltPlant,
) -> Truth:
    """Build the truth: turbulence, vibrations, noise and gain of the real loop."""
    kind = settings.true_turbulence
    if kind == "frozen_flow":
        require_atmosphere(
            settings,
            "truth.turbulence: frozen_flow is its spectrum. Give it, or truth.turbulence: model",
        )
    if kind == "model":
        require_one_model_turbulence(settings)
    one = plant.turbulence[0]
    same = all(model is one for model in plant.turbulence)
    spectra: dict[str, Spectrum | tuple[ARModel, ...] | None] = {
        "frozen_flow": atmosphere,
        "model": one if same else plant.turbulence,
        "none": None,
    }
    vibrations = _build_true_vibrations(settings, plant)
    return Truth(
        turbulence=spectra[kind],
        vibrations=vibrations,
        noise_nm=noise_nm,
        sensor_gain=relative_gain(settings, reference_gain(settings)),
        frequency_errors_hz=_frequency_errors(settings, vibrations),
    )


def _frequency_errors(
    settings: FileSection, vibrations: tuple[TrueVibration, ...]
) -> tuple[float, ...] | None:
    """Return the error that is stated of each vibration [Hz], 0 beside others; None if none is."""
    sections = getattr(settings, true_vibrations_owner(settings)).vibrations or []
    if all(section.largest_error_hz is None for section in sections):
        return None
    places = np.array([section.frequency_hz for section in sections])
    starts = [
        line.start_hz if isinstance(line, DriftingVibration) else line.frequency_hz
        for line in vibrations
    ]
    nearest = [sections[int(np.argmin(np.abs(places - start)))] for start in starts]
    return tuple(section.largest_error_hz or 0.0 for section in nearest)


def _build_true_vibrations(settings: FileSection, plant: TipTiltPlant) -> tuple[TrueVibration, ...]:
    if true_vibrations_owner(settings) == "model":
        return plant.vibrations
    rate, lines = settings.loop.frame_rate_hz, list[TrueVibration]()
    for section, key, numbers in vibration_numbers(settings, "truth"):
        if section.kind == "drift":
            start_hz = numbers.pop("frequency_hz")
            _require_below_nyquist(section.end_hz, rate, f"{key}.end_hz")
            with name_key(key):
                ends = {"start_hz": start_hz, "end_hz": section.end_hz}
                lines.append(DriftingVibration(**numbers, **ends, duration_s=section.duration_s))
        elif section.kind == "resonance":
            lines.append(Vibration(**numbers))
        else:
            del numbers["damping"]
            lines.append(SinusoidalVibration(**numbers))
    return tuple(lines)


def relative_gain(settings: FileSection, reference: float) -> Any:
    """Return the real sensor gain divided by that in the plant's sensor matrix; (b,) of samples.

    ``reference`` is the :func:`reference_gain` of that matrix.
    """
    given, key = settings.truth.per_sample.sensor_gain, "truth.sensor_gain"
    if not isinstance(given, list):
        return given / reference
    assumed = _gain_per_measurement(settings, settings.model.sensor_gain)
    ratios = np.array(require_length(given, assumed.size, key, "measurement")) / assumed
    if np.ptp(ratios) > 1e-9 * ratios[0]:
        text = ", ".join(f"{ratio:.4g}" for ratio in ratios)
        raise ConfigError(
            f"{key}: must be model.sensor_gain times one factor, for the loop has one optical gain "
            f"that may differ from the model's; got the factors {text}. Give one number: their "
            "mean, in the proportion of model.sensor_gain.",
            path=key,
        )
    return float(ratios[0])


def vibration_rms_nm(section: Any, settings: FileSection, key: str) -> float:
    """Return the size of a vibration [nm rms wavefront], which the file gives in nm or mas."""
    if section.rms_nm is not None:
        return section.rms_nm  # type: ignore[no-any-return]  # a section with a size
    return convert_mas_to_nm(settings, section.rms_mas, f"{key}.rms_mas")


def _require_below_nyquist(frequency_hz: Any, frame_rate_hz: float, key: str) -> None:
    highest_hz = np.max(frequency_hz)
    if not highest_hz < frame_rate_hz / 2:
        raise ConfigError(
            f"{key}: must lie below the Nyquist frequency {frame_rate_hz / 2:.6g} Hz; "
            f"got {highest_hz:.6g}.",
            path=key,
        )
