"""What the loops of many samples meet, as arrays: the parameters that need no new configuration.

A parameter of the weather, of a true vibration, of the noise, the sensor gain or the delay
changes numbers of an ensemble. All others make another configuration: samples with the same
values of these are a group.
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
from lbt_synth.config.required_sections import convert_mas_to_nm
from lbt_synth.config.schema import SensorSection
from lbt_synth.loop import EnsembleVibration, LoopEnsemble
from lbt_synth.models import FrozenFlows, Vibration
from lbt_synth.studies.study.config_paths import Keys
from lbt_synth.studies.study.sample import Sample
from lbt_synth.studies.study.study import DELAY_ERROR, NOISE_FACTOR, Study
from lbt_synth.validation import BoolArray, FloatArray, IntArray

WEATHER = ("seeing_arcsec", "wind_speed_m_s", "outer_scale_m")
BELIEVED_GAIN = ("model", "sensor_gain")
BELIEVED_DELAY = ("loop", "delay_frames")
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
    """Values of some samples of one group, by the places that they are put to."""

    config: Config  # The configuration of one of the samples
    count: int  # Number of samples b
    places: dict[Keys, FloatArray]  # (b,): values at each place that varies
    errors: dict[str, FloatArray]  # (b,): values of the parameters that are in no configuration

    def take(self, which: IntArray) -> SampleArrays:
        """Return some of the samples."""
        return SampleArrays(
            config=self.config,
            count=which.size,
            places={keys: values[which] for keys, values in self.places.items()},
            errors={name: values[which] for name, values in self.errors.items()},
        )

    def number(self, *keys: str | int) -> FloatArray | None:
        """Values at a place, None if it does not vary."""
        return self.places.get(keys)

    def flows(self) -> FrozenFlows | None:
        """Frozen flows of the samples; None where the weather does not vary."""
        varying = {name: self.number("atmosphere", name) for name in WEATHER}
        varying = {name: values for name, values in varying.items() if values is not None}
        if not varying or self.config.atmosphere is None:
            return None
        return FrozenFlows(atmosphere=self.config.atmosphere, **varying)

    def believed_noise(self) -> FloatArray:
        """Noise that designs are told [nm], (b, 1) or (b, q)."""
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

    def believed_delay(self) -> FloatArray:
        """Delay that designs are told [frames], (b,)."""
        told = self.number(*BELIEVED_DELAY)
        return np.full(self.count, self.config.hardware.delay_frames) if told is None else told

    def real_delay(self) -> FloatArray:
        """Delay of the real loops [frames], (b,)."""
        return np.asarray(self.believed_delay() + self.errors.get(DELAY_ERROR, 0.0))

    def lines(self, owner: str, sections: Sequence[Any]) -> Iterator[tuple[dict[str, Any], str]]:
        """Yield numbers and directions of the vibrations of a list, with the section's key."""
        settings = self.config.settings
        for i, section in enumerate(sections):
            key = f"{owner}.vibrations[{i}]"
            given = {name: self.number(owner, "vibrations", i, name) for name in _VIBRATION_NUMBERS}
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
                    yield numbers, key
                    continue
                # nothing varies of vibrations where one of them is several
                whole = Vibration(**numbers)
                for line in spread_vibration(whole, section, self.config.hardware.frame_rate_hz, i):
                    yield {name: getattr(line, name) for name in numbers}, key

    def ensemble(self) -> LoopEnsemble:
        """Return what the real loops meet."""
        config, settings = self.config, self.config.settings
        gain = self.number(*_GAIN)
        flows = self.flows()
        truth, turbulence = config.truth, config.truth.turbulence
        if flows is not None and settings.true_turbulence == "frozen_flow":
            turbulence = flows
        return LoopEnsemble(
            sensor_gain=truth.sensor_gain if gain is None else gain / config.sensor_gain,
            delay_frames=self.real_delay(),
            noise_nm=self.believed_noise() * self._noise_factor(),
            turbulence=turbulence,
            vibrations=tuple(
                EnsembleVibration(**numbers) for numbers, _ in self.lines(*_true_vibrations(config))
            ),
            loops=self.count,
        )

    def valid(self) -> BoolArray:
        """Which samples have numbers that the configuration takes; the others are refused."""
        good = np.ones(self.count, dtype=np.bool_)
        nyquist = self.config.hardware.frame_rate_hz / 2
        for keys, values in self.places.items():
            if keys == BELIEVED_DELAY:
                good &= (values >= 1) & (values <= _LONGEST_DELAY)
            elif keys == ("sensor", "pyramid", "read_noise_electrons"):
                good &= values >= 0
            else:
                highest = {"frequency_hz": nyquist, "damping": 1.0}.get(str(keys[-1]), np.inf)
                good &= (values > 0) & (values < highest)
        real = self.real_delay()
        good &= (real >= 1) & (real <= _LONGEST_DELAY)
        return good & (self._noise_factor()[:, 0] >= 0)

    def _noise_factor(self) -> FloatArray:
        return np.broadcast_to(self.errors.get(NOISE_FACTOR, 1.0), (self.count,))[:, None]


def _true_vibrations(config: Config) -> tuple[str, Sequence[Any]]:
    """Return where the true vibrations stand, and their sections."""
    settings = config.settings
    if isinstance(settings.truth.vibrations, list):
        return "truth", settings.truth.vibrations
    return "model", settings.model.vibrations or ()


def changes_numbers_only(study: Study, keys: Keys) -> bool:
    """Whether a parameter at a place only changes numbers of what the loops meet."""
    settings = study.config.settings
    if keys in (_GAIN, BELIEVED_DELAY):
        return True  # a list has other places, such as truth.sensor_gain[0]
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


def changes_beliefs_only(study: Study, keys: Keys) -> bool:
    """Whether a parameter at a place changes what designs believe, and nothing else."""
    settings = study.config.settings
    if keys == BELIEVED_GAIN:
        # the real sensor is its matrix times truth.sensor_gain, whatever designs believe
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
    """Return the kinds of turbulence that designs believe in."""
    given = config.settings.model.turbulence
    return {section.kind for section in (given if isinstance(given, list) else [given])}


def make_sample_arrays(study: Study, sample: Sample, values: FloatArray) -> SampleArrays:
    """Return the values of the samples of a group, of which one is given whole."""
    places: dict[Keys, FloatArray] = {}
    errors: dict[str, FloatArray] = {}
    for parameter, column in zip(study.parameters, values.T, strict=True):
        if parameter.name in (DELAY_ERROR, NOISE_FACTOR):
            errors[parameter.name] = column
        for keys in parameter.places:
            places[keys] = column
    return SampleArrays(config=sample.config, count=len(values), places=places, errors=errors)
