"""Design the Kalman filters of many samples at once, each for its own sample."""

from __future__ import annotations

import numpy as np

from lbt_synth.config import Config
from lbt_synth.config.plant_and_truth import assumed_gains
from lbt_synth.config.schema import Ar1Section
from lbt_synth.design.modal import ModalFilters, modal_filters
from lbt_synth.models import ModalTurbulence, Vibration
from lbt_synth.models.turbulence.ar_models import ar1_flows
from lbt_synth.studies.study.config_keys import Keys
from lbt_synth.studies.study.sample_arrays import (
    ASSUMED_GAIN,
    WEATHER,
    SampleArrays,
    is_vibration_number,
    turbulence_kinds,
)
from lbt_synth.studies.study.study import Study, StudyController
from lbt_synth.validation import FloatArray

Matrices = tuple[FloatArray, ...]


def is_kalman_for_sample(controller: StudyController) -> bool:
    """Whether a controller is a Kalman filter without options, designed for each sample."""
    request = controller.request
    return (
        request is not None
        and controller.design is None
        and request.method == "kalman"
        and not request.options
    )


def has_independent_axes(config: Config) -> bool:
    """Whether the Kalman filter of a configuration separates into one per axis."""
    hardware, settings = config.hardware, config.settings
    diagonal = all(
        matrix.shape[0] == matrix.shape[1] and not np.any(matrix - np.diag(np.diag(matrix)))
        for matrix in (hardware.sensor, hardware.influence)
    )
    sections = settings.model.vibrations or ()
    aligned = all(np.count_nonzero(line.direction) == 1 for line in config.plant.vibrations)
    plain = all(section.spread_hz is None for section in sections)
    unit = np.array_equal(hardware.influence, np.eye(hardware.modes))
    return diagonal and unit and aligned and plain and settings.sensor.matrix is None


def changes_design_numbers_only(study: Study, keys: Keys) -> bool:
    """Whether a parameter at a place only changes numbers of the designs."""
    kinds = turbulence_kinds(study.config)
    if keys[0] == "atmosphere":
        return keys[1] in WEATHER and "ar2" not in kinds
    if keys[0] == "sensor":
        return "ar2" not in kinds
    return keys[0] == "truth" or keys == ASSUMED_GAIN or is_vibration_number(keys, "model")


def design_for_samples(arrays: SampleArrays) -> Matrices:
    """Design a Kalman filter for each sample, and return their textbook matrices."""
    config, count = arrays.config, arrays.count
    hardware = config.hardware
    axes = hardware.modes
    noise = np.broadcast_to(arrays.assumed_noise(), (count, axes))
    gains = _assumed_gains(arrays)
    numbers = _vibrations_by_axis(arrays)
    designs: list[ModalFilters] = []
    for axis in range(axes):
        if axis > 0 and _is_like_first_axis(arrays, numbers, noise, gains, axis):
            designs.append(designs[0])
            continue
        lines = {
            i: [Vibration(frequency_hz=f, damping=d, rms_nm=r, direction=(1.0,)) for f, d, r in row]
            for i, row in enumerate(np.moveaxis(numbers[axis], 1, 0).tolist())
            if row
        }
        designs.append(
            modal_filters(
                _turbulence(arrays, axis),
                noise_nm=noise[:, axis],
                vibrations=lines,
                delay_frames=hardware.delay_frames,
                sensor_gain=gains[:, axis],
                mirror=hardware.mirror,
            )
        )
    return _combine_axes(designs)


def _assumed_gains(arrays: SampleArrays) -> FloatArray:
    """Return the sensor gain that designs assume, (b, axes)."""
    given = arrays.values_at(*ASSUMED_GAIN)
    each = assumed_gains(arrays.config.settings) if given is None else given[:, None]
    return np.broadcast_to(each, (arrays.count, arrays.config.hardware.modes))


def _vibrations_by_axis(arrays: SampleArrays) -> list[FloatArray]:
    """Return frequency, damping and rms of the assumed vibrations, (lines, b, 3) per axis."""
    axes = arrays.config.hardware.modes
    found: list[list[FloatArray]] = [[] for _ in range(axes)]
    sections = arrays.config.settings.model.vibrations or ()
    for numbers in arrays.vibrations("model", sections):
        axis = int(np.argmax(np.abs(numbers["direction"])))
        each = [numbers[name] for name in ("frequency_hz", "damping", "rms_nm")]
        found[axis].append(np.stack([np.broadcast_to(v, (arrays.count,)) for v in each], axis=1))
    return [np.array(lines).reshape(len(lines), arrays.count, 3) for lines in found]


def _is_like_first_axis(
    arrays: SampleArrays, numbers: list[FloatArray], noise: FloatArray, gains: FloatArray, axis: int
) -> bool:
    """Whether an axis has the same design as the first."""
    settings = arrays.config.settings
    return (
        not isinstance(settings.model.turbulence, list)
        and numbers[axis].shape == numbers[0].shape
        and np.array_equal(numbers[axis], numbers[0])
        and np.array_equal(noise[:, axis], noise[:, 0])
        and np.array_equal(gains[:, axis], gains[:, 0])
    )


def _turbulence(arrays: SampleArrays, axis: int) -> ModalTurbulence:
    """Return the turbulence that designs assume on one axis, one process per sample."""
    config = arrays.config
    given = config.settings.model.turbulence
    section = given[axis] if isinstance(given, list) else given
    rate = config.hardware.frame_rate_hz
    flows = arrays.frozen_flows()
    if isinstance(section, Ar1Section) and flows is not None:
        coefficients, driving = ar1_flows(flows, frame_rate_hz=rate)
        return ModalTurbulence(
            coefficients=coefficients, driving_rms_nm=driving, frame_rate_hz=rate
        )
    model = config.plant.turbulence[axis]
    return ModalTurbulence(
        coefficients=np.tile(model.coefficients, (arrays.count, 1)),
        driving_rms_nm=np.full(arrays.count, model.driving_rms_nm),
        frame_rate_hz=rate,
    )


def _combine_axes(designs: list[ModalFilters]) -> Matrices:
    """Combine the controllers of all axes into one, in textbook form."""
    sizes = [design.A.shape[1] for design in designs]
    count, axes, states = len(designs[0].A), len(designs), sum(sizes)
    A, B = np.zeros((count, states, states)), np.zeros((count, states, axes))
    C, D = np.zeros((count, axes, states)), np.zeros((count, axes, axes))
    start = 0
    for axis, (design, size) in enumerate(zip(designs, sizes, strict=True)):
        x = slice(start, start + size)
        A[:, x, x], B[:, x, axis] = design.A, design.B[..., 0]
        C[:, axis, x] = (design.C @ design.A)[:, 0]
        D[:, axis, axis] = (design.C @ design.B + design.D)[:, 0, 0]
        start += size
    return A, B, C, D
