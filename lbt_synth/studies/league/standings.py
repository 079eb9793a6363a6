"""The standings of a league: residuals, ranks, wins, and how far each entry is above the best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.identification import PairedResiduals
from lbt_synth.storage.rows import column, nm_column, percent_column, table_row
from lbt_synth.studies.league.entries import Entry
from lbt_synth.validation import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordScores:
    """What the entries left of the tests of one record.

    Attributes
    ----------
    name : str
        The record.
    splits : tuple of PairedResiduals
        Those that ran on all splits, on each split.
    total : PairedResiduals
        The same on all splits, one after the other.
    failures : mapping of str to str
        Why an entry is not among them, by its name.
    """

    name: str
    splits: tuple[PairedResiduals, ...]
    total: PairedResiduals
    failures: Mapping[str, str]


@table_row
class ScoreRow:
    """What one entry left of one test."""

    record: str = column("record", help="The record")
    split: int = column("split", help="Its split, from 1")
    name: str = column("name", help="The entry, as ``--entries`` calls it")
    entry: str = column("entry", help="The entry")
    residual_nm: float = nm_column("residual", format=".2f", help="Residual over all axes, rms")
    residual_error_nm: float = nm_column("+-", format=".2f", help="Its standard error")
    measured_nm: float = nm_column("with noise", format=".2f", help="The same with the noise, rms")
    above_best_nm2: float = column(
        "above the best",
        unit="nm2",
        format=".1f",
        help="Variance above that of the record's best entry, on the same frames",
    )
    above_best_error_nm2: float = column(
        "+-", unit="nm2", format=".1f", help="Standard error of that difference"
    )
    failure: str = column(help="Why there is no result; empty if there is one")


@table_row
class StandingRow:
    """The place of one entry in the table."""

    rank: int | None = column("rank", help="Its rank; None if it ran on no record")
    entry: str = column("entry", help="The entry")
    name: str = column(help="The entry, as ``--entries`` calls it")
    residual_nm: float = nm_column(
        "residual", format=".2f", help="Residual over all axes without noise, rms over the records"
    )
    residual_error_nm: float = nm_column("+-", format=".2f", help="Its standard error")
    above_best: float = percent_column(
        "above the best",
        help="Measured residual, with noise, over that of the best entry of each record, less 1; "
        "geometric mean over the records",
    )
    above_best_error: float = percent_column("+-", help="Its standard error")
    wins: int = column("wins", help="Tests in which it left least")
    records: int = column("records", help="Records on which it ran")
    note: str = column("note", help="Why it did not run on others")


def standings(entries: Sequence[Entry], records: Sequence[RecordScores]) -> list[StandingRow]:
    """Return the rows of the table, the best first.

    Ranks are those of :attr:`StandingRow.above_best`, after all entries that ran on more records.
    """
    rows = [_unranked_row(entry, records) for entry in entries]
    rows.sort(key=lambda row: (-row.records, row.above_best if row.records else 0.0))
    return [replace(row, rank=i + 1 if row.records else None) for i, row in enumerate(rows)]


def _unranked_row(entry: Entry, records: Sequence[RecordScores]) -> StandingRow:
    ran = [scores for scores in records if entry.name in scores.total.squares_nm2]
    why = {scores.failures[entry.name] for scores in records if entry.name in scores.failures}
    note = entry.missing or "; ".join(sorted(why))
    if not ran:
        return StandingRow(
            rank=None,
            entry=entry.title,
            name=entry.name,
            residual_nm=np.nan,
            residual_error_nm=np.nan,
            above_best=np.nan,
            above_best_error=np.nan,
            wins=0,
            records=0,
            note=note,
        )
    count, name = len(ran), entry.name
    variance = float(np.mean([scores.total.residual_nm2(name) for scores in ran]))
    variance_error = _error_of_mean([scores.total.error_nm2(name) for scores in ran])
    ratios = np.array([relative_residual(scores.total, name) for scores in ran])
    residual_nm, residual_error_nm = root_with_error(variance, variance_error)
    return StandingRow(
        rank=None,
        entry=entry.title,
        name=name,
        residual_nm=residual_nm,
        residual_error_nm=residual_error_nm,
        above_best=float(np.expm1(np.mean(np.log1p(ratios[:, 0])))),
        above_best_error=_error_of_mean(ratios[:, 1]),
        wins=sum(split.best == name for scores in ran for split in scores.splits),
        records=count,
        note=note,
    )


def score_rows(entries: Sequence[Entry], records: Sequence[RecordScores]) -> list[ScoreRow]:
    """Return a row for each record, split and entry, those that failed included."""
    return [
        _score_row(entry, scores, split)
        for scores in records
        for split in range(len(scores.splits))
        for entry in entries
        if not entry.missing
    ]


def _score_row(entry: Entry, scores: RecordScores, split: int) -> ScoreRow:
    residual_nm = error_nm = measured_nm = above = above_error = np.nan
    found = scores.splits[split]
    if entry.name in found.squares_nm2:
        variance, error = found.residual_nm2(entry.name), found.error_nm2(entry.name)
        residual_nm, error_nm = root_with_error(variance, error)
        measured_nm = float(np.sqrt(found.measured_nm2(entry.name)))
        above, above_error = found.above(entry.name, scores.total.best)
    return ScoreRow(
        record=scores.name,
        split=split + 1,
        name=entry.name,
        entry=entry.title,
        residual_nm=residual_nm,
        residual_error_nm=error_nm,
        measured_nm=measured_nm,
        above_best_nm2=above,
        above_best_error_nm2=above_error,
        failure=scores.failures.get(entry.name, ""),
    )


def relative_residual(found: PairedResiduals, name: str) -> tuple[float, float]:
    """Return a measured residual over that of the best, less 1, and its standard error."""
    least = found.measured_nm2(found.best)
    difference, error = found.above(name, found.best)
    ratio = float(np.sqrt(1 + difference / least))
    return ratio - 1, error / (2 * ratio * least)


def root_with_error(variance: float, error: float) -> tuple[float, float]:
    """Return the root of a variance and its standard error; nan where it is not above 0."""
    if not variance > 0:
        return float("nan"), float("nan")
    root = float(np.sqrt(variance))
    return root, error / (2 * root)


def _error_of_mean(errors: Sequence[float] | FloatArray) -> float:
    """Return the error of the mean of independent values."""
    return float(np.linalg.norm(errors) / len(errors))
