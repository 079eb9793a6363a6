"""Models as identification returns them, written as configurations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import lbt_synth as lbt
from lbt_synth.config.write import config_text, identified_config
from lbt_synth.identification.fit.identified_model import IdentifiedLine

RATE = 1000.0


@dataclass(frozen=True, kw_only=True)
class Line:
    frequency_hz: float
    damping: float
    rms_nm: float
    frequency_error_hz: float = 0.01
    damping_error: float = 0.0004
    rms_error_nm: float = 1.5
    kind: str = "line"
    direction: tuple | None = None
    direction_error_deg: float | None = None
    sections: int = 1
    direction_deg = IdentifiedLine.direction_deg


@dataclass(frozen=True, kw_only=True)
class Axis:
    turbulence: lbt.models.ARModel
    parts: tuple = ()
    noise_nm: float = 15.5
    noise_error_nm: float = 0.12
    sensor_gain: float = 1.0
    sensor_gain_error: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Model:
    axes: tuple
    shared: tuple = ()
    parts = lbt.identification.IdentifiedModel.parts
    frame_rate_hz: float = RATE
    delay_frames: float = 2.0
    mirror: lbt.models.PositionLoop | None = None


def ar(*coefficients, driving):
    return lbt.models.ARModel(coefficients=coefficients, driving_rms_nm=driving, frame_rate_hz=RATE)


TIP = Axis(
    turbulence=ar(1.9960123456789, -0.99602, driving=0.123456789012345),
    parts=(
        Line(frequency_hz=20.123456789, damping=0.0051, rms_nm=300.0),
        Line(frequency_hz=47.0, damping=0.01, rms_nm=40.0),
    ),
    sensor_gain=0.83,
    sensor_gain_error=0.011,
)
TILT = Axis(
    turbulence=ar(0.9899, driving=31.0),
    parts=(Line(frequency_hz=13.7, damping=0.02, rms_nm=120.0),),
    noise_nm=9.25,
    sensor_gain=0.71,
    sensor_gain_error=float("nan"),
)
TWO = Model(axes=(TIP, TILT))
ONE_AXIS = Model(axes=(replace(TIP, sensor_gain=1.0),))
SHELL = lbt.models.PositionLoop.from_bandwidth(
    natural_frequency_hz=50, damping=0.5, bandwidth_hz=500
)


def save_identified(tmp_path, model, name="model.yaml", **options):
    settings, comments = identified_config(model, **options)
    (tmp_path / name).write_text(config_text(settings, comments))
    return tmp_path / name
