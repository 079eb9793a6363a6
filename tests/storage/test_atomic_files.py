"""Files are written whole, never over an input, a link or a device, and leave nothing behind."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from lbt_synth.errors import OutputError
from lbt_synth.storage.atomic_files import (
    open_atomically,
    refuse_replacing,
    remove_unfinished_files,
    require_writable,
    write_atomically,
    write_together,
)


def test_what_is_not_there_or_no_name_is_no_input(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.fits").write_bytes(b"a")
    refuse_replacing(["b.fits", "\0"], ["a.fits", "none.fits", "\0c"])
    Path("ring").symlink_to("ring")
    refuse_replacing(["b.fits"], ["ring"])
    require_writable("b.fits", inputs=["a.fits"])
    with pytest.raises(OutputError, match=r"a\.fits must not replace the input \./a\.fits") as one:
        require_writable("a.fits", inputs=["./a.fits"])
    assert one.value.path == Path("a.fits")
    with pytest.raises(OutputError, match="must not replace"):  # before either exists
        refuse_replacing(["none.fits"], [tmp_path / "x" / ".." / "none.fits"])


def write_streamed(path, content):
    with open_atomically(path) as stream:
        stream.write(content)


def write_two(path, content):
    write_together({path.with_name("other"): content, path: content})


@pytest.mark.parametrize("write", [write_atomically, write_streamed, write_two])
@pytest.mark.parametrize("kind", ["link", "broken link", "pipe", "directory", "long name"])
def test_only_regular_files_are_replaced(tmp_path, write, kind):
    mine, target = tmp_path / "mine.txt", tmp_path / "out"
    mine.write_text("mine")
    if kind == "link":
        target.symlink_to(mine)
    elif kind == "broken link":
        target.symlink_to("nowhere")
    elif kind == "pipe":
        os.mkfifo(target)
    elif kind == "directory":
        target.mkdir()
    else:
        target = tmp_path / ("é" * 128)  # 256 bytes
    before = sorted(os.listdir(tmp_path))
    for refused in (lambda: write(target, b"new"), lambda: require_writable(target)):
        with pytest.raises(OutputError, match=r"is a|cannot write"):
            refused()
    assert mine.read_text() == "mine"
    assert sorted(os.listdir(tmp_path)) == before


def test_a_name_may_be_as_long_as_the_system_takes(tmp_path):
    path = tmp_path / ("a" * 255)
    assert write_atomically(path, b"whole").read_bytes() == b"whole"


@pytest.mark.parametrize("write", [write_atomically, write_streamed, write_two])
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


KILLED = """
    import os, signal, sys
    from lbt_synth.storage.atomic_files import open_atomically
    with open_atomically(sys.argv[1]) as stream:
        stream.write(b"half")
        stream.flush()
        if sys.argv[2] == "waits":
            print(flush=True)
            input()
        os.kill(os.getpid(), signal.SIGKILL)
"""


def start_writer(path, how):
    lines = textwrap.dedent(KILLED)
    return subprocess.Popen(
        [sys.executable, "-c", lines, str(path), how], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )


def test_what_a_killed_run_left_is_removed_by_the_next(tmp_path):
    path = tmp_path / "out"
    with start_writer(path, "dies") as other:
        assert other.wait() == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.read_bytes() == b"half"
    write_atomically(path, b"whole")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_what_another_process_writes_stays(tmp_path):
    path = tmp_path / "out"
    with start_writer(path, "waits") as other:
        other.stdout.readline()
        write_atomically(path, b"whole")
        remove_unfinished_files(tmp_path)
        assert path.read_bytes() == b"whole"
        assert sorted(p.read_bytes() for p in tmp_path.iterdir()) == [b"half", b"whole"]
        other.kill()
        other.stdout.close()
    remove_unfinished_files(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_link_under_the_temporary_name_is_not_followed(tmp_path):
    path, mine = tmp_path / "out", tmp_path / "mine"
    with start_writer(path, "dies") as other:
        other.wait()
    (left,) = tmp_path.iterdir()
    left.unlink()
    mine.write_text("mine")
    left.symlink_to(mine)
    write_atomically(path, b"whole")
    assert (mine.read_text(), path.read_bytes()) == ("mine", b"whole")
