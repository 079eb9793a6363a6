"""Build the real loops of many samples of a configuration, and what designs assume of each."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lbt_synth.config.load import Config, build_config
from lbt_synth.config.plant_and_truth import (
    WEATHER,
    assumed_gains,
    measurement_noise_nm,
    relative_gain,
    require_one_model_turbulence,
    spread_vibration,
    true_vibrations_owner,
    turbulence_sections,
    vibration_numbers,
)
from lbt_synth.config.samples import Keys, Reads, accepted_by_schema, view_samples
from lbt_synth.config.schema import Ar1Section, FileSection
from lbt_synth.errors import LbtSynthError
from lbt_synth.loop import EnsembleVibration, LoopEnsemble
from lbt_synth.models import ARModel, FrozenFlows, ModalTurbulence, Vibration
from lbt_synth.models.turbulence.ar_models import ar1_flows
from lbt_synth.validation import FloatArray, IntArray

# errors that refuse a sample; LinAlgError is a ValueError
EXPECTED_ERRORS = (LbtSynthError, ArithmeticError, ValueError)
_VIBRATION = ("frequency_hz", "damping", "rms_nm")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Samples:
    """b samples whose configurations differ by numbers that the builders take as arrays."""

    config: Config  # of one of them
    values: dict[Keys, FloatArray]  # the numbers that differ, (b,) each
    delay_error_frames: FloatArray  # real delay less that of the configuration, (b,)
    noise_factor: FloatArray  # real noise over that of the configuration, (b,)
    reads: Reads = field(default_factory=Reads)  # what the builders have read of them

    @property
    def count(self) -> int:
        """Their number b."""
        return len(self.noise_factor)

    @property
    def settings(self) -> FileSection:
        """Their settings, with arrays for the numbers that differ."""
        return view_samples(self.config.settings, self.reads, self.values)

    def take(self, rows: IntArray) -> Samples:
        """Return some of the samples."""
        return replace(
            self,
            values={keys: values[rows] for keys, values in self.values.items()},
            delay_error_frames=self.delay_error_frames[rows],
            noise_factor=self.noise_factor[rows],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AssumedAxis:
    """What a design assumes of one axis in each of b samples."""

    delay_frames: float  # the same for all
    turbulence: ModalTurbulence  # a process per sample
    noise_nm: FloatArray  # (b,)
    sensor_gain: FloatArray  # (b,)
    vibrations: FloatArray  # frequency, damping and rms of each, (b, vibrations, 3)

    def equals(self, other: AssumedAxis) -> bool:
        """Whether all numbers are the same."""
        pairs = (
            (self.turbulence.coefficients, other.turbulence.coefficients),
            (self.turbulence.driving_rms_nm, other.turbulence.driving_rms_nm),
            (self.noise_nm, other.noise_nm),
            (self.sensor_gain, other.sensor_gain),
            (self.vibrations, other.vibrations),
        )
        return all(np.array_equal(first, second) for first, second in pairs)


def read_config(config: Config, *, designs: bool = False) -> Reads:
    """Return what the builders read of a configuration, with those of :func:`assumed_axes`."""
    one = np.zeros(1)
    found = Samples(config=config, values={}, delay_error_frames=one, noise_factor=one)
    build_config(found.settings, config.source)
    if designs and config.settings.sensor.matrix is None:
        assumed_axes(found)
    return found.reads


def build_ensemble(samples: Samples) -> LoopEnsemble:
    """Build the ensemble of the real loops."""
    config, settings = samples.config, samples.settings
    delay = settings.loop.per_sample.delay_frames + samples.delay_error_frames
    for extreme in (np.min(delay), np.max(delay)):
        replace(config.hardware, delay_frames=float(extreme))  # refuses what no loop has
    flows = _frozen_flows(samples) if settings.true_turbulence == "frozen_flow" else None
    owner, vibrations = true_vibrations_owner(settings), list[EnsembleVibration]()
    for section, key, numbers in vibration_numbers(settings, owner):
        if getattr(section, "spread_hz", None) is None:
            vibrations.append(EnsembleVibration(**numbers))
            continue
        whole, rate = Vibration(**numbers), config.hardware.frame_rate_hz
        vibrations += [
            EnsembleVibration(direction=line.direction, **{n: getattr(line, n) for n in _VIBRATION})
            for line in spread_vibration(whole, section, rate, key)
        ]
    return LoopEnsemble(
        sensor_gain=relative_gain(settings, config.sensor_gain),
        delay_frames=delay,
        noise_nm=_assumed_noise(samples) * samples.noise_factor[:, None],
        turbulence=config.truth.turbulence if flows is None else flows,
        vibrations=tuple(vibrations),
        loops=samples.count,
    )


def assumed_axes(samples: Samples) -> list[AssumedAxis]:
    """Return what designs assume of each axis, of a configuration with independent axes."""
    config, settings, count = samples.config, samples.settings, samples.count
    require_one_model_turbulence(settings, but_flows=True)
    axes = config.hardware.modes
    noise = np.broadcast_to(_assumed_noise(samples), (count, axes))
    gains = np.broadcast_to(assumed_gains(settings), (count, axes))
    lines: list[list[FloatArray]] = [[] for _ in range(axes)]
    for _, _, numbers in vibration_numbers(settings, "model"):
        each = [np.broadcast_to(numbers[name], (count,)) for name in _VIBRATION]
        lines[int(np.argmax(np.abs(numbers["direction"])))].append(np.stack(each, axis=1))
    flows, models = _frozen_flows(samples), config.plant.turbulence
    return [
        AssumedAxis(
            delay_frames=settings.loop.delay_frames,
            turbulence=_modal_turbulence(
                models[axis], flows if isinstance(section, Ar1Section) else None, count
            ),
            noise_nm=noise[:, axis],
            sensor_gain=gains[:, axis],
            vibrations=np.stack(lines[axis], axis=1) if lines[axis] else np.empty((count, 0, 3)),
        )
        for axis, section in enumerate(turbulence_sections(settings))
    ]


def accepted_samples(samples: Samples) -> IntArray:
    """Return the indices of the samples whose numbers schema and builders accept."""
    accepted = np.ones(samples.count, dtype=np.bool_)
    for keys, values in samples.values.items():
        accepted &= accepted_by_schema(samples.config.settings, keys, values)
    return _accepted_by_builders(samples, np.flatnonzero(accepted))


def _accepted_by_builders(samples: Samples, rows: IntArray) -> IntArray:
    """Return the rows that the builders accept, by halving those that they refuse together."""
    if not rows.size:
        return rows
    some = samples.take(rows)
    try:
        build_ensemble(some)
        list(vibration_numbers(some.settings, "model"))  # a configuration checks them, too
    except EXPECTED_ERRORS:
        if rows.size == 1:
            return rows[:0]
        halves = np.array_split(rows, 2)
        return np.concatenate([_accepted_by_builders(samples, half) for half in halves])
    return rows


def _assumed_noise(samples: Samples) -> FloatArray:
    """Return the noise that designs assume [nm], (b, 1) or (b, q)."""
    noise = np.asarray(measurement_noise_nm(samples.settings))
    if not isinstance(samples.settings.sensor.per_sample.noise_nm, list):
        noise = noise[..., None]
    return np.broadcast_to(noise, (samples.count, noise.shape[-1]))


def _frozen_flows(samples: Samples) -> FrozenFlows | None:
    """Return the frozen flows of the samples, None if the weather does not differ."""
    air, atmosphere = samples.settings.atmosphere, samples.config.atmosphere
    if air is None or atmosphere is None:
        return None
    weather = {name: getattr(air.per_sample, name) for name in WEATHER}
    differing = {name: values for name, values in weather.items() if np.ndim(values)}
    return FrozenFlows(atmosphere=atmosphere, **differing) if differing else None


def _modal_turbulence(model: ARModel, flows: FrozenFlows | None, count: int) -> ModalTurbulence:
    """Return the models of kind ar1 of frozen flows, or the same model for each sample."""
    if flows is None:
        coefficients = np.tile(model.coefficients, (count, 1))
        driving = np.full(count, model.driving_rms_nm)
    else:
        coefficients, driving = ar1_flows(flows, frame_rate_hz=model.frame_rate_hz)
    return ModalTurbulence(
        coefficients=coefficients, driving_rms_nm=driving, frame_rate_hz=model.frame_rate_hz
    )
