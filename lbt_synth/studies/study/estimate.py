"""Estimate the time and disk space of a study from a measured batch."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

from lbt_synth.studies.study.batch_evaluation import evaluate_samples
from lbt_synth.studies.study.engine import Evaluate
from lbt_synth.studies.study.study import Study
from lbt_synth.validation import integer

_FIRST_ROWS, _GROWTH, _LONG_ENOUGH_S = 4, 4, 1.0
_MOST_ROWS = 65_536
_NUMBER_BYTES = {"csv": 13, "parquet": 8}  # of a result in the table
_PART_BYTES = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """What a study will cost.

    Attributes
    ----------
    measured_rows : int
        Rows of the batch that was measured.
    measured_s : float
        Time that it took in one process [s].
    seconds : float
        Time of the whole study on the requested processes [s].
    disk_bytes : int
        Largest size of its directory, while it holds both results and parts.
    """

    measured_rows: int
    measured_s: float
    seconds: float
    disk_bytes: int


def estimate_study(
    study: Study, *, workers: int = 1, local: bool = True, evaluate: Evaluate = evaluate_samples
) -> Estimate:
    """Measure a batch in this process, and estimate what the whole study will cost.

    Parameters
    ----------
    study : Study
        The study.
    workers : int, optional
        Processes that it will run on.
    local : bool, optional
        Whether they run on this machine, and so no more at once than it has processors.
    evaluate : callable, optional
        As for :func:`run_study`.

    Returns
    -------
    Estimate
        The estimate.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> study = lbt.studies.load_study("examples/study.yaml")
    >>> cost = lbt.studies.estimate_study(study, workers=2)
    >>> cost.seconds > 0, cost.disk_bytes
    (True, 1974272)
    """
    workers = integer(workers, "workers", at_least=1)
    start, size, rows, seconds = 0, _FIRST_ROWS, 1, 0.0
    evaluate(study, study.values(0, 1), 0)  # warms up
    while seconds < _LONG_ENOUGH_S and start < study.samples:
        values = study.values(start, min(start + size, study.samples))
        before = time.perf_counter()
        evaluate(study, values, start)
        seconds, rows = time.perf_counter() - before, len(values)
        start, size = start + rows, min(_GROWTH * size, _MOST_ROWS)
    at_once = min(workers, os.cpu_count() or 1) if local else workers
    numbers = len(study.columns)
    table = _NUMBER_BYTES[study.settings.results] * numbers
    parts = _PART_BYTES * len(study.result_columns)
    return Estimate(
        measured_rows=rows,
        measured_s=seconds,
        seconds=seconds / rows * study.samples / at_once,
        disk_bytes=study.samples * (table + parts),
    )
