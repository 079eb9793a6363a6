"""Build the plant, the truth and the noise that a configuration describes."""

from __future__ import annotations

from typing import Any

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
    BandSection,
    FileSection,
    LocalLoopSection,
    TrueVibrationSection,
    VibrationSection,
)
from lbt_synth.config.telescope_and_atmosphere import (
    convert_mas_to_nm,
    require_atmosphere,
    require_telescope,
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
    pyramid_tilt_noise_nm,
    tip_tilt_plant,
)
from lbt_synth.models.plant.frequency_prior import line_frequencies, spread_lines
from lbt_synth.models.vibration.in_a_loop import TrueVibration
from lbt_synth.validation import FloatArray, frozen_copy


def measurement_noise_nm(settings: FileSection) -> float | FloatArray:
    """Return the noise per frame [nm], of all measurements or of each."""
    sensor = settings.sensor
    if isinstance(sensor.noise_nm, list):
        count = count_measurements(settings)
        return frozen_copy(require_length(sensor.noise_nm, count, "sensor.noise_nm", "measurement"))
    if sensor.noise_nm is not None:
        return sensor.noise_nm
    if sensor.noise_mas is not None:
        return convert_mas_to_nm(settings, sensor.noise_mas, "sensor.noise_mas")
    pyramid = sensor.pyramid
    assert pyramid is not None  # the schema wants exactly one of the three
    telescope = require_telescope(
        settings, "the noise of sensor.pyramid depends on it. Give it, or sensor.noise_nm"
    )
    return pyramid_tilt_noise_nm(
        subapertures=illuminated_subapertures(pyramid.subapertures_across, telescope.obstruction),
        diameter_m=telescope.diameter_m,
        **pyramid.model_dump(exclude={"subapertures_across"}),
    )


def assumed_gains(settings: FileSection) -> FloatArray:
    """Return the sensor gains that the design assumes, one per measurement, (q,)."""
    given = settings.model.sensor_gain
    count = count_measurements(settings)
    if isinstance(given, list):
        return frozen_copy(require_length(given, count, "model.sensor_gain", "measurement"))
    return frozen_copy(np.full(count, given))


def reference_gain(settings: FileSection) -> float:
    """Return the assumed gain with which a single number is compared: the mean of the gains."""
    given = settings.model.sensor_gain
    return float(np.mean(assumed_gains(settings))) if isinstance(given, list) else given


def build_plant(
    settings: FileSection, atmosphere: Atmosphere | None, noise_nm: float | FloatArray
) -> TipTiltPlant:
    """Build the plant of the design."""
    loop, model, axes = settings.loop, settings.model, count_axes(settings)
    lines: list[Vibration] | None = None
    if model.vibrations is not None:
        lines = []
        for i, section in enumerate(model.vibrations):
            key = f"model.vibrations[{i}]"
            _require_below_nyquist(section.frequency_hz, loop.frame_rate_hz, f"{key}.frequency_hz")
            for direction in vibration_directions(section, axes, key):
                line = Vibration(
                    frequency_hz=section.frequency_hz,
                    damping=section.damping,
                    rms_nm=vibration_rms_nm(section, settings, key),
                    direction=direction,
                )
                lines += spread_vibration(line, section, loop.frame_rate_hz, i)
    return tip_tilt_plant(
        frame_rate_hz=loop.frame_rate_hz,
        delay_frames=loop.delay_frames,
        turbulence=_build_turbulence(settings, atmosphere, noise_nm),
        vibrations=lines,
        noise_nm=noise_nm,
        sensor_matrix=settings.sensor.matrix,
        influence_matrix=settings.mirror.influence_matrix,
        sensor_gain=assumed_gains(settings),
        modes=axes,
        mirror=_build_mirror(settings.mirror.local_loop),
    )


