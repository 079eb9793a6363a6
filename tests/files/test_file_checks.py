"""Damaged files of every format are refused, and never anything worse."""

from __future__ import annotations

import multiprocessing
from collections import Counter

import pytest
from support.damage import run_trials

BAD = ("hangs", "tracebacks", "silent changes")


def totals(counts):
    found = Counter()
    for (_, _, what), count in counts.items():
        found[what] += count
    return found


def test_a_few_damaged_files(tmp_path):
    """The whole study is below; this one sees that it runs."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:  # its limits stay there
        counts = pool.apply(run_trials, (tmp_path, 60))
    found = totals(counts)
    assert {what: found[what] for what in BAD} == dict.fromkeys(BAD, 0)
    assert found["refused"] > 30


@pytest.mark.study
def test_20_000_damaged_files(tmp_path, capsys):
    """Bar: no traceback, no silent change, 20 s and 4 GB for each; prints the table of the docs."""
    folders = [tmp_path / str(seed) for seed in range(4)]
    for folder in folders:
        folder.mkdir()
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        work = [
            (folder, 5_000, 200 + seed, tmp_path / "findings")
            for seed, folder in enumerate(folders)
        ]
        parts = pool.starmap(run_trials, work)
    counts = sum(parts, Counter())
    found = totals(counts)
    with capsys.disabled():
        names = dict.fromkeys(name for name, _, _ in counts if name)
        columns = ("refused", "the same", "no checksum", *BAD)
        print("\n| file |", " | ".join(("trials", *columns)), "|")
        for name in names:
            row = [
                sum(n for (f, _, w), n in counts.items() if (f, w) == (name, c)) for c in columns
            ]
            print("|", " | ".join(map(str, (name, sum(row), *row))), "|")
        print("peak MB:", max(part["", "", "peak MB"] for part in parts))
    assert sum(found[c] for c in columns) == 20_000
    assert {what: found[what] for what in BAD} == dict.fromkeys(BAD, 0)
