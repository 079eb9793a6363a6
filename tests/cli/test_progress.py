"""Progress without a terminal: a line now and then, and nothing where a program reads."""

import time

import pytest

from lbt_synth.cli import progress


@pytest.fixture
def often(monkeypatch):
    monkeypatch.setattr(progress, "_LINE_SECONDS", 0.02)


def wait_for(capsys, text):
    """What standard error gets, at the latest when it has the text."""
    seen = ""
    for _ in range(500):
        seen += capsys.readouterr().err
        if text in seen:
            return seen
        time.sleep(0.01)
    raise AssertionError(seen)


def test_a_spinner_says_what_it_does(often, capsys):
    with progress.show_spinner("thinking", quiet=False):
        assert wait_for(capsys, "so far\n").startswith("lbt-synth: thinking, 0 s so far\n")


def test_a_count_says_how_many_are_done(often, capsys):
    with progress.count_progress(total=8, what="runs", quiet=False) as count:
        count(3)
        assert "lbt-synth: runs: 3 of 8, 0 s so far\n" in wait_for(capsys, "3 of 8")


def test_items_are_counted(often, capsys):
    seen = progress.track_progress(range(2), total=2, what="rows", quiet=False)
    assert next(seen) == 0
    assert next(seen) == 1
    wait_for(capsys, "rows: 1 of 2")
    assert list(seen) == []


def test_nothing_is_said_to_programs(often, capsys):
    with progress.show_spinner("thinking", quiet=True):
        time.sleep(0.1)
    with progress.count_progress(total=8, what="runs", quiet=True) as count:
        count(3)
        time.sleep(0.1)
    assert capsys.readouterr().err == ""
