"""Evaluate samples of a study: many at once, and one by one where that is not possible."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np

from lbt_synth.config import Config, ensemble
from lbt_synth.config.ensemble import EXPECTED_ERRORS, AssumedAxis, Samples
from lbt_synth.config.load import build_config, validate_sections
from lbt_synth.config.samples import Keys, Reads
from lbt_synth.config.schema import FileSection
from lbt_synth.design import Design
from lbt_synth.errors import CertificateError, refuse_config
from lbt_synth.linear import solve_dare
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.loop import ClosedLoop, simulate
from lbt_synth.loop.ensemble.evaluation import residuals_from_matrices, textbook_matrices
from lbt_synth.loop.simulation.failing_sensors import simulate_sensors
from lbt_synth.loop.simulation.run import settling_frames
from lbt_synth.methods.request import DesignRequest
from lbt_synth.models import LoopHardware, PositionLoop, Truth, Vibration, tip_tilt_plant
from lbt_synth.models.plant.readings import known_states
from lbt_synth.studies.grid import Failure, Result, loop_columns, stack_columns
from lbt_synth.studies.study.study import DELAY_ERROR, EXACT_COLUMNS, NOISE_FACTOR, Study
from lbt_synth.validation import FloatArray, IntArray

_AGREEMENT = 1e-5  # relative, of a sample evaluated both ways; below 1 absolute
_FEWEST = 4  # samples in a group that is worth an ensemble

# of one sample: what designs assume, the real loop, and what that really meets
Sample = tuple[Config, LoopHardware, Truth]


def evaluate_samples(study: Study, values: FloatArray, start: int) -> Result:
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
    columns : dict of str to (b,) ndarray
        Each of ``study.result_columns`` for each sample; a controller without a result has nan,
        an unstable loop ``stable`` 0 and nan otherwise.
    failures : list of (int, str, str)
        The row, the controller without a result on it, and why; in the order of the rows.

    Raises
    ------
    CertificateError
        If a sample that is evaluated both ways has two answers.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> study = lbt.studies.load_study("examples/study.yaml")
    >>> columns, failures = lbt.studies.evaluate_samples(study, study.values(0, 2), 0)
    >>> columns["kalman.strehl"].round(3).tolist(), columns["kalman.stable"].tolist(), failures
    ([0.837, 0.821], [1.0, 1.0], [])
    """
    together: dict[str, FloatArray] = {}  # results of ensembles, by column
    remaining: dict[int, list[str]] = {}  # controllers to evaluate one by one, by sample
    for name, controller in study.controllers.items():
        table = {column: np.full(len(values), np.nan) for column in EXACT_COLUMNS}
        for rows, columns in _evaluate_groups(study, controller, values):
            for column, numbers in columns.items():
                table[column][rows] = numbers
            i = int(rows[rows.size // 2])
            among = {f"{name}.{column}": float(table[column][i]) for column in table}
            alone = replace(study, controllers={name: controller})
            _require_agreement(alone, values[i], start + i, among)
        for i in np.flatnonzero(np.isnan(table["stable"])).tolist():
            remaining.setdefault(i, []).append(name)
        together |= {f"{name}.{column}": numbers for column, numbers in table.items()}
    results, failures = evaluate_rows(study, values, start, remaining=remaining)
    for column, numbers in results.items():
        np.copyto(numbers, together[column], where=~np.isnan(together[column]))
    return results, failures


def are_evaluated_together(study: Study, controller: Design | DesignRequest) -> bool:
    """Whether many samples of a controller can be evaluated at once."""
    if study.settings.evaluation != "exact":
        return False
    if isinstance(controller, Design):
        return not controller.other_sensors
    # a Kalman filter without options, designed for each sample
    plain = controller.method.batched and not controller.given
    return plain and not study.config.hardware.suite.sensors


def _evaluate_groups(
    study: Study, controller: Design | DesignRequest, values: FloatArray
) -> Iterator[tuple[IntArray, dict[str, FloatArray]]]:
    """Yield what could be evaluated together: rows, and their columns."""
    if not are_evaluated_together(study, controller):
        return
    fixed = None  # the matrices of one design for all
    if isinstance(controller, Design):
        fixed = textbook_matrices([controller.controller])
    reads = ensemble.read_config(study.config, designs=fixed is None)
    for rows in _find_groups(study, values, reads):
        try:
            config, hardware, _ = make_sample(study, values[rows[0]])
            if fixed is None and not _has_independent_axes(config):
                continue
            samples = _stack_samples(study, config, values[rows], reads)
            accepted = ensemble.accepted_samples(samples)
            if not accepted.size:
                continue
            samples = samples.take(accepted)
            with np.errstate(over="raise", divide="raise", invalid="raise"):
                matrices = _design_for_samples(samples) if fixed is None else fixed
                loops = ensemble.build_ensemble(samples)
                residuals = residuals_from_matrices(matrices, hardware, loops)
            columns = stack_columns(residuals, config.imaging)
        except EXPECTED_ERRORS:
            continue  # one of them fails; evaluating them one by one finds which
        yield rows[accepted], columns


def _find_groups(study: Study, values: FloatArray, reads: Reads) -> Iterator[IntArray]:
    """Yield the indices of samples that differ by numbers that builders take as arrays only."""
    apart = [
        i
        for i, places in enumerate(study.places.values())
        if not all(map(reads.take_arrays_at, places))
    ]
    _, which, counts = np.unique(values[:, apart], axis=0, return_inverse=True, return_counts=True)
    for group in np.flatnonzero(counts >= min(_FEWEST, len(values))):
        yield np.flatnonzero(which.reshape(-1) == group)


def _stack_samples(study: Study, config: Config, values: FloatArray, reads: Reads) -> Samples:
    """Return the samples of a group of rows of ``Study.values``; one configuration is given."""
    by_name = dict(zip(study.parameter_names, values.T, strict=True))
    places = [(keys, by_name[name]) for name, each in study.places.items() for keys in each]
    return Samples(
        config=config,
        values={keys: numbers for keys, numbers in places if reads.take_arrays_at(keys)},
        delay_error_frames=by_name.get(DELAY_ERROR, np.zeros(len(values))),
        noise_factor=by_name.get(NOISE_FACTOR, np.ones(len(values))),
    )


def _require_agreement(
    study: Study, values: FloatArray, row: int, among: Mapping[str, float]
) -> None:
    """Refuse a batch in which a sample differs from its evaluation by itself."""
    single, failures = evaluate_row(study, values, row)
    fault = "This is a fault of the program; please report it with the study file."
    if failures:
        raise CertificateError(
            f"row {row} has a result among others, and fails by itself: {failures[0][2]} {fault}"
        )
    for name, expected in single.items():
        if not abs(among[name] - expected) <= _AGREEMENT * max(abs(expected), 1.0):
            raise CertificateError(
                f"row {row} has {name} {among[name]:.9g} among others, and {expected:.9g} by "
                f"itself: one of the two is wrong. {fault}"
            )


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


def make_sample(study: Study, values: Sequence[float] | FloatArray) -> Sample:
    """Make the sample of a row of ``Study.values``."""
    base, parameters = study.config, study.parameters_by_name(values)
    full = base.settings.model_dump()
    content = base.settings.model_dump(exclude_unset=True)
    for name, places in study.places.items():
        for keys in places:
            _set_number(content, keys, parameters[name], full=full)
    config = build_config(validate_sections(FileSection, content, base.source), base.source)
    delay_error, factor = parameters.get(DELAY_ERROR, 0.0), parameters.get(NOISE_FACTOR, 1.0)
    hardware, truth = config.hardware, config.truth
    with refuse_config(f"the real loop, with {DELAY_ERROR} and {NOISE_FACTOR}"):
        if delay_error != 0:
            hardware = replace(hardware, delay_frames=hardware.delay_frames + delay_error)
        if factor != 1:
            truth = replace(truth, noise_nm=truth.noise_nm * factor)
    return config, hardware, truth


def _set_number(
    content: dict[str, Any], keys: Keys, value: float, *, full: Mapping[str, Any]
) -> None:
    """Set a number that :func:`find_number` finds in ``full``, the content with its defaults.

    Missing sections on the way are added, missing lists copied. An integer stays one if it can.
    """
    here: Any = content
    whole: Any = full
    for key in keys[:-1]:
        whole = whole[key]
        if isinstance(here, dict) and key not in here:
            here[key] = deepcopy(whole) if isinstance(whole, list) else {}
        here = here[key]
    is_integer = isinstance(whole[keys[-1]], int) and value.is_integer()
    here[keys[-1]] = int(value) if is_integer else value


def evaluate_rows(
    study: Study,
    values: FloatArray,
    start: int,
    *,
    remaining: Mapping[int, Sequence[str]] | None = None,
) -> Result:
    """Evaluate consecutive rows of ``Study.values``, (b, parameters), one by one.

    ``remaining`` names the controllers to evaluate on each row, by its place; all by default.
    """
    if remaining is None:
        remaining = dict.fromkeys(range(len(values)), tuple(study.controllers))
    columns = {name: np.full(len(values), np.nan) for name in study.result_columns}
    failures: list[Failure] = []
    for i, names in sorted(remaining.items()):
        some = replace(study, controllers={name: study.controllers[name] for name in names})
        with np.errstate(all="ignore"):  # what overflows fails its checks
            results, failed = evaluate_row(some, values[i], start + i)
        failures += failed
        for name, value in results.items():
            columns[name][i] = value
    return columns, failures


def evaluate_row(
    study: Study, values: FloatArray, row: int
) -> tuple[dict[str, float], list[Failure]]:
    """Evaluate one sample, and return its results by column and its failures."""
    failures: list[Failure] = []
    loops: dict[str, ClosedLoop] = {}
    results: dict[str, float] = {}
    with _note_failure(failures, row, study.controllers):
        sample = config, _, truth = make_sample(study, values)
        for name, controller in study.controllers.items():
            with _note_failure(failures, row, [name]):
                loops[name] = close_sample_loop(sample, design_for_sample(controller, sample))
        # frames to drop: the same for all controllers, which meet the same disturbances
        radii = [loop.radius_per_frame for loop in loops.values() if loop.is_stable]
        least = study.config.settings.simulation.settle_frames
        settle = max([least, *map(settling_frames, radii)])
        for name, loop in loops.items():
            with _note_failure(failures, row, [name]):
                if not loop.is_stable:
                    columns = {"stable": 0.0}
                elif study.settings.evaluation == "exact":
                    columns = loop_columns(loop, truth, config.imaging)
                else:
                    seed = study.simulation_seed(row)
                    columns = _simulate(loop, sample, seed=seed, settle=settle)
                results |= {f"{name}.{column}": value for column, value in columns.items()}
    return results, failures


@contextmanager
def _note_failure(failures: list[Failure], row: int, controllers: Iterable[str]) -> Iterator[None]:
    """Note an error that fails controllers on a sample, and not the study."""
    try:
        yield
    except EXPECTED_ERRORS as error:
        text = " ".join(str(error).split()) or type(error).__name__
        failures += [(row, name, text) for name in controllers]


def design_for_sample(controller: Design | DesignRequest, sample: Sample) -> Design:
    """Return a controller's design, made for the sample if it has none for all."""
    return controller if isinstance(controller, Design) else sample[0].design(controller)


def close_sample_loop(sample: Sample, design: Design) -> ClosedLoop:
    """Close the real loop of a sample with a design."""
    _, hardware, truth = sample
    return design.close(hardware, sensor_gain=truth.sensor_gain)


def _simulate(loop: ClosedLoop, sample: Sample, *, seed: int, settle: int) -> dict[str, float]:
    """Return the mean Strehl ratio and the residual of a stable loop, simulated as configured."""
    config, _, truth = sample
    section, hardware = config.settings.simulation, loop.hardware
    sizes = {"frames": section.frames, "cases": section.cases, "settle_frames": settle}
    if loop.reads_others:
        filters = {frozenset[str](): loop.controller}
        run = simulate_sensors(filters, truth, hardware=hardware, seed=seed, drops=(), **sizes)
    else:
        run = simulate(loop.controller, truth, hardware=hardware, seed=seed, **sizes)
    return {
        "stable": 1.0,
        "strehl": float(np.mean(run.strehl(config.imaging))),
        "residual_nm": float(np.sqrt(np.mean(run.rms_nm**2))),
    }
