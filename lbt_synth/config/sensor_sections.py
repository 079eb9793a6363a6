"""The sections of the sensors: the loop's own, and others beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, model_validator

from lbt_synth.config.section import Section
from lbt_synth.methods import quantities as q
from lbt_synth.models.sensor_suite import OWN_SENSOR


class PyramidSection(Section):
    """Pyramid sensor, from which the noise is computed."""

    wavelength_um: q.Micrometres = Field(description="sensing wavelength [um]")
    modulation_lambda_over_d: q.Gain = Field(description="modulation radius [lambda/D]")
    subapertures_across: q.Count = Field(le=1000, description="subapertures over the diameter")
    photons: q.Ratio = Field(description="photons per subaperture and frame")
    read_noise_electrons: q.RatioFromZero = Field(description="read noise per pixel [electrons]")


class SensorSection(Section):
    """Measurement noise: given, or from a pyramid."""

    noise_nm: q.NanometresOrEach | None = Field(
        default=None,
        description="noise per frame [nm rms], or one per measurement",
    )
    noise_mas: q.Milliarcseconds | None = Field(default=None, description="noise per frame [mas]")
    pyramid: PyramidSection | None = Field(
        default=None, description="a pyramid, whose noise is computed"
    )
    matrix: list[list[q.Entry]] | None = Field(
        default=None, description="rows: measurements by modes (default: identity)"
    )

    @model_validator(mode="after")
    def _require_one_noise(self) -> SensorSection:
        given = [v is not None for v in (self.noise_nm, self.noise_mas, self.pyramid)]
        if sum(given) != 1:
            raise ValueError("expected exactly one of noise_nm, noise_mas, pyramid")
        return self


class MotionSection(Section):
    """How a channel of an accelerometer moves with a vibration, at its frequency."""

    motion_nm_per_nm: q.Ratio = Field(
        description="motion at the channel per motion of the wavefront [nm per nm rms]"
    )
    phase_deg: float = Field(
        default=0.0, ge=-360, le=360, description="phase of it against the wavefront's [deg]"
    )


class OtherSensorSection(Section):
    """A sensor beside the loop's own: a wavefront sensor of another rate, or an accelerometer."""

    kind: Literal["wavefront", "accelerometer"] = Field(
        default="wavefront", description="wavefront or accelerometer"
    )
    rate_hz: q.Hertz = Field(description="readings per second, a fraction of the frame rate [Hz]")
    delay_frames: float = Field(
        ge=1, le=100, description="total delay, in periods of the sensor [frames]"
    )
    noise_nm: q.NanometresOrEach | None = Field(
        default=None, description="noise of a reading of a wavefront sensor [nm rms]"
    )
    matrix: list[list[q.Entry]] | None = Field(
        default=None, description="rows: measurements by modes (default: identity)"
    )
    channels: list[str] | None = Field(
        default=None, min_length=1, description="names of the channels of an accelerometer"
    )
    noise_m_s2: q.AccelerationOrEach | None = Field(
        default=None, description="noise of a reading of an accelerometer [m/s^2]"
    )
    highpass_hz: q.Hertz | None = Field(
        default=None, description="corner of an accelerometer's high pass [Hz]"
    )
    covariance: list[list[q.Entry]] | None = Field(
        default=None, description="covariance of the noise, in place of its size [nm^2, (m/s^2)^2]"
    )

    @model_validator(mode="after")
    def _require_what_the_kind_has(self) -> OtherSensorSection:
        own = {"wavefront": ("matrix",), "accelerometer": ("channels", "highpass_hz")}
        noises = {"wavefront": "noise_nm", "accelerometer": "noise_m_s2"}
        for kind, names in own.items():
            for name in (*names, noises[kind]):
                if kind != self.kind and getattr(self, name) is not None:
                    raise ValueError(f"{name} goes with kind: {kind}, and only with it")
        noise = noises[self.kind]
        if (getattr(self, noise) is None) == (self.covariance is None):
            raise ValueError(f"expected exactly one of {noise}, covariance")
        if self.kind == "accelerometer" and self.channels is None:
            raise ValueError("an accelerometer needs the names of its channels")
        return self


def with_own_sensor(raw: Any) -> Any:
    """Return a file in which ``sensors.wavefront``, the loop's own sensor, is loop and sensor."""
    sensors = raw.get("sensors") if isinstance(raw, Mapping) else None
    if not isinstance(sensors, Mapping) or not isinstance(sensors.get(OWN_SENSOR), Mapping):
        return raw
    own = sensors[OWN_SENSOR]
    loop, sensor = dict(raw.get("loop") or {}), dict(raw.get("sensor") or {})
    for name, value in own.items():
        section, key = (loop, _LOOP_KEYS[name]) if name in _LOOP_KEYS else (sensor, name)
        if name != "kind" and section.setdefault(key, value) != value:
            where = "loop" if section is loop else "sensor"
            raise ValueError(
                f"sensors.{OWN_SENSOR}.{name} is {value!r}, and {where}.{key} {section[key]!r}"
            )
    others = {name: value for name, value in sensors.items() if name != OWN_SENSOR}
    return {**raw, "loop": loop, "sensor": sensor, "sensors": others or None}


_LOOP_KEYS = {"rate_hz": "frame_rate_hz", "delay_frames": "delay_frames"}
