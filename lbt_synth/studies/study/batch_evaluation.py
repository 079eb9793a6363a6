"""Evaluate many samples of a study at once, and one by one where that is not possible."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from lbt_synth.config import Config, ensemble
from lbt_synth.config.ensemble import AssumedAxis, Samples
from lbt_synth.config.samples import Reads
from lbt_synth.errors import CertificateError
from lbt_synth.linear import solve_dare
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.loop.ensemble.evaluation import (
    EnsembleResiduals,
    residuals_from_matrices,
    textbook_matrices,
)
from lbt_synth.models import PositionLoop, Vibration, tip_tilt_plant
from lbt_synth.models.plant.readings import known_states
from lbt_synth.studies.study import sample as reference
from lbt_synth.studies.study.sample import Sample, make_sample
from lbt_synth.studies.study.study import (
    DELAY_ERROR,
    EXACT_COLUMNS,
    NOISE_FACTOR,
    RESIDUALS,
    BatchResult,
    Study,
    StudyController,
)
from lbt_synth.validation import FloatArray, IntArray

_AGREEMENT = 1e-5  # relative, of a sample evaluated both ways; below 1 absolute
_FEWEST = 4  # samples in a group that is worth an ensemble


def evaluate_samples(study: Study, values: FloatArray, start: int) -> BatchResult:
    """Evaluate consecutive samples.

    Samples whose configurations differ by numbers that its builders take as arrays are evaluated
    together by :func:`ensemble_residuals`; the equations of Kalman filters for samples are solved
    together. Other designs, simulations, and samples that the configuration refuses
    are evaluated one by one. So is one sample of each group that is evaluated together, and the
    two answers must agree.

    Parameters
    ----------
    study : Study
        The study.
    values : (b, parameters) ndarray
        Rows of ``Study.values``.
    start : int
        Number of the first sample.

    Returns
    -------
    BatchResult
        Each of ``study.result_columns`` for each sample. A controller without a result is among
        the failures and has nan; an unstable loop has ``stable`` 0 and nan otherwise.

    Raises
    ------
    CertificateError
        If a sample that is evaluated both ways has two answers.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> study = lbt.studies.load_study("examples/study.yaml")
    >>> batch = lbt.studies.evaluate_samples(study, study.values(0, 2), 0)
    >>> batch.columns["kalman.strehl"].round(3).tolist(), batch.columns["kalman.stable"].tolist()
    ([0.837, 0.821], [1.0, 1.0])
    """
    together: dict[str, FloatArray] = {}  # results of ensembles, by column
    left: dict[int, list[StudyController]] = {}  # what to evaluate one by one, by sample
    for controller in study.controllers:
        found = {name: np.full(len(values), np.nan) for name in EXACT_COLUMNS}
        for rows, residuals, strehl in _evaluate_groups(study, controller, values):
            found["strehl"][rows] = strehl
            for name, part in {**RESIDUALS, "stable": "stable"}.items():
                found[name][rows] = getattr(residuals, part)
            i = int(rows[rows.size // 2])
            numbers = {name: float(column[i]) for name, column in found.items()}
            _require_agreement(study, controller, values[i], start + i, numbers)
        for i in np.flatnonzero(np.isnan(found["stable"])).tolist():
            left.setdefault(i, []).append(controller)
        together |= {f"{controller.name}.{name}": column for name, column in found.items()}
    batch = reference.evaluate_rows(study, values, start, left=left)
    for name, column in batch.columns.items():
        np.copyto(column, together[name], where=~np.isnan(together[name]))
    return batch


def are_evaluated_together(study: Study, controller: StudyController) -> bool:
    """Whether many samples of a controller can be evaluated at once."""
    if study.settings.evaluation != "exact":
        return False
    if controller.design is None:
        alone = not study.config.hardware.suite.sensors
        return _is_kalman_for_sample(controller) and alone
    return not controller.design.other_sensors


def _evaluate_groups(
    study: Study, controller: StudyController, values: FloatArray
) -> Iterator[tuple[IntArray, EnsembleResiduals, FloatArray]]:
    """Yield what could be evaluated together: rows, residuals, Strehl ratios."""
    if not are_evaluated_together(study, controller):
        return
    design = controller.design
    for_sample = design is None
    matrices = None if design is None else textbook_matrices([design.controller])
    reads = ensemble.read_config(study.config, designs=for_sample)
    for rows in _find_groups(study, values, reads):
        try:
            sample = make_sample(study, values[rows[0]])
            if for_sample and not _has_independent_axes(sample.config):
                continue
            samples = _stack_samples(study, sample, values[rows], reads)
            accepted = ensemble.accepted_samples(samples)
            if not accepted.size:
                continue
            samples = samples.take(accepted)
            with np.errstate(over="raise", divide="raise", invalid="raise"):
                own = _design_for_samples(samples) if matrices is None else matrices
                found = residuals_from_matrices(
                    own, sample.hardware, ensemble.build_ensemble(samples), in_image=True
                )
            strehl = found.strehl(sample.config.imaging)
        except ensemble.EXPECTED_ERRORS:
            continue  # one of them fails; evaluating them one by one finds which
        yield rows[accepted], found, strehl


def _find_groups(study: Study, values: FloatArray, reads: Reads) -> Iterator[IntArray]:
    """Yield the indices of samples that differ by numbers that builders take as arrays only."""
    apart = [
        i
        for i, parameter in enumerate(study.parameters)
        if not all(map(reads.take_arrays_at, parameter.places))
    ]
    _, which, counts = np.unique(values[:, apart], axis=0, return_inverse=True, return_counts=True)
    for group in np.flatnonzero(counts >= min(_FEWEST, len(values))):
        yield np.flatnonzero(which.reshape(-1) == group)


def _stack_samples(study: Study, sample: Sample, values: FloatArray, reads: Reads) -> Samples:
    """Return the samples of a group of rows of ``Study.values``; one of them is given."""
    by_name = dict(zip(study.parameter_names, values.T, strict=True))
    return Samples(
        config=sample.config,
        values={
            keys: by_name[parameter.name]
            for parameter in study.parameters
            for keys in parameter.places
            if reads.take_arrays_at(keys)
        },
        delay_error_frames=by_name.get(DELAY_ERROR, np.zeros(len(values))),
        noise_factor=by_name.get(NOISE_FACTOR, np.ones(len(values))),
    )


def _require_agreement(
    study: Study,
    controller: StudyController,
    values: FloatArray,
    row: int,
    found: Mapping[str, float],
) -> None:
    """Refuse a batch in which a sample differs from its evaluation by itself."""
    alone = replace(study, controllers=(controller,))
    single, failed = reference.evaluate_row(alone, values, row)
    fault = "This is a fault of the program; please report it with the study file."
    if failed:
        raise CertificateError(
            f"row {row} has a result among others, and fails by itself: {failed[0].error} {fault}"
        )
    for name, expected in single.items():
        among = found[name.removeprefix(f"{controller.name}.")]
        if not abs(among - expected) <= _AGREEMENT * max(abs(expected), 1.0):
            raise CertificateError(
                f"row {row} has {name} {among:.9g} among others, and {expected:.9g} by itself: one "
                f"of the two is wrong. {fault}"
            )


def _is_kalman_for_sample(controller: StudyController) -> bool:
    """Whether a controller is a Kalman filter without options, designed for each sample."""
    if (request := controller.request) is None or not controller.for_sample:
        return False
    return request.method.batched and not request.given


def _has_independent_axes(config: Config) -> bool:
    """Whether the Kalman filter of a configuration separates into one per axis."""
    hardware, settings = config.hardware, config.settings
    return (
        settings.sensor.matrix is None
        and np.array_equal(hardware.influence, np.eye(hardware.modes))
        and all(np.count_nonzero(line.direction) == 1 for line in config.plant.vibrations)
        and all(section.spread_hz is None for section in settings.model.vibrations or ())
    )


def _design_for_samples(samples: Samples) -> tuple[FloatArray, ...]:
    """Design a Kalman filter for each sample, and return their textbook matrices."""
    first, *others = ensemble.assumed_axes(samples)
    mirror = samples.config.hardware.mirror
    design = _design_axis(first, mirror)
    same = (design if axis.equals(first) else _design_axis(axis, mirror) for axis in others)
    return _combine_axes([design, *same])


def _design_axis(axis: AssumedAxis, mirror: PositionLoop | None) -> tuple[FloatArray, ...]:
    """Design the Kalman filters of one axis, one per sample; their equations are solved at once.

    Return the matrices A, B and C of all controllers, as :meth:`TipTiltPlant.controller` has them.
    """
    plants = [
        tip_tilt_plant(
            frame_rate_hz=axis.turbulence.frame_rate_hz,
            turbulence=axis.turbulence.model(i),
            noise_nm=axis.noise_nm[i],
            vibrations=[
                Vibration(frequency_hz=f, damping=d, rms_nm=r, direction=(1.0,))
                for f, d, r in axis.vibrations[i].tolist()
            ]
            or None,
            delay_frames=axis.delay_frames,
            sensor_gain=axis.sensor_gain[i],
            modes=1,
            mirror=mirror,
        )
        for i in range(len(axis.noise_nm))
    ]
    A, C, L, Q, R = (np.stack([getattr(plant, name) for plant in plants]) for name in "ACLQR")
    gains = transpose(solve_dare(transpose(A), transpose(C), Q, R).gain_feedback)
    unit = replace(plants[0].hardware, sensor_matrix=None)
    (A_known,), (B_known,), C_known, D_known = known_states(unit)
    count, n, past = *gains.shape[:2], len(A_known)
    sensor = axis.sensor_gain[:, None, None]
    whole, zeros = np.zeros((count, n + past, n + past)), np.zeros((count, past, 1))
    whole[:, :n, :n], whole[:, n:, n:] = A, A_known
    entry = np.concatenate([gains, zeros], axis=1)
    estimate = np.concatenate([L, transpose(zeros)], axis=2)
    applied = np.vstack([np.zeros((n, 1)), B_known]) - entry @ (sensor * D_known)
    seen = np.concatenate([C, sensor * C_known], axis=2)
    return whole - entry @ seen + applied @ estimate, entry, estimate


def _combine_axes(axes: list[tuple[FloatArray, ...]]) -> tuple[FloatArray, ...]:
    """Combine the controllers of all axes into one for each sample, in textbook form."""
    ends = np.cumsum([0, *(A.shape[-1] for A, *_ in axes)])
    count = len(axes[0][0])
    A, B = np.zeros((count, ends[-1], ends[-1])), np.zeros((count, ends[-1], len(axes)))
    C, D = np.zeros((count, len(axes), ends[-1])), np.zeros((count, len(axes), len(axes)))
    for axis, (a, b, c) in enumerate(axes):
        x = slice(*ends[axis : axis + 2])
        A[:, x, x], B[:, x, axis], C[:, axis, x] = a, b[..., 0], (c @ a)[:, 0]
        D[:, axis, axis] = (c @ b)[:, 0, 0]
    return A, B, C, D
