"""Kalman filters of many samples at once, each told its own sample."""

from __future__ import annotations

import numpy as np

from lbt_synth.config import Config
from lbt_synth.config.plant_and_truth import assumed_gains
from lbt_synth.config.schema import Ar1Section
from lbt_synth.design.modal import ModalFilters, modal_filters
from lbt_synth.models import ARModel, ModalTurbulence, Vibration
from lbt_synth.models.turbulence.ar_models import ar1_flows
from lbt_synth.studies.study.config_paths import Keys
from lbt_synth.studies.study.sample_arrays import (
    BELIEVED_GAIN,
    WEATHER,
    SampleArrays,
    is_vibration_number,
    turbulence_kinds,
)
from lbt_synth.studies.study.study import Study, StudyController
from lbt_synth.validation import FloatArray

Matrices = tuple[FloatArray, ...]


def is_kalman_for_sample(controller: StudyController) -> bool:
    """Whether a controller is a Kalman filter that is designed for each sample."""
    request = controller.request
    if request is None or controller.design is not None:
        return False
    return request.method == "kalman" and not request.options


def has_independent_axes(config: Config) -> bool:
    """Whether the Kalman filter of a configuration is one of each axis by itself."""
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
    """Whether a parameter at a place only changes numbers of the designs of axes."""
    kinds = turbulence_kinds(study.config)
    if keys[0] == "atmosphere":
        return keys[1] in WEATHER and "ar2" not in kinds
    if keys[0] == "sensor":
        return "ar2" not in kinds
    return keys[0] == "truth" or keys == BELIEVED_GAIN or is_vibration_number(keys, "model")


def design_for_samples(rows: SampleArrays) -> Matrices:
    """Design a Kalman filter for each sample and axis."""
    config, count = rows.config, rows.count
    hardware = config.hardware
    axes = hardware.modes
    noise = np.broadcast_to(rows.believed_noise(), (count, axes))
    gains = _believed_gains(rows)
    numbers = _vibrations_by_axis(rows)
    designs: list[ModalFilters] = []
    for axis in range(axes):
        same = axis > 0 and _is_like_first_axis(rows, numbers, noise, gains, axis)
        if same:
            designs.append(designs[0])
            continue
        lines = {
            i: [Vibration(frequency_hz=f, damping=d, rms_nm=r, direction=(1.0,)) for f, d, r in row]
            for i, row in enumerate(np.moveaxis(numbers[axis], 1, 0).tolist())
            if row
        }
        designs.append(
            modal_filters(
                _turbulence(rows, axis),
                noise_nm=noise[:, axis],
                vibrations=lines,
                delay_frames=hardware.delay_frames,
                sensor_gain=gains[:, axis],
                mirror=hardware.mirror,
            )
        )
    return _combine_axes(designs)


def _believed_gains(rows: SampleArrays) -> FloatArray:
    """Sensor gain of each axis that designs believe in, (b, axes)."""
    given = rows.number(*BELIEVED_GAIN)
    each = assumed_gains(rows.config.settings) if given is None else given[:, None]
    return np.broadcast_to(each, (rows.count, rows.config.hardware.modes))


def _vibrations_by_axis(rows: SampleArrays) -> list[FloatArray]:
    """Frequency, damping and rms of the vibrations of each axis that designs believe in.

    One array (lines, b, 3) an axis.
    """
    axes = rows.config.hardware.modes
    found: list[list[FloatArray]] = [[] for _ in range(axes)]
    sections = rows.config.settings.model.vibrations or ()
    for numbers, _ in rows.lines("model", sections):
        axis = int(np.argmax(np.abs(numbers["direction"])))
        each = [numbers[name] for name in ("frequency_hz", "damping", "rms_nm")]
        found[axis].append(np.stack([np.broadcast_to(v, (rows.count,)) for v in each], axis=1))
    return [np.array(lines).reshape(len(lines), rows.count, 3) for lines in found]


def _is_like_first_axis(
    rows: SampleArrays, numbers: list[FloatArray], noise: FloatArray, gains: FloatArray, axis: int
) -> bool:
    """Whether an axis is designed for the same as the first."""
    settings = rows.config.settings
    return (
        not isinstance(settings.model.turbulence, list)
        and numbers[axis].shape == numbers[0].shape
        and np.array_equal(numbers[axis], numbers[0])
        and np.array_equal(noise[:, axis], noise[:, 0])
        and np.array_equal(gains[:, axis], gains[:, 0])
    )


def _turbulence(rows: SampleArrays, axis: int) -> ModalTurbulence:
    """Turbulence of one axis that designs believe in, one process a sample."""
    config: Config = rows.config
    given = config.settings.model.turbulence
    section = given[axis] if isinstance(given, list) else given
    rate = config.hardware.frame_rate_hz
    flows = rows.flows()
    if isinstance(section, Ar1Section) and flows is not None:
        coefficients, driving = ar1_flows(flows, frame_rate_hz=rate)
        return ModalTurbulence(
            coefficients=coefficients, driving_rms_nm=driving, frame_rate_hz=rate
        )
    model: ARModel = config.plant.turbulence[axis]
    return ModalTurbulence(
        coefficients=np.tile(model.coefficients, (rows.count, 1)),
        driving_rms_nm=np.full(rows.count, model.driving_rms_nm),
        frame_rate_hz=rate,
    )


def _combine_axes(designs: list[ModalFilters]) -> Matrices:
    """Put the controllers of all axes into one, in textbook form."""
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
