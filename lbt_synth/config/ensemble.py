"""Build the real loops of many samples of a configuration, and what designs assume of each."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import cast

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
from lbt_synth.config.samples import Keys, Reads, SampleView, accepted_by_schema
from lbt_synth.config.schema import Ar1Section, FileSection
from lbt_synth.errors import LbtSynthError
from lbt_synth.linear import solve_dare
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.loop import EnsembleVibration, LoopEnsemble
from lbt_synth.loop.ensemble import ensemble_vibration
from lbt_synth.models import FrozenFlows, TipTiltPlant, Vibration, tip_tilt_plant
from lbt_synth.models.plant.readings import known_states
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
        return cast(FileSection, SampleView(self.config.settings, self.reads, self.values))

    def take(self, rows: IntArray) -> Samples:
        """Return some of the samples."""
        return replace(
            self,
            values={keys: values[rows] for keys, values in self.values.items()},
            delay_error_frames=self.delay_error_frames[rows],
            noise_factor=self.noise_factor[rows],
        )


def read_config(config: Config, *, designs: bool = False) -> Reads:
    """Return what the builders read of a configuration, with those of designs for samples."""
    one = np.zeros(1)
    found = Samples(config=config, values={}, delay_error_frames=one, noise_factor=one)
    build_config(found.settings, config.source)
    if designs and config.settings.sensor.matrix is None:
        _assumed_plants(found)
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
        vibrations += map(ensemble_vibration, spread_vibration(whole, section, rate, key))
    return LoopEnsemble(
        sensor_gain=relative_gain(settings, config.sensor_gain),
        delay_frames=delay,
        noise_nm=_assumed_noise(samples) * samples.noise_factor[:, None],
        turbulence=config.truth.turbulence if flows is None else flows,
        vibrations=tuple(vibrations),
        loops=samples.count,
    )


def has_independent_axes(config: Config) -> bool:
    """Whether the Kalman filter of a configuration separates into one per axis."""
    hardware, settings = config.hardware, config.settings
    return (
        settings.sensor.matrix is None
        and np.array_equal(hardware.influence, np.eye(hardware.modes))
        and all(np.count_nonzero(line.direction) == 1 for line in config.plant.vibrations)
        and all(section.spread_hz is None for section in settings.model.vibrations or ())
    )


def kalman_matrices(samples: Samples) -> tuple[FloatArray, ...]:
    """Design a Kalman filter for each sample of independent axes; A, B, C, D in textbook form.

    The equations of all samples are solved at once, those of equal axes once.
    """
    assumed = _assumed_plants(samples)
    distinct = {id(plants): plants for plants in assumed}
    designs = {key: _axis_matrices(plants) for key, plants in distinct.items()}
    axes = [designs[id(plants)] for plants in assumed]
    ends = np.cumsum([0, *(A.shape[-1] for A, *_ in axes)])
    A = np.zeros((samples.count, ends[-1], ends[-1]))
    B, C = np.zeros((samples.count, ends[-1], len(axes))), np.zeros_like(A[:, : len(axes)])
    D = np.zeros((samples.count, len(axes), len(axes)))
    for axis, (a, b, c) in enumerate(axes):
        x = slice(*ends[axis : axis + 2])
        A[:, x, x], B[:, x, axis], C[:, axis, x] = a, b[..., 0], (c @ a)[:, 0]
        D[:, axis, axis] = (c @ b)[:, 0, 0]
    return A, B, C, D


def _axis_matrices(plants: list[TipTiltPlant]) -> tuple[FloatArray, ...]:
    """Return A, B and C of the filters of one axis, as :meth:`TipTiltPlant.controller` has them."""
    A, C, L, Q, R = (np.stack([getattr(plant, name) for plant in plants]) for name in "ACLQR")
    gains = transpose(solve_dare(transpose(A), transpose(C), Q, R).gain_feedback)
    sensor = np.stack([plant.hardware.sensor for plant in plants])
    unit = replace(plants[0].hardware, sensor_matrix=None)
    (A_known,), (B_known,), C_known, D_known = known_states(unit)
    count, n, past = *gains.shape[:2], len(A_known)
    whole, zeros = np.zeros((count, n + past, n + past)), np.zeros((count, past, 1))
    whole[:, :n, :n], whole[:, n:, n:] = A, A_known
    entry = np.concatenate([gains, zeros], axis=1)
    estimate = np.concatenate([L, transpose(zeros)], axis=2)
    applied = np.vstack([np.zeros((n, 1)), B_known]) - entry @ (sensor * D_known)
    seen = np.concatenate([C, sensor * C_known], axis=2)
    return whole - entry @ seen + applied @ estimate, entry, estimate


def _assumed_plants(samples: Samples) -> list[list[TipTiltPlant]]:
    """Return the plants that designs assume of each axis, one per sample; equal axes share them."""
    config, settings, count = samples.config, samples.settings, samples.count
    require_one_model_turbulence(settings, but_flows=True)
    axes = config.hardware.modes
    noise = np.broadcast_to(_assumed_noise(samples), (count, axes))
    gains = np.broadcast_to(assumed_gains(settings), (count, axes))
    lines: list[list[FloatArray]] = [[] for _ in range(axes)]
    for _, _, numbers in vibration_numbers(settings, "model"):
        each = [np.broadcast_to(numbers[name], (count,)) for name in _VIBRATION]
        lines[int(np.argmax(np.abs(numbers["direction"])))].append(np.stack(each, axis=1))
    flows, keys = _frozen_flows(samples), []
    plants: dict[tuple[bytes, ...], list[TipTiltPlant]] = {}
    for axis, section in enumerate(turbulence_sections(settings)):
        model = config.plant.turbulence[axis]
        coefficients = np.tile(model.coefficients, (count, 1))
        driving = np.full(count, model.driving_rms_nm)
        if flows is not None and isinstance(section, Ar1Section):
            coefficients, driving = ar1_flows(flows, frame_rate_hz=model.frame_rate_hz)
        shakes = np.stack(lines[axis], axis=1) if lines[axis] else np.empty((count, 0, 3))
        arrays = (coefficients, driving, noise[:, axis], gains[:, axis], shakes)
        keys.append(tuple(array.tobytes() for array in arrays))
        plants[keys[-1]] = plants.get(keys[-1]) or [
            tip_tilt_plant(
                frame_rate_hz=model.frame_rate_hz,
                turbulence=replace(model, coefficients=coefficients[i], driving_rms_nm=driving[i]),
                noise_nm=noise[i, axis],
                vibrations=[
                    Vibration(frequency_hz=f, damping=d, rms_nm=r, direction=(1.0,))
                    for f, d, r in shakes[i].tolist()
                ]
                or None,
                delay_frames=settings.loop.delay_frames,
                sensor_gain=gains[i, axis],
                modes=1,
                mirror=config.hardware.mirror,
            )
            for i in range(count)
        ]
    return [plants[key] for key in keys]


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
