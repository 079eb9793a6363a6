"""Only regular files of a bearable size are read, each by every reader of the package."""

import os

import pytest

import lbt_synth as lbt
from lbt_synth.errors import FileError
from lbt_synth.storage.input_files import read_bytes

READERS = {
    ".fits": [lbt.load_gain, lbt.files.load_telemetry, lbt.load_record],
    ".npz": [lbt.load_gain, lbt.files.load_telemetry, lbt.load_record],
    ".csv": [lbt.load_record],
    ".yaml": [lbt.load_config, lbt.studies.load_study],
}
CASES = [(ending, reader) for ending, readers in READERS.items() for reader in readers]


@pytest.mark.parametrize(("ending", "reader"), CASES)
@pytest.mark.parametrize("kind", ["pipe", "device", "directory", "long name"])
def test_what_is_no_regular_file_is_refused_at_once(tmp_path, ending, reader, kind):
    path = tmp_path / f"in{ending}"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "directory":
        path.mkdir()
    else:
        path = tmp_path / ("a" * 300 + ending)
    with pytest.raises(
        lbt.errors.LbtSynthError, match=r"cannot read .*: (it is no|Is a|File name)"
    ):
        reader(path)


@pytest.mark.parametrize(("ending", "reader"), CASES)
def test_too_large_files_are_refused_unread(tmp_path, ending, reader):
    path = tmp_path / f"in{ending}"
    with path.open("wb") as stream:
        stream.truncate(2**40)  # without a block on the disk
    with pytest.raises(lbt.errors.LbtSynthError, match="it is larger than"):
        reader(path)


def test_a_link_may_be_read(tmp_path):
    (tmp_path / "a").write_bytes(b"12")
    (tmp_path / "b").symlink_to("a")
    assert read_bytes(tmp_path / "b", FileError, most=2) == b"12"
    with pytest.raises(FileError, match="larger than 0 kB"):
        read_bytes(tmp_path / "b", FileError, most=1)
