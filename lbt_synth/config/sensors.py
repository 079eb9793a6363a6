"""Build the sensors beside the loop's own, and the plant that all of them see."""

from __future__ import annotations

from typing import Literal

import numpy as np

from lbt_synth.config.plant_and_truth import (
    spread_vibration,
    true_vibrations_owner,
    vibration_numbers,
)
from lbt_synth.config.schema import FileSection
from lbt_synth.config.sensor_sections import OtherSensorSection
from lbt_synth.errors import name_key
from lbt_synth.models import TipTiltPlant, Vibration
from lbt_synth.models.sensor_suite import (
    Accelerometer,
    Motion,
    Motions,
    Sensor,
    SensorSuite,
    WavefrontSensor,
    checked_motions,
)


def build_sensors(settings: FileSection, plant: TipTiltPlant) -> TipTiltPlant:
    """Return the plant with the other sensors of the configuration."""
    if not settings.sensors:
        return plant
    with name_key("sensors"):
        suite = SensorSuite(
            sensors=tuple(_build_sensor(name, each) for name, each in settings.sensors.items())
        )
        motions = _build_motions(settings, "model", suite)
        return plant.with_sensors(suite, motions)


def build_true_motions(settings: FileSection, plant: TipTiltPlant) -> Motions:
    """Return how the channels move with each vibration of the truth."""
    owner = true_vibrations_owner(settings)
    suite = plant.hardware.suite
    return plant.motions if owner == "model" else _build_motions(settings, owner, suite)


def _build_sensor(name: str, section: OtherSensorSection) -> Sensor:
    with name_key(f"sensors.{name}"):
        timing = {"rate_hz": section.rate_hz, "delay_frames": section.delay_frames}
        noise = section.noise_nm if section.kind == "wavefront" else section.noise_m_s2
        size = np.array(section.covariance if noise is None else noise)
        given = float(size) if size.ndim == 0 else size
        if section.kind == "wavefront":
            matrix = None if section.matrix is None else np.array(section.matrix)
            return WavefrontSensor(name=name, **timing, noise_nm=given, sensor_matrix=matrix)
        return Accelerometer(
            name=name,
            **timing,
            channels=tuple(section.channels or ()),
            noise_m_s2=given,
            highpass_hz=section.highpass_hz,
        )


def _build_motions(
    settings: FileSection, owner: Literal["model", "truth"], suite: SensorSuite
) -> Motions:
    """Return the motions of each line: of all lines of a spread vibration the same."""
    out: list[dict[str, Motion]] = []
    for section, key, numbers in vibration_numbers(settings, owner):
        with name_key(f"{key}.accelerometers"):
            moving = {
                name: Motion(size=each.motion_nm_per_nm, phase_deg=each.phase_deg)
                for name, each in (section.accelerometers or {}).items()
            }
            checked_motions((moving,), suite, 1)
        lines = 1
        if getattr(section, "spread_hz", None):
            rate = settings.loop.frame_rate_hz
            lines = len(spread_vibration(Vibration(**numbers), section, rate, key))
        out += [moving] * lines
    return tuple(out)