def _build_turbulence(
    settings: FileSection, atmosphere: Atmosphere | None, noise_nm: float | FloatArray
) -> ARModel | list[ARModel]:
    """Return one model for all axes, or one per axis where sections or noise differ."""
    given, axes, key = settings.model.turbulence, count_axes(settings), "model.turbulence"
    if isinstance(given, list):
        sections = require_length(given, axes, key, "axis")
    else:
        sections = [given] * axes
    noisy = np.ndim(noise_nm) == 1 and any(isinstance(s, Ar2Section) for s in sections)
    if noisy and count_measurements(settings) != axes:
        raise ConfigError(
            f"{key}: kind ar2 is fitted above the noise of its axis, but sensor.noise_nm has one "
            f"per measurement, {np.size(noise_nm)} for {axes} axes. Give one noise for all, or "
            "kind ar.",
            path=key,
        )
    if not isinstance(given, list) and not noisy:
        noise = float(np.ravel(noise_nm)[0])  # only ar2 uses it
        return _build_turbulence_model(given, settings, atmosphere, noise, key)
    noises = np.broadcast_to(noise_nm if noisy else np.ravel(noise_nm)[0], (axes,))
    return [
        _build_turbulence_model(
            section, settings, atmosphere, noise, f"{key}[{i}]" if isinstance(given, list) else key
        )
        for i, (section, noise) in enumerate(zip(sections, noises.tolist(), strict=True))
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
    line: Vibration, section: VibrationSection, frame_rate_hz: float, index: int
) -> list[Vibration]:
    """Return the lines that represent a vibration of the model: several if it is spread."""
    if section.spread_hz is None:
        return [line]
    with name_key(f"model.vibrations[{index}].spread_hz"):
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
    one = plant.turbulence[0]
    same = all(model is one for model in plant.turbulence)
    spectra: dict[str, Spectrum | tuple[ARModel, ...] | None] = {
        "frozen_flow": atmosphere,
        "model": one if same else plant.turbulence,
        "none": None,
    }
    return Truth(
        turbulence=spectra[kind],
        vibrations=_build_true_vibrations(settings, plant),
        noise_nm=noise_nm,
        sensor_gain=_relative_gain(settings),
    )


def _build_true_vibrations(settings: FileSection, plant: TipTiltPlant) -> tuple[TrueVibration, ...]:
    if not isinstance(settings.truth.vibrations, list):
        return plant.vibrations
    rate, lines = settings.loop.frame_rate_hz, list[TrueVibration]()
    for i, section in enumerate(settings.truth.vibrations):
        key = f"truth.vibrations[{i}]"
        _require_below_nyquist(section.frequency_hz, rate, f"{key}.frequency_hz")
        for direction in vibration_directions(section, count_axes(settings), key):
            size: dict[str, Any] = {
                "frequency_hz": section.frequency_hz,
                "rms_nm": vibration_rms_nm(section, settings, key),
                "direction": direction,
            }
            if section.kind == "drift":
                lines.append(_build_drifting_vibration(section, size, rate, key))
            elif section.damping is None:
                lines.append(SinusoidalVibration(**size))
            else:
                lines.append(Vibration(**size, damping=section.damping))
    return tuple(lines)


def _build_drifting_vibration(
    section: TrueVibrationSection, size: dict[str, Any], frame_rate_hz: float, key: str
) -> DriftingVibration:
    """Build a vibration that drifts from ``frequency_hz`` to ``end_hz``."""
    assert section.end_hz is not None  # the schema wants both with this kind
    assert section.duration_s is not None
    _require_below_nyquist(section.end_hz, frame_rate_hz, f"{key}.end_hz")
    given = {name: value for name, value in size.items() if name != "frequency_hz"}
    with name_key(key):
        return DriftingVibration(
            **given,
            start_hz=section.frequency_hz,
            end_hz=section.end_hz,
            duration_s=section.duration_s,
            damping=section.damping,
        )


def _relative_gain(settings: FileSection) -> float:
    """Return the real sensor gain divided by that in the plant's sensor matrix."""
    assumed, given = assumed_gains(settings), settings.truth.sensor_gain
    if not isinstance(given, list):
        return given / reference_gain(settings)
    key = "truth.sensor_gain"
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


def vibration_rms_nm(
    section: VibrationSection | TrueVibrationSection | BandSection, settings: FileSection, key: str
) -> float:
    """Return the size of a vibration [nm rms wavefront], which the file gives in nm or mas."""
    if section.rms_nm is not None:
        return section.rms_nm
    assert section.rms_mas is not None  # the schema wants exactly one of the two
    return convert_mas_to_nm(settings, section.rms_mas, f"{key}.rms_mas")


def _require_below_nyquist(frequency_hz: float, frame_rate_hz: float, key: str) -> None:
    if not frequency_hz < frame_rate_hz / 2:
        raise ConfigError(
            f"{key}: must lie below the Nyquist frequency {frame_rate_hz / 2:.6g} Hz; "
            f"got {frequency_hz:.6g}.",
            path=key,
        )
