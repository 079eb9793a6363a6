"""A lock on a directory touches nothing but its own file."""

from __future__ import annotations

import os

import pytest

from lbt_synth.errors import OutputError
from lbt_synth.storage import file_locks
from lbt_synth.storage.file_locks import exclusive_lock


def test_a_lock_that_is_a_link_empties_nothing(tmp_path):
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    (tmp_path / ".lock").symlink_to(mine)
    with pytest.raises(OutputError, match=r"\.lock: it is a link"), exclusive_lock(tmp_path, "run"):
        pass
    assert mine.read_text() == "mine"


def test_a_lock_with_content_or_another_name_stays(tmp_path):
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    os.link(mine, tmp_path / ".lock")
    with exclusive_lock(tmp_path, "run"):
        pass
    assert mine.read_text() == "mine"


def test_a_pipe_is_no_lock(tmp_path):
    os.mkfifo(tmp_path / ".lock")
    with pytest.raises(OutputError, match="not a regular file"), exclusive_lock(tmp_path, "run"):
        pass


def test_one_at_a_time(tmp_path):
    with exclusive_lock(tmp_path, "run"):  # noqa: SIM117 - the second is refused
        with (
            pytest.raises(OutputError, match="another run is running"),
            exclusive_lock(tmp_path, "run"),
        ):
            pass
    with exclusive_lock(tmp_path, "run"):
        pass


def test_a_copy_of_the_open_file_keeps_no_lock(tmp_path, monkeypatch):
    """A worker that another thread starts has one for a moment, between fork and exec."""
    copies = []

    def open_and_copy(path, flags):
        handle = os.open(path, flags)
        copies.append(os.dup(handle))
        return handle

    monkeypatch.setattr(file_locks, "open_regular", open_and_copy)
    try:
        for _ in range(2):
            with exclusive_lock(tmp_path, "run"):
                pass
    finally:
        for copy in copies:
            os.close(copy)
    assert len(copies) == 2
