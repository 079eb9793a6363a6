"""The table of a league, from mean squares that are known."""

from __future__ import annotations

import numpy as np
import pytest

from lbt_synth.identification import PairedResiduals
from lbt_synth.storage.rows import csv_rows
from lbt_synth.studies.league.entries import Entry
from lbt_synth.studies.league.standings import (
    RecordScores,
    relative_residual,
    root_with_error,
    score_rows,
    standings,
)

ENTRIES = [
    Entry(name=name, title=name.upper(), residual=lambda _: np.zeros((1, 1)), missing=missing)
    for name, missing in (("a", ""), ("b", ""), ("c", ""), ("d", "not installed"))
]


def scores(name, levels, failures=(), size=100):
    """Two splits in which each entry leaves a known mean square and common scatter."""
    rng = np.random.default_rng(len(name))
    splits = []
    for k in range(2):
        common = rng.standard_normal(size)
        squares = {entry: level[k] + common for entry, level in levels.items()}
        splits.append(PairedResiduals(squares_nm2=squares, noise_nm2=10))
    total = PairedResiduals(
        squares_nm2={
            entry: np.concatenate([split.squares_nm2[entry] for split in splits])
            for entry in levels
        },
        noise_nm2=10,
    )
    return RecordScores(name=name, splits=tuple(splits), total=total, failures=dict(failures))


ONE = scores("one", {"a": (100, 120), "b": (121, 99), "c": (440, 440)})
OTHER = scores("other", {"a": (50, 50), "b": (72, 72)}, {"c": "unstable"})


def test_ranks_follow_the_ratio_to_the_best_of_each_record():
    rows = standings(ENTRIES, [ONE, OTHER])
    assert [(row.name, row.rank) for row in rows] == [("a", 1), ("b", 2), ("c", 3), ("d", None)]
    first, second, third, last = rows
    assert (first.wins, second.wins, third.wins) == (3, 1, 0)
    assert first.above_best == pytest.approx(0, abs=1e-12)
    least, most = (np.mean(found.total.squares_nm2["a"]) for found in (ONE, OTHER))
    exact = np.sqrt(np.sqrt((1 + 0 / least) * (1 + 22 / most))) - 1
    assert second.above_best == pytest.approx(exact, rel=1e-9)
    assert second.residual_nm == pytest.approx(np.sqrt((least + most + 22) / 2 - 10))
    assert (third.records, third.note) == (1, "unstable")
    assert (last.records, last.note) == (0, "not installed")
    assert np.isnan(last.residual_nm)
    assert csv_rows(rows).splitlines()[-1] == b",D,d,,,,,0,0,not installed"


def test_a_common_disturbance_cancels_in_the_errors():
    rows = {row.name: row for row in standings(ENTRIES, [OTHER])}
    assert rows["b"].above_best_error < 1e-9 < 1e-3 < rows["b"].residual_error_nm


def test_a_row_for_each_record_split_and_entry():
    rows = score_rows(ENTRIES, [ONE, OTHER])
    assert [(row.record, row.split, row.name) for row in rows] == [
        (record, split, name) for record in ("one", "other") for split in (1, 2) for name in "abc"
    ]
    assert rows[1].above_best_nm2 == pytest.approx(21)
    assert rows[4].above_best_nm2 == pytest.approx(-21)
    assert rows[0].measured_nm ** 2 == pytest.approx(np.mean(ONE.splits[0].squares_nm2["a"]))
    assert rows[0].residual_nm ** 2 == pytest.approx(rows[0].measured_nm ** 2 - 10)
    assert np.isnan(rows[8].residual_nm)
    assert rows[8].failure == "unstable"


def test_the_error_of_a_ratio_is_that_of_its_root():
    rng = np.random.default_rng(0)
    found = PairedResiduals(
        squares_nm2={"a": 100 + rng.standard_normal(4000), "b": 121 + rng.standard_normal(4000)}
    )
    above, error = relative_residual(found, "b")
    assert above == pytest.approx(0.1, abs=3 * error)
    assert error == pytest.approx(np.sqrt(2 / 4000) / (2 * 110), rel=0.15)
    assert relative_residual(found, "a") == (0.0, 0.0)


def test_a_variance_below_zero_has_no_root():
    assert root_with_error(4.0, 1.0) == (2.0, 0.25)
    assert np.isnan(root_with_error(-1.0, 2.0)).all()
