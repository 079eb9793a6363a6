"""Progress is for people at a terminal: nothing is said to programs."""

import sys

import pytest

from lbt_synth.cli import progress


def show_all(quiet):
    with progress.show_progress("thinking", quiet=quiet):
        with progress.count_progress(total=8, what="runs") as count:
            count(3)
        seen = progress.track_progress(range(2), total=2, what="rows")
        assert list(seen) == [0, 1]


@pytest.mark.parametrize(("terminal", "quiet"), [(False, False), (False, True), (True, True)])
def test_nothing_is_said_to_programs(capsys, monkeypatch, terminal, quiet):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    show_all(quiet)
    assert capsys.readouterr().err == ""


def test_a_terminal_shows_what_is_done(capsys, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    show_all(quiet=False)
    assert "thinking" in capsys.readouterr().err
