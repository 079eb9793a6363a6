"""Files are written whole, never over an input, a link or a device, and leave nothing behind."""

import os
import stat
from functools import partial
from pathlib import Path

import pytest
from support.refusals import refused

from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.storage.atomic_files import (
    exclusive_lock,
    open_atomically,
    refuse_replacing,
    require_writable,
    write_atomically,
    write_together,
)


def write_streamed(path, content):
    with open_atomically(path) as stream:
        stream.write(content)


def write_two(path, content):
    write_together({path.with_name("other"): content, path: content})


every_writer = pytest.mark.parametrize("write", [write_atomically, write_streamed, write_two])


def test_what_is_not_there_or_no_name_is_no_input(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.fits").write_bytes(b"a")
    Path("ring").symlink_to("ring")
    refuse_replacing(["b.fits", "\0"], ["a.fits", "none.fits", "\0c", "ring"])
    require_writable("b.fits", inputs=["a.fits"])
    replaced = r"a\.fits must not replace the input \./a\.fits"
    error = refused(lambda: require_writable("a.fits", inputs=["./a.fits"]), OutputError, replaced)
    assert error.path == Path("a.fits")
    later = tmp_path / "x" / ".." / "none.fits"  # before either exists
    refused(lambda: refuse_replacing(["none.fits"], [later]), OutputError, "must not replace")


@every_writer
def test_only_regular_files_are_replaced(tmp_path, write):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "link").symlink_to("mine")
    (tmp_path / "broken").symlink_to("nowhere")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "directory").mkdir()
    before = sorted(os.listdir(tmp_path))
    for name in ("link", "broken", "pipe", "directory", "é" * 128):  # the last has 256 bytes
        for call in (partial(write, content=b"new"), require_writable):
            refused(partial(call, tmp_path / name), OutputError, "is a|cannot write")
    assert ((tmp_path / "mine").read_text(), sorted(os.listdir(tmp_path))) == ("mine", before)
    write(tmp_path / ("a" * 255), b"new")
    with pytest.raises(ProblemError, match="one of the content"), open_atomically(tmp_path / "out"):
        raise ProblemError("one of the content")  # which stays its own
    assert not (tmp_path / "out").exists()


@every_writer
def test_permissions_stay(tmp_path, write):
    path, new = tmp_path / "secret", tmp_path / "new"
    path.write_bytes(b"old")
    path.chmod(0o600)
    write(path, b"new")
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"new", 0o600)
    before = os.umask(0o027)
    try:
        write(new, b"new")
    finally:
        os.umask(before)
    assert stat.S_IMODE(new.stat().st_mode) == 0o640


@every_writer
def test_a_full_disk_leaves_the_older_file_and_nothing_else(tmp_path, monkeypatch, write):
    path = tmp_path / "out"
    path.write_bytes(b"old")

    def full_disk(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    refused(lambda: write(path, b"new"), OutputError, "cannot write .*No space left on device")
    assert (path.read_bytes(), os.listdir(tmp_path)) == (b"old", ["out"])


def test_one_at_a_time_holds_a_directory(tmp_path):
    def hold(folder, *others):
        with exclusive_lock(folder, "run"):
            for other in others:
                hold(other)

    (tmp_path / "odd" / ".lock").mkdir(parents=True)
    refused(lambda: hold(tmp_path, tmp_path), OutputError, "another run is running")
    hold(tmp_path)  # it is free again
    refused(lambda: hold(tmp_path / "odd"), OutputError, r"\.lock: Is a dir")
