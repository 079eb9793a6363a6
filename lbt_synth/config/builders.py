"""From the sections of a configuration to the plant and the truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from lbt_synth.config.axes import axes_of, directions_of, fitted, measurements_of
from lbt_synth.config.required_sections import needed_atmosphere, needed_telescope, nm_of_mas
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
from lbt_synth.errors import ConfigError, ProblemError
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
from lbt_synth.models.truth import TrueVibration
from lbt_synth.models.vibration_prior import line_frequencies, spread_lines
from lbt_synth.validation import FloatArray, frozen


def noise_of(settings: FileSection) -> float | FloatArray:
    """Return the noise per frame [nm], of all measurements or of each."""
    sensor = settings.sensor
    if isinstance(sensor.noise_nm, list):
        return frozen(
            fitted(sensor.noise_nm, measurements_of(settings), "sensor.noise_nm", "a measurement")
        )
    if sensor.noise_nm is not None:
        return sensor.noise_nm
    if sensor.noise_mas is not None:
        return nm_of_mas(settings, sensor.noise_mas, "sensor.noise_mas")
    pyramid = sensor.pyramid
    assert pyramid is not None  # the schema wants exactly one of the three
    telescope = needed_telescope(
        settings, "the noise of sensor.pyramid depends on it. Give it, or sensor.noise_nm"
    )
    return pyramid_tilt_noise_nm(
        photons=pyramid.photons,
        read_noise_electrons=pyramid.read_noise_electrons,
        modulation_lambda_over_d=pyramid.modulation_lambda_over_d,
        subapertures=illuminated_subapertures(pyramid.subapertures_across, telescope.obstruction),
        wavelength_um=pyramid.wavelength_um,
        diameter_m=telescope.diameter_m,
    )


def believed_gains(settings: FileSection) -> FloatArray:
    """Return the sensor gain of each measurement that the design assumes, (q,)."""
    given = settings.model.sensor_gain
    count = measurements_of(settings)
    if isinstance(given, list):
        return frozen(fitted(given, count, "model.sensor_gain", "a measurement"))
    return frozen(np.full(count, given))


def reference_gain(settings: FileSection) -> float:
    """Return what a single number for the sensor gain is compared with: the mean over the axes."""
    given = settings.model.sensor_gain
    return float(np.mean(believed_gains(settings))) if isinstance(given, list) else given


def plant_of(
    settings: FileSection, atmosphere: Atmosphere | None, noise_nm: float | FloatArray
) -> TipTiltPlant:
    """Build the plant of the design."""
    loop, model, axes = settings.loop, settings.model, axes_of(settings)
    lines: list[Vibration] | None = None
    if model.vibrations is not None:
        lines = []
        for i, section in enumerate(model.vibrations):
            key = f"model.vibrations[{i}]"
            _below_nyquist(section.frequency_hz, loop.frame_rate_hz, f"{key}.frequency_hz")
            for direction in directions_of(section, axes, key):
                line = Vibration(
                    frequency_hz=section.frequency_hz,
                    damping=section.damping,
                    rms_nm=rms_nm(section, settings, key),
                    direction=direction,
                )
                lines += lines_of(line, section, loop.frame_rate_hz, i)
    return tip_tilt_plant(
        frame_rate_hz=loop.frame_rate_hz,
        delay_frames=loop.delay_frames,
        turbulence=_turbulence(settings, atmosphere, noise_nm),
        vibrations=lines,
        noise_nm=noise_nm,
        sensor_matrix=settings.sensor.matrix,
        influence_matrix=settings.mirror.influence_matrix,
        sensor_gain=believed_gains(settings),
        modes=axes,
        mirror=_mirror(settings.mirror.local_loop),
    )


def _turbulence(
    settings: FileSection, atmosphere: Atmosphere | None, noise_nm: float | FloatArray
) -> ARModel | list[ARModel]:
    """Return one model for all axes, or one an axis where sections or noise differ."""
    given, axes, key = settings.model.turbulence, axes_of(settings), "model.turbulence"
    if isinstance(given, list):
        sections = fitted(given, axes, key, "an axis")
    else:
        sections = [given] * axes
    noisy = np.ndim(noise_nm) == 1 and any(isinstance(s, Ar2Section) for s in sections)
    if noisy and measurements_of(settings) != axes:
        raise ConfigError(
            f"{key}: kind ar2 is fitted above the noise of its axis, but sensor.noise_nm has one "
            f"a measurement, {np.size(noise_nm)} for {axes} axes. Give one noise for all, or kind "
            "ar.",
            path=key,
        )
    if not isinstance(given, list) and not noisy:
        noise = float(np.ravel(noise_nm)[0])  # ar2 alone reads it
        return _turbulence_model(given, settings, atmosphere, noise, key)
    noises = np.broadcast_to(noise_nm if noisy else np.ravel(noise_nm)[0], (axes,))
    return [
        _turbulence_model(
            section, settings, atmosphere, noise, f"{key}[{i}]" if isinstance(given, list) else key
        )
        for i, (section, noise) in enumerate(zip(sections, noises.tolist(), strict=True))
    ]


def _turbulence_model(
    section: Ar1Section | Ar2Section | ArSection,
    settings: FileSection,
    atmosphere: Atmosphere | None,
    noise_nm: float,
    key: str,
) -> ARModel:
    rate = settings.loop.frame_rate_hz
    if isinstance(section, ArSection):
        try:
            return ARModel(
                coefficients=np.array(section.coefficients),
                driving_rms_nm=section.driving_rms_nm,
                frame_rate_hz=rate,
            )
        except ProblemError as error:
            key = f"{key}.coefficients"
            raise ConfigError(f"{key}: {error}", path=key) from error
    needed_atmosphere(
        settings, f"{key} of kind {section.kind} is computed from it. Give it, or kind ar"
    )
    assert atmosphere is not None  # of the section that is there
    if isinstance(section, Ar1Section):
        return ar1_turbulence(atmosphere, frame_rate_hz=rate)
    return ar2_turbulence(atmosphere, frame_rate_hz=rate, noise_nm=noise_nm)


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


def lines_of(
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


def truth_of(
    settings: FileSection,
    atmosphere: Atmosphere | None,
    noise_nm: float | FloatArray,
    plant: TipTiltPlant,
) -> Truth:
    """Build what the loop really meets."""
    kind = settings.true_turbulence
    if kind == "frozen_flow":
        needed_atmosphere(
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
        vibrations=_true_vibrations(settings, plant),
        noise_nm=noise_nm,
        sensor_gain=_relative_gain(settings),
    )


def _true_vibrations(settings: FileSection, plant: TipTiltPlant) -> tuple[TrueVibration, ...]:
    if not isinstance(settings.truth.vibrations, list):
        return plant.vibrations
    lines: list[TrueVibration] = []
    for i, section in enumerate(settings.truth.vibrations):
        key = f"truth.vibrations[{i}]"
        _below_nyquist(section.frequency_hz, settings.loop.frame_rate_hz, f"{key}.frequency_hz")
        for direction in directions_of(section, axes_of(settings), key):
            size: dict[str, Any] = {
                "frequency_hz": section.frequency_hz,
                "rms_nm": rms_nm(section, settings, key),
                "direction": direction,
            }
            if section.kind == "drift":
                lines.append(_drifting(section, size, settings.loop.frame_rate_hz, key))
            elif section.damping is None:
                lines.append(SinusoidalVibration(**size))
            else:
                lines.append(Vibration(**size, damping=section.damping))
    return tuple(lines)


def _drifting(
    section: TrueVibrationSection, size: dict[str, Any], frame_rate_hz: float, key: str
) -> DriftingVibration:
    """Return a vibration that drifts from frequency_hz to end_hz."""
    assert section.end_hz is not None  # the schema wants both with this kind
    assert section.duration_s is not None
    _below_nyquist(section.end_hz, frame_rate_hz, f"{key}.end_hz")
    given = {name: value for name, value in size.items() if name != "frequency_hz"}
    try:
        return DriftingVibration(
            **given,
            start_hz=section.frequency_hz,
            end_hz=section.end_hz,
            duration_s=section.duration_s,
            damping=section.damping,
        )
    except ProblemError as error:
        raise ConfigError(f"{key}: {error}", path=key) from error


def _relative_gain(settings: FileSection) -> float:
    """Return the real sensor gain over that in the plant's sensor matrix."""
    believed, given = believed_gains(settings), settings.truth.sensor_gain
    if not isinstance(given, list):
        return given / reference_gain(settings)
    key = "truth.sensor_gain"
    ratios = np.array(fitted(given, believed.size, key, "a measurement")) / believed
    if np.ptp(ratios) > 1e-9 * ratios[0]:
        text = ", ".join(f"{ratio:.4g}" for ratio in ratios)
        raise ConfigError(
            f"{key}: must be model.sensor_gain times one factor, for the loop has one optical gain "
            f"that may differ from the model's; got the factors {text}. Give one number: their "
            "mean, in the proportion of model.sensor_gain.",
            path=key,
        )
    return float(ratios[0])


def rms_nm(
    section: VibrationSection | TrueVibrationSection | BandSection, settings: FileSection, key: str
) -> float:
    """Return the deviation of a vibration [nm rms wavefront], given in nm or in mas."""
    if section.rms_nm is not None:
        return section.rms_nm
    assert section.rms_mas is not None  # the schema wants exactly one of the two
    return nm_of_mas(settings, section.rms_mas, f"{key}.rms_mas")


def _below_nyquist(frequency_hz: float, frame_rate_hz: float, key: str) -> None:
    if not frequency_hz < frame_rate_hz / 2:
        raise ConfigError(
            f"{key}: must lie below the Nyquist frequency {frame_rate_hz / 2:.6g} Hz; "
            f"got {frequency_hz:.6g}.",
            path=key,
        )
