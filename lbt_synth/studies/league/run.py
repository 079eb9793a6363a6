"""Run a league, one case per record, split and entry; a league that is started again resumes."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import lbt_synth
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.identification import ForwardSplit, LinePrior, LoopRecord, PairedResiduals
from lbt_synth.identification.prediction.forward_chaining import forward_split, record_splits
from lbt_synth.identification.prediction.paired_residuals import chunk_squares
from lbt_synth.storage import run_cases
from lbt_synth.storage.array_file import digest
from lbt_synth.storage.atomic_files import make_directory
from lbt_synth.storage.resumable_runs import Case
from lbt_synth.studies.league.entries import Entry, all_entries, choose_entries
from lbt_synth.studies.league.standings import (
    RecordScores,
    ScoreRow,
    StandingRow,
    score_rows,
    standings,
)
from lbt_synth.validation import integer

CASES = "cases"  # the folder of the results of cases
_latest: dict[str, ForwardSplit] = {}  # the split of this process' last case


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeagueResult:
    """The table of a league and what it was made of.

    Attributes
    ----------
    standings : tuple of StandingRow
        The table, the best entry first.
    scores : tuple of ScoreRow
        A row for each record, split and entry.
    records : tuple of RecordScores
        What the entries left of each record, in chunks of frames.
    failures : mapping of str to str
        Why a record is not in the table.
    """

    standings: tuple[StandingRow, ...]
    scores: tuple[ScoreRow, ...]
    records: tuple[RecordScores, ...]
    failures: Mapping[str, str]


def run_league(
    records: Mapping[str, LoopRecord],
    directory: str | os.PathLike[str],
    *,
    entries: Sequence[str] | None = None,
    splits: int = 3,
    jobs: int = 1,
    executor: Executor | None = None,
    progress: Callable[[int], None] | None = None,
    options: Mapping[str, Mapping[str, Any]] | None = None,
) -> LeagueResult:
    """Let controllers compete on records: trained on the past, scored on what followed.

    Each record is split by forward chaining (:func:`forward_splits`). What competes on a split has
    the same training, sensor gain and frames. A record or an entry that fails is left out of the
    table, which says why.

    Parameters
    ----------
    records : mapping of str to LoopRecord
        The records by name: letters, digits and ``. _ + -``.
    directory : path-like
        Directory for the results of cases; started again with it, only missing ones run.
    entries : sequence of str, optional
        Names of those that compete; all by default.
    splits : int, optional
        Splits of each record.
    jobs : int, optional
        Processes.
    executor : concurrent.futures.Executor, optional
        Runs the cases instead.
    progress : callable, optional
        Called with the number of cases that were found or finished since its last call.
    options : mapping of str to mapping, optional
        Options of :func:`identify` for a record, by its name.

    Returns
    -------
    LeagueResult
        The table, and each score.

    Raises
    ------
    ProblemError
        If a name or value is out of range, or no record could be used.
    OutputError
        If the directory holds results of other settings, or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=500)
    >>> line = lbt.Vibration(frequency_hz=40, damping=0.005, rms_nm=50)
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(line,), noise_nm=5.0)
    >>> path = lbt.LoopHardware(frame_rate_hz=500)
    >>> ran = lbt.integrator(path, gain=0.3)
    >>> run = lbt.simulate(ran.controller, truth, hardware=path, frames=10_000)
    >>> record = lbt.identification.loop_record(
    ...     run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     found = lbt.studies.run_league(
    ...         {"night": record}, folder, entries=["ran", "best-integrator", "kalman"], splits=2
    ...     )
    >>> [row.entry for row in found.standings]
    ['Kalman filter', 'best integrator in hindsight', 'what ran']
    """
    chosen = choose_entries(entries)
    count = integer(splits, "splits", at_least=1)
    able = [name for name, entry in chosen.items() if not entry.missing]
    if not records:
        raise ProblemError("a league needs at least one record; got none.")
    folder = make_directory(Path(directory) / CASES)
    scores, failures = [], {}
    for name, record in records.items():
        own = dict((options or {}).get(name, {}))
        try:
            record_splits(record, count)
        except ProblemError as error:
            failures[name] = str(error)
            continue
        results = run_cases(
            partial(run_entry, record, own),
            record_cases(name, record, own, able, count),
            folder,
            jobs=jobs,
            executor=executor,
            progress=progress,
        )
        found = _collect_scores(name, able, count, results)
        if isinstance(found, str):
            failures[name] = found
        else:
            scores.append(found)
    if not scores:
        reasons = "; ".join(f"{name}: {why}" for name, why in failures.items())
        raise ProblemError(f"no record could be used: {reasons}")
    every: list[Entry] = list(chosen.values())
    return LeagueResult(
        standings=tuple(standings(every, scores)),
        scores=tuple(score_rows(every, scores)),
        records=tuple(scores),
        failures=failures,
    )


def record_cases(
    name: str,
    record: LoopRecord,
    options: Mapping[str, Any],
    entries: Sequence[str],
    splits: int,
) -> dict[str, dict[str, Any]]:
    """Return the cases of a record by name, the entries of one split after the other."""
    arrays = {"measurements": record.measurements, "usable": record.usable}
    if record.commands is not None:
        arrays |= {"commands": record.commands, "taps": record.mirror_taps}
    content = {
        "record": digest(arrays, {"frame_rate_hz": record.frame_rate_hz}),
        "options": json.loads(json.dumps(options, default=_plain)),
        "splits": splits,
        "version": lbt_synth.__version__,
    }
    return {
        f"{name}-{split + 1}-{entry}": content | {"split": split, "entry": entry}
        for split in range(splits)
        for entry in entries
    }


def _plain(value: Any) -> Any:
    """Return what stands for a value in JSON."""
    return asdict(value) if isinstance(value, LinePrior) else np.asarray(value).tolist()


def run_entry(record: LoopRecord, options: Mapping[str, Any], case: Case) -> dict[str, Any]:
    """Run one entry on one split of a record; an error is a result too."""
    try:
        split = _split_of(record, options, case)
        with np.errstate(over="ignore", invalid="ignore"):  # of a loop that is unstable
            left = all_entries()[case["entry"]].residual(split)
    except (LbtSynthError, np.linalg.LinAlgError) as error:
        return {"error": str(error)}
    if not np.all(np.isfinite(left)):
        return {"error": "its loop is unstable: what it leaves is not finite"}
    chunks = chunk_squares(left, record.frame_rate_hz)
    return {"squares_nm2": chunks.tolist(), "noise_nm2": split.noise_nm2}


def _split_of(record: LoopRecord, options: Mapping[str, Any], case: Case) -> ForwardSplit:
    """Return the split of a case, identified once for the entries that follow each other."""
    key = json.dumps({k: v for k, v in case.items() if k != "entry"}, sort_keys=True)
    found = _latest.get(key)
    if found is None:
        training, test = record_splits(record, case["splits"])[case["split"]]
        found = forward_split(record, training, test, **options)
        _latest.clear()
        _latest[key] = found
    return found


def _collect_scores(
    name: str, entries: Sequence[str], splits: int, results: Mapping[str, Mapping[str, Any]]
) -> RecordScores | str:
    """Return the scores of a record, or why there are none."""
    by_entry = {e: [results[f"{name}-{k + 1}-{e}"] for k in range(splits)] for e in entries}
    failures = {
        entry: next(result["error"] for result in each if "error" in result)
        for entry, each in by_entry.items()
        if any("error" in result for result in each)
    }
    left = {entry: each for entry, each in by_entry.items() if entry not in failures}
    if not left:
        return next(iter(failures.values()), "no entry can run here")
    try:
        per_split = tuple(
            PairedResiduals(
                squares_nm2={entry: each[k]["squares_nm2"] for entry, each in left.items()},
                noise_nm2=next(iter(left.values()))[k]["noise_nm2"],
            )
            for k in range(splits)
        )
    except ProblemError as error:
        return str(error)
    lengths = [len(next(iter(split.squares_nm2.values()))) for split in per_split]
    total = PairedResiduals(
        squares_nm2={
            entry: np.concatenate([split.squares_nm2[entry] for split in per_split])
            for entry in left
        },
        noise_nm2=float(np.average([split.noise_nm2 for split in per_split], weights=lengths)),
    )
    return RecordScores(name=name, splits=per_split, total=total, failures=failures)
