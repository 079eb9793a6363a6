"""Design the Kalman filters of many samples at once, each for its own sample."""

from __future__ import annotations

import numpy as np

from lbt_synth.config import Config
from lbt_synth.config.ensemble import AssumedAxis, Samples, assumed_axes
from lbt_synth.design.modal import ModalFilters, modal_filters
from lbt_synth.models import PositionLoop, Vibration
from lbt_synth.studies.study.study import StudyController
from lbt_synth.validation import FloatArray


def is_kalman_for_sample(controller: StudyController) -> bool:
    """Whether a controller is a Kalman filter without options, designed for each sample."""
    request = controller.request
    return (
        request is not None
        and controller.design is None
        and request.method.batched
        and not request.given
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


def design_for_samples(samples: Samples) -> tuple[FloatArray, ...]:
    """Design a Kalman filter for each sample, and return their textbook matrices."""
    first, *others = assumed_axes(samples)
    mirror = samples.config.hardware.mirror
    design = _design_axis(first, mirror)
    same = (design if axis.equals(first) else _design_axis(axis, mirror) for axis in others)
    return _combine_axes([design, *same])


def _design_axis(axis: AssumedAxis, mirror: PositionLoop | None) -> ModalFilters:
    """Design the Kalman filters of one axis, one per sample."""
    return modal_filters(
        axis.turbulence,
        noise_nm=axis.noise_nm,
        vibrations={
            i: [Vibration(frequency_hz=f, damping=d, rms_nm=r, direction=(1.0,)) for f, d, r in row]
            for i, row in enumerate(axis.vibrations.tolist())
            if row
        },
        delay_frames=axis.delay_frames,
        sensor_gain=axis.sensor_gain,
        mirror=mirror,
    )


def _combine_axes(designs: list[ModalFilters]) -> tuple[FloatArray, ...]:
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
