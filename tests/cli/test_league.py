"""The command league: its table, its files, and bad input."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from support.commands import run
from support.league import short_record

from lbt_synth.studies.league import entries as league_entries

NAMES = ("ran", "least-squares-32", "kalman")
FACTS = ("--frame-rate-hz", 500, "--delay-frames", 2, "--unit", "nm", "--most-lines", 2)


@pytest.fixture(scope="module")
def nights(tmp_path_factory):
    """Two records as files without a word about the loop."""
    folder = tmp_path_factory.mktemp("nights")
    for seed in range(2):
        record = short_record(seed)
        np.savez(
            folder / f"night {seed}.npz", measurements=record.measurements, commands=record.commands
        )
    return [folder / f"night {seed}.npz" for seed in range(2)]


@pytest.fixture(scope="module")
def league(nights, tmp_path_factory):
    """A finished league of both."""
    import contextlib
    import io

    from lbt_synth.cli.main import main

    folder = tmp_path_factory.mktemp("league") / "out"
    text = io.StringIO()
    words = ("league", *nights, "-o", folder, "--splits", 1, "--entries", *NAMES, *FACTS, "--json")
    with contextlib.redirect_stdout(text):
        assert main([str(word) for word in words]) == 0
    return folder, json.loads(text.getvalue())


def test_the_table_and_its_files(league):
    folder, data = league
    assert data["records"] == ["night-0", "night-1"]
    assert data["standings"][0]["name"] == "kalman"
    assert data["units"]["residual_nm"] == "nm"
    assert [path.rsplit("/", 1)[1] for path in data["files"]] == [
        "standings.csv",
        "scores.csv",
        "league.html",
    ]
    scores = read_scores(folder)
    assert len(scores) == 2 * 1 * 3
    assert {record for record, _, _ in scores} == {"night-0", "night-1"}
    assert "Kalman filter" in (folder / "league.html").read_text()


def test_it_is_started_again(capsys, nights, league):
    folder, data = league
    before = {path.name: path.stat().st_mtime_ns for path in (folder / "cases").iterdir()}
    status, text, _ = run(
        capsys, "league", *nights, "-o", folder, "--splits", 1, "--entries", *NAMES, *FACTS
    )
    assert status == 0
    assert "League: 3 entries, 1 split of each record" in text
    assert f"First: {data['standings'][0]['entry']}." in text
    after = {path.name: path.stat().st_mtime_ns for path in (folder / "cases").iterdir()}
    assert {name: after[name] for name in after if name != ".lock"} == {
        name: before[name] for name in before if name != ".lock"
    }


def read_scores(folder):
    with (folder / "scores.csv").open() as stream:
        return {
            (row["record"], row["split"], row["name"]): row["measured_nm"]
            for row in csv.DictReader(stream)
        }


BAD = [
    (("--splits", 0), "--splits must be at least 1; got 0"),
    (("--jobs", 0), "--jobs must be at least 1; got 0"),
    (("--entries", "magic"), "an entry must be one of ran, best-integrator"),
    (("--commands", "u.npy"), "--commands goes with one record; got 2"),
    (("--unit", "parsec"), "night 0.npz"),
]


@pytest.mark.parametrize(("words", "message"), BAD, ids=lambda value: str(value))
def test_bad_input_is_one_line(capsys, nights, tmp_path, words, message):
    status, _, error = run(capsys, "league", *nights, "-o", tmp_path / "out", *FACTS, *words)
    assert status == 2
    assert message in error
    assert error.startswith("lbt-synth: error: ")
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_record_without_a_delay_is_named(capsys, nights, tmp_path):
    status, _, error = run(
        capsys, "league", nights[0], "-o", tmp_path, "--frame-rate-hz", 500, "--unit", "nm"
    )
    assert status == 2
    assert "night 0.npz: " in error
    assert "delay" in error


def test_commands_of_the_opposite_sign_are_named(capsys, tmp_path):
    record, turned = short_record(), tmp_path / "turned.npz"
    np.savez(turned, measurements=record.measurements, commands=-record.commands)
    words = ("league", turned, "-o", tmp_path / "out", "--entries", "ran", "--splits", 1, *FACTS)
    status, _, error = run(capsys, *words)
    assert status == 2
    assert "turned.npz" in error
    assert "--command-sign -1" in error
    assert not (tmp_path / "out").exists()
    status, text, _ = run(capsys, *words, "--command-sign", -1)
    assert status == 0
    assert "League: 1 entry, 1 split of each record" in text
    assert "First: what ran." in text


def test_a_record_that_is_not_there(capsys, tmp_path):
    status, _, error = run(capsys, "league", tmp_path / "none.npz", "-o", tmp_path / "out")
    assert status == 2
    assert "cannot read" in error


def test_an_output_does_not_replace_a_record(capsys, nights, tmp_path):
    record = tmp_path / "league.html"
    record.write_bytes(nights[0].read_bytes())
    status, _, error = run(capsys, "league", record, "-o", tmp_path, *FACTS)
    assert status == 2
    assert "must not replace the input" in error


def test_without_pyrtc_its_rows_say_so(capsys, nights, tmp_path, monkeypatch):
    monkeypatch.setattr(league_entries, "pyrtc_version", lambda: None)
    status, text, _ = run(
        capsys, "league", nights[0], "-o", tmp_path, "--splits", 1, "--entries", "ran",
        "pyrtc-ar-kalman", *FACTS,
    )  # fmt: skip
    assert status == 0
    assert 'note: pyRTC ar_kalman: not installed; try: pip install "lbt-synth[pyrtc]"' in text


def test_records_of_one_name_are_told_apart(capsys, nights, tmp_path):
    other = tmp_path / "b" / "night 0.npz"
    other.parent.mkdir()
    other.write_bytes(nights[1].read_bytes())
    status, text, _ = run(
        capsys, "league", nights[0], other, "-o", tmp_path / "out", "--splits", 1,
        "--entries", "ran", *FACTS, "--json",
    )  # fmt: skip
    assert status == 0
    assert json.loads(text)["records"] == ["night-0", "night-0-2"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "cases",
        "league.html",
        "scores.csv",
        "standings.csv",
    ]
