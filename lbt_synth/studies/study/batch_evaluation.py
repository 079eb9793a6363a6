"""Evaluate many samples of a study at once, and one by one where that is not possible."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from lbt_synth.errors import CertificateError
from lbt_synth.loop import EnsembleResiduals
from lbt_synth.loop.ensemble.evaluation import residuals_from_matrices, textbook_matrices
from lbt_synth.studies.study import reference_evaluation as reference
from lbt_synth.studies.study.batch_result import BatchResult, Failure
from lbt_synth.studies.study.config_keys import Keys
from lbt_synth.studies.study.sample import make_sample
from lbt_synth.studies.study.sample_arrays import (
    ASSUMED_DELAY,
    changes_assumptions_only,
    changes_numbers_only,
    make_sample_arrays,
)
from lbt_synth.studies.study.sample_designs import (
    changes_design_numbers_only,
    design_for_samples,
    has_independent_axes,
    is_kalman_for_sample,
)
from lbt_synth.studies.study.study import Study, StudyController
from lbt_synth.validation import FloatArray, IntArray

_AGREEMENT = 1e-5  # relative, of a sample evaluated both ways; below 1 absolute
_FEWEST = 4  # samples in a group that is worth an ensemble


def evaluate_samples(study: Study, values: FloatArray, start: int) -> BatchResult:
    """Evaluate consecutive samples.

    Samples whose configurations differ by numbers only are evaluated together by
    :func:`ensemble_residuals`; Kalman filters for samples are designed together by
    :func:`modal_filters`. Other designs, simulations, and samples that the configuration refuses
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
    columns = {name: np.full(len(values), np.nan) for name in study.result_columns}
    failures: list[Failure] = []
    left: dict[int, list[StudyController]] = {}  # what to evaluate one by one, by sample
    for controller in study.controllers:
        done = np.zeros(len(values), dtype=np.bool_)
        for rows, found, strehl in _evaluate_groups(study, controller, values):
            done[rows] = True
            together = {
                "strehl": strehl,
                "residual_nm": found.rms_nm,
                "turbulence_nm": found.turbulence_nm,
                "vibration_nm": found.vibration_nm,
                "noise_nm": found.noise_nm,
                "stable": found.stable.astype(np.float64),
            }
            for name, numbers in together.items():
                columns[f"{controller.name}.{name}"][rows] = numbers
            alone = replace(study, controllers=(controller,))
            _require_agreement(alone, values, start, int(rows[rows.size // 2]), columns)
        for i in np.flatnonzero(~done).tolist():
            left.setdefault(i, []).append(controller)
    for i, controllers in sorted(left.items()):
        some = replace(study, controllers=tuple(controllers))
        with np.errstate(all="ignore"):  # what overflows fails its checks
            row, failed = reference.evaluate_row(some, values[i], start + i)
        failures += failed
        for name, value in row.items():
            columns[name][i] = value
    return BatchResult(start=start, columns=columns, failures=tuple(failures))


def _evaluate_groups(
    study: Study, controller: StudyController, values: FloatArray
) -> Iterator[tuple[IntArray, EnsembleResiduals, FloatArray]]:
    """Yield what could be evaluated together: rows, residuals, Strehl ratios."""
    for_sample = is_kalman_for_sample(controller)
    if study.settings.evaluation != "exact" or (controller.design is None and not for_sample):
        return
    design = controller.design
    matrices = None if design is None else textbook_matrices([design.controller])

    def together(keys: Keys) -> bool:
        """Whether samples that differ at a place fit in one ensemble."""
        if not (changes_numbers_only(study, keys) or changes_assumptions_only(study, keys)):
            return False
        return not for_sample or (
            keys != ASSUMED_DELAY and changes_design_numbers_only(study, keys)
        )

    for group in _find_groups(study, values, together):
        try:
            sample = make_sample(study, values[group[0]])
            if matrices is None and not has_independent_axes(sample.config):
                continue
            arrays = make_sample_arrays(study, sample, values[group])
            valid = arrays.valid()
            arrays, group = arrays.take(np.flatnonzero(valid)), group[valid]
            if not group.size:
                continue
            with np.errstate(over="raise", divide="raise", invalid="raise"):
                own = design_for_samples(arrays) if matrices is None else matrices
                found = residuals_from_matrices(own, sample.hardware, arrays.ensemble())
            strehl = found.strehl(sample.config.imaging)
        except reference.EXPECTED_ERRORS:
            continue  # one of them fails; evaluating them one by one finds which
        yield group, found, strehl


def _require_agreement(
    study: Study, values: FloatArray, start: int, i: int, columns: Mapping[str, FloatArray]
) -> None:
    """Refuse a batch in which a sample differs from its evaluation by itself."""
    alone, failed = reference.evaluate_row(study, values[i], start + i)
    if failed:
        raise CertificateError(
            f"row {start + i} has a result among others, and fails by itself: {failed[0].error} "
            "This is a fault of the program; please report it with the study file."
        )
    for name, expected in alone.items():
        found = float(columns[name][i])
        apart = abs(found - expected)
        if not apart <= _AGREEMENT * max(abs(expected), 1.0):
            raise CertificateError(
                f"row {start + i} has {name} {found:.9g} among others, and {expected:.9g} by "
                "itself: one of the two is wrong. This is a fault of the program; please report "
                "it with the study file."
            )


def _find_groups(
    study: Study, values: FloatArray, together: Callable[[Keys], bool]
) -> Iterator[IntArray]:
    """Yield the indices of samples that can be evaluated together."""
    apart = [
        i
        for i, parameter in enumerate(study.parameters)
        if not all(together(keys) for keys in parameter.places)
    ]
    _, which, counts = np.unique(values[:, apart], axis=0, return_inverse=True, return_counts=True)
    for group in np.flatnonzero(counts >= min(_FEWEST, len(values))):
        yield np.flatnonzero(which.reshape(-1) == group)
