"""Evaluate samples of a study: many at once, and one by one where that is not possible."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import cast

import numpy as np

from lbt_synth.config.samples import Keys, array_keys, build_ensemble
from lbt_synth.design import Design
from lbt_synth.errors import CertificateError, LbtSynthError
from lbt_synth.linear import solve_dare
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.loop.budget import ensemble_residuals
from lbt_synth.loop.evaluator import textbook_matrices
from lbt_synth.methods.request import DesignRequest, fixed_design
from lbt_synth.models import TipTiltPlant
from lbt_synth.studies.grid import Failure, Result, loop_columns, residual_columns
from lbt_synth.studies.study.study import (
    DELAY_ERROR,
    NOISE_FACTOR,
    Study,
    close_sample_loop,
    design_for_sample,
    make_sample,
)
from lbt_synth.validation import FloatArray, IntArray

# errors that refuse a sample; LinAlgError is a ValueError
EXPECTED_ERRORS = (LbtSynthError, ArithmeticError, ValueError)
_DELAY: Keys = ("loop", "delay_frames")  # which decides the states of a filter
_AGREEMENT = 1e-5  # of a sample evaluated both ways, relative and absolute


def evaluate_samples(
    study: Study, values: FloatArray, start: int, *, together: bool = True
) -> Result:
    """Evaluate consecutive rows of ``Study.values`` from a start; nan is where there is no result.

    Samples whose configurations differ by numbers that its builders take as arrays are evaluated
    together, and so are the equations of their Kalman filters. All others are evaluated one by one,
    as is one sample of each group, and the two answers must agree.
    """
    columns = {name: np.full(len(values), np.nan) for name in study.result_columns}
    failures: list[Failure] = []
    remaining: dict[int, list[str]] = {}  # controllers to evaluate one by one, by sample
    for name, controller in study.controllers.items():
        for rows, results in _evaluate_groups(study, controller, values) if together else ():
            for column, numbers in results.items():
                columns[f"{name}.{column}"][rows] = numbers
            i = int(rows[rows.size // 2])
            alone = replace(study, controllers={name: controller})
            among = {column: float(columns[column][i]) for column in alone.result_columns}
            _require_agreement(alone, values[i], start + i, among)
        for i in np.flatnonzero(np.isnan(columns[f"{name}.stable"])).tolist():
            remaining.setdefault(i, []).append(name)
    for i, names in sorted(remaining.items()):
        some = replace(study, controllers={name: study.controllers[name] for name in names})
        with np.errstate(all="ignore"):  # what overflows fails its checks
            single, failed = evaluate_row(some, values[i], start + i)
        failures += failed
        for column, value in single.items():
            columns[column][i] = value
    return columns, failures


def are_evaluated_together(study: Study, controller: Design | DesignRequest) -> bool:
    """Whether many samples of a controller can be evaluated at once."""
    if (design := fixed_design(controller)) is not None:
        return not design.other_sensors
    # a Kalman filter without options, designed for each sample
    request = cast("DesignRequest", controller)
    plain = request.method.batched and not request.given
    return plain and not study.config.hardware.suite.sensors


def _evaluate_groups(
    study: Study, controller: Design | DesignRequest, values: FloatArray
) -> Iterator[tuple[IntArray, dict[str, FloatArray]]]:
    """Yield what could be evaluated together: rows, and their columns."""
    if not are_evaluated_together(study, controller):
        return
    design = fixed_design(controller)
    keys = array_keys(study.config.settings) - ({_DELAY} if design is None else set())
    for rows in _find_groups(study, values, keys):
        with suppress(*EXPECTED_ERRORS):
            yield rows, _evaluate_group(study, design, values[rows], keys)
            continue
        accepted = _accepted_rows(study, values, rows)  # without the one that fails
        with suppress(*EXPECTED_ERRORS, IndexError):  # none may make a sample
            yield accepted, _evaluate_group(study, design, values[accepted], keys)


def _evaluate_group(
    study: Study, design: Design | None, values: FloatArray, keys: set[Keys]
) -> dict[str, FloatArray]:
    """Return the columns of samples that differ by numbers of some keys only."""
    config, hardware, _ = make_sample(study, values[0])
    by_name = dict(zip(study.parameter_names, values.T, strict=True))
    places = [(place, by_name[name]) for name, keys_of in study.places.items() for place in keys_of]
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        if design is None:
            matrices = _kalman_matrices([make_sample(study, row)[0].plant for row in values])
        else:
            matrices = textbook_matrices([design.controller])
        loops = build_ensemble(
            config,
            {place: numbers for place, numbers in places if place in keys},
            delay_error_frames=by_name.get(DELAY_ERROR, np.zeros(len(values))),
            noise_factor=by_name.get(NOISE_FACTOR, np.ones(len(values))),
        )
        residuals = ensemble_residuals(matrices, hardware, loops)
    return residual_columns(residuals, config.imaging)


def _accepted_rows(study: Study, values: FloatArray, group: IntArray) -> IntArray:
    """Return the rows of a group that make a sample."""
    accepted = []
    for row in group.tolist():
        with suppress(*EXPECTED_ERRORS):
            make_sample(study, values[row])
            accepted.append(row)
    return np.array(accepted, dtype=np.intp)


def _kalman_matrices(plants: list[TipTiltPlant]) -> tuple[FloatArray, ...]:
    """Design a Kalman filter for each plant, all at once; A, B, C, D in textbook form."""
    A, C, Q, R = (np.stack([getattr(plant, name) for plant in plants]) for name in "ACQR")
    gains = transpose(solve_dare(transpose(A), transpose(C), Q, R).gain_feedback)
    filters = [plant.controller(gain) for plant, gain in zip(plants, gains, strict=True)]
    systems = [controller.to_statespace() for controller in filters]
    return tuple(np.stack([getattr(system, name) for system in systems]) for name in "ABCD")


def _find_groups(study: Study, values: FloatArray, keys: set[Keys]) -> Iterator[IntArray]:
    """Yield the indices of samples that differ by numbers of some keys only."""
    places = enumerate(study.places.values())
    apart = [i for i, numbers in places if not keys.issuperset(numbers)]
    _, which, counts = np.unique(values[:, apart], axis=0, return_inverse=True, return_counts=True)
    for group in np.flatnonzero(counts >= min(2, len(values))):
        yield np.flatnonzero(which.reshape(-1) == group)


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
        close = np.isclose(among[name], expected, _AGREEMENT, _AGREEMENT, equal_nan=True)
        if not close:
            raise CertificateError(
                f"row {row} has {name} {among[name]:.9g} among others, and {expected:.9g} by "
                f"itself: one of the two is wrong. {fault}"
            )


def evaluate_row(
    study: Study, values: FloatArray, row: int
) -> tuple[dict[str, float], list[Failure]]:
    """Evaluate one sample, and return its results by column and its failures."""
    failures: list[Failure] = []
    results: dict[str, float] = {}
    with note_failure(failures, row, study.controllers):
        sample = config, _, truth = make_sample(study, values)
        for name, controller in study.controllers.items():
            with note_failure(failures, row, [name]):
                loop = close_sample_loop(sample, design_for_sample(controller, sample))
                columns = loop_columns(loop, truth, config.imaging)
                results |= {f"{name}.{column}": value for column, value in columns.items()}
    return results, failures


@contextmanager
def note_failure(failures: list[Failure], row: int, controllers: Iterable[str]) -> Iterator[None]:
    """Note an error that fails controllers on a sample, and not the study."""
    try:
        yield
    except EXPECTED_ERRORS as error:
        text = " ".join(str(error).split()) or type(error).__name__
        failures += [(row, name, text) for name in controllers]
