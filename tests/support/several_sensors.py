"""A small loop of several sensors: a dim star, a slow quiet sensor and two accelerometers."""

from __future__ import annotations

from pathlib import Path

CONFIG = """\
version: 1
telescope: {diameter_m: 8.22, obstruction: 0.11}
loop: {frame_rate_hz: 1000, delay_frames: 2, axes: 2}
sensor: {noise_nm: 75}
sensors:
  slow: {rate_hz: 500, delay_frames: 2.5, noise_nm: 20}
  mirror:
    {kind: accelerometer, rate_hz: 1000, delay_frames: 1, channels: [m1, m2], noise_m_s2: 2.0e-4}
model:
  turbulence: {kind: ar, coefficients: [0.999], driving_rms_nm: 8}
  vibrations:
    - {axis: tip, frequency_hz: 20, damping: 0.01, rms_nm: 500,
       accelerometers: {m1: {motion_nm_per_nm: 2}}}
    - {axis: tilt, frequency_hz: 33, damping: 0.01, rms_nm: 200,
       accelerometers: {m2: {motion_nm_per_nm: 1.5, phase_deg: 150}}}
truth: {vibrations: model}
robustness: {errors_hz: [2], sensor_gains: [0.5, 1]}
simulation: {frames: 2000, cases: 2, settle_frames: 500}
"""


def write_config(folder: Path, text: str = CONFIG) -> Path:
    """Write the configuration into a folder."""
    path = folder / "sensors.yaml"
    path.write_text(text)
    return path
