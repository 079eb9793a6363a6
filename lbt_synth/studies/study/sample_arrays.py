"""Parameters of many samples as arrays, for an ensemble of loops.

A parameter of the weather, of a true vibration, of the noise, the sensor gain or the delay
changes numbers of an ensemble. Any other makes another configuration: samples that share the
values of all these are a group.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.config import Config
from lbt_synth.config.axes import count_axes, vibration_directions
from lbt_synth.config.plant_and_truth import (
    measurement_noise_nm,
    spread_vibration,
    vibration_rms_nm,
)
from lbt_synth.config.schema import SensorSection
from lbt_synth.config.telescope_and_atmosphere import convert_mas_to_nm
from lbt_synth.loop import EnsembleVibration, LoopEnsemble
from lbt_synth.models import FrozenFlows, Vibration
from lbt_synth.studies.study.config_keys import Keys
from lbt_synth.studies.study.sample import Sample
from lbt_synth.studies.study.study import DELAY_ERROR, NOISE_FACTOR, Study
from lbt_synth.validation import BoolArray, FloatArray, IntArray

WEATHER = ("seeing_arcsec", "wind_speed_m_s", "outer_scale_m")
ASSUMED_GAIN = ("model", "sensor_gain")
ASSUMED_DELAY = ("loop", "delay_frames")
_GAIN = ("truth", "sensor_gain")
_VIBRATION_NUMBERS = ("frequency_hz", "rms_nm", "rms_mas", "damping")
_NOISE_NUMBERS = (
    ("sensor", "noise_nm"),
    ("sensor", "noise_mas"),
    ("sensor", "pyramid", "photons"),
    ("sensor", "pyramid", "read_noise_electrons"),
    ("sensor", "pyramid", "modulation_lambda_over_d"),
)
_LONGEST_DELAY = 100.0  # frames


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleArrays:
    """Parameters of b samples of one group."""

    config: Config  # of one of the samples
    count: int  # b
    places: dict[Keys, FloatArray]  # values at each place that varies, (b,)
    errors: dict[str, FloatArray]  # delay errors and noise factors, (b,)

    def take(self, which: IntArray) -> SampleArrays:
        """Return some of the samples."""
        return SampleArrays(
            config=self.config,
            count=which.size,
            places={keys: values[which] for keys, values in self.places.items()},
            errors={name: values[which] for name, values in self.errors.items()},
        )

    def values_at(self, *keys: str | int) -> FloatArray | None:
        """Return the values at a place, (b,), None if it does not vary."""
        return self.places.get(keys)

    def frozen_flows(self) -> FrozenFlows | None:
        """Return the frozen flows of the samples, None if the weather does not vary."""
        varying = {name: self.values_at("atmosphere", name) for name in WEATHER}
        varying = {name: values for name, values in varying.items() if values is not None}
        if not varying or self.config.atmosphere is None:
            return None
        return FrozenFlows(atmosphere=self.config.atmosphere, **varying)

    def assumed_noise(self) -> FloatArray:
        """Return the noise that designs assume [nm], (b, 1) or (b, q)."""
        settings = self.config.settings
        varying = [keys for keys in _NOISE_NUMBERS if keys in self.places]
        if not varying:
            return np.broadcast_to(
                self.config.noise_nm, (self.count, np.size(self.config.noise_nm))
            )
        given = np.stack([self.places[keys] for keys in varying], axis=1)
        unique, which = np.unique(given, axis=0, return_inverse=True)
        found = []
        for row in unique.tolist():
            sensor: SensorSection = settings.sensor
            for keys, value in zip(varying, row, strict=True):
                if len(keys) == 3:
                    assert sensor.pyramid is not None  # the parameter leads there
                    pyramid = sensor.pyramid.model_copy(update={keys[2]: value})
                    sensor = sensor.model_copy(update={"pyramid": pyramid})
                else:
                    sensor = sensor.model_copy(update={keys[1]: value})
            found.append(
                np.ravel(measurement_noise_nm(settings.model_copy(update={"sensor": sensor})))
            )
        return np.asarray(found)[which.reshape(-1)]

    def assumed_delay(self) -> FloatArray:
        """Return the delay that designs assume [frames], (b,)."""
        delay = self.values_at(*ASSUMED_DELAY)
        return np.full(self.count, self.config.hardware.delay_frames) if delay is None else delay

    def real_delay(self) -> FloatArray:
        """Return the delay of the real loops [frames], (b,)."""
        return np.asarray(self.assumed_delay() + self.errors.get(DELAY_ERROR, 0.0))

    def vibrations(self, owner: str, sections: Sequence[Any]) -> Iterator[dict[str, Any]]:
        """Yield numbers and direction of each vibration of a list of sections."""
        settings = self.config.settings
        for i, section in enumerate(sections):
            key = f"{owner}.vibrations[{i}]"
            given = {
                name: self.values_at(owner, "vibrations", i, name) for name in _VIBRATION_NUMBERS
            }
            rms = given["rms_nm"]
            if given["rms_mas"] is not None:
                rms = given["rms_mas"] * convert_mas_to_nm(settings, 1.0, f"{key}.rms_mas")
            frequency, damping = given["frequency_hz"], given["damping"]
            for direction in vibration_directions(section, count_axes(settings), key):
                numbers: dict[str, Any] = {
                    "frequency_hz": section.frequency_hz if frequency is None else frequency,
                    "rms_nm": vibration_rms_nm(section, settings, key) if rms is None else rms,
                    "damping": section.damping if damping is None else damping,
                    "direction": direction,
                }
                if getattr(section, "spread_hz", None) is None:
                    yield numbers
                    continue
                # in a list with a spread vibration, no number of any vibration varies
                whole = Vibration(**numbers)
                for line in spread_vibration(whole, section, self.config.hardware.frame_rate_hz, i):
                    yield {name: getattr(line, name) for name in numbers}

    def ensemble(self) -> LoopEnsemble:
        """Return the ensemble of the real loops."""
        config, settings = self.config, self.config.settings
        gain = self.values_at(*_GAIN)
        flows = self.frozen_flows()
        truth, turbulence = config.truth, config.truth.turbulence
        if flows is not None and settings.true_turbulence == "frozen_flow":
            turbulence = flows
        return LoopEnsemble(
            sensor_gain=truth.sensor_gain if gain is None else gain / config.sensor_gain,
            delay_frames=self.real_delay(),
            noise_nm=self.assumed_noise() * self._noise_factor(),
            turbulence=turbulence,
            vibrations=tuple(
                EnsembleVibration(**numbers)
                for numbers in self.vibrations(*_true_vibrations(config))
            ),
            loops=self.count,
        )

    def valid(self) -> BoolArray:
        """Return which samples have numbers that the configuration accepts, (b,)."""
        valid = np.ones(self.count, dtype=np.bool_)
        nyquist = self.config.hardware.frame_rate_hz / 2
        for keys, values in self.places.items():
            if keys == ASSUMED_DELAY:
                valid &= (values >= 1) & (values <= _LONGEST_DELAY)
            elif keys == ("sensor", "pyramid", "read_noise_electrons"):
                valid &= values >= 0
            else:
                highest = {"frequency_hz": nyquist, "damping": 1.0}.get(str(keys[-1]), np.inf)
                valid &= (values > 0) & (values < highest)
        real = self.real_delay()
        valid &= (real >= 1) & (real <= _LONGEST_DELAY)
        return valid & (self._noise_factor()[:, 0] >= 0)

    def _noise_factor(self) -> FloatArray:
        return np.broadcast_to(self.errors.get(NOISE_FACTOR, 1.0), (self.count,))[:, None]


def _true_vibrations(config: Config) -> tuple[str, Sequence[Any]]:
    """Return the owner of the true vibrations, truth or model, and their sections."""
    settings = config.settings
    if isinstance(settings.truth.vibrations, list):
        return "truth", settings.truth.vibrations
    return "model", settings.model.vibrations or ()


def changes_numbers_only(study: Study, keys: Keys) -> bool:
    """Whether a parameter at a place only changes numbers of the ensemble."""
    settings = study.config.settings
    if keys in (_GAIN, ASSUMED_DELAY):
        return True  # an entry of a list has another place, such as truth.sensor_gain[0]
    if keys in _NOISE_NUMBERS:
        return not (
            settings.true_turbulence == "model" and turbulence_kinds(study.config) & {"ar2"}
        )
    if keys[0] == "atmosphere":
        return keys[1] in WEATHER and settings.true_turbulence != "model"
    owner, sections = _true_vibrations(study.config)
    return is_vibration_number(keys, owner) and all(
        getattr(section, "spread_hz", None) is None for section in sections
    )


def changes_assumptions_only(study: Study, keys: Keys) -> bool:
    """Whether a parameter at a place only changes what designs assume."""
    settings = study.config.settings
    if keys == ASSUMED_GAIN:
        # the real sensor is its matrix times truth.sensor_gain, whatever designs assume
        return not isinstance(settings.truth.sensor_gain, list)
    return (
        is_vibration_number(keys, "model")
        and isinstance(settings.truth.vibrations, list)
        and all(section.spread_hz is None for section in settings.model.vibrations or ())
    )


def is_vibration_number(keys: Keys, owner: str) -> bool:
    """Whether a place is a number of a vibration in a section."""
    return len(keys) == 4 and keys[:2] == (owner, "vibrations") and keys[3] in _VIBRATION_NUMBERS


def turbulence_kinds(config: Config) -> set[str]:
    """Return the kinds of turbulence that designs assume."""
    given = config.settings.model.turbulence
    return {section.kind for section in (given if isinstance(given, list) else [given])}


def make_sample_arrays(study: Study, sample: Sample, values: FloatArray) -> SampleArrays:
    """Return the arrays of a group of rows of ``Study.values``; the sample is one of them."""
    places: dict[Keys, FloatArray] = {}
    errors: dict[str, FloatArray] = {}
    for parameter, column in zip(study.parameters, values.T, strict=True):
        if parameter.name in (DELAY_ERROR, NOISE_FACTOR):
            errors[parameter.name] = column
        for keys in parameter.places:
            places[keys] = column
    return SampleArrays(config=sample.config, count=len(values), places=places, errors=errors)
