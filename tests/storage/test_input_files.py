"""Only regular files of a bearable size are read, each by every reader of the package."""

import os
from functools import partial

import pytest
from support.refusals import refused

import lbt_synth as lbt
from lbt_synth.errors import FileError, LbtSynthError
from lbt_synth.storage.input_files import read_bytes

READERS = {
    ".fits": [lbt.load_gain, lbt.files.load_telemetry, lbt.load_record],
    ".npz": [lbt.load_gain, lbt.files.load_telemetry, lbt.load_record],
    ".csv": [lbt.load_record],
    ".yaml": [lbt.load_config, lbt.studies.load_study],
}
CASES = [(ending, reader) for ending, readers in READERS.items() for reader in readers]


@pytest.mark.parametrize(("ending", "reader"), CASES)
def test_what_is_no_regular_file_of_a_bearable_size_is_refused_at_once(tmp_path, ending, reader):
    pipe, device, folder, large = (tmp_path / f"{kind}{ending}" for kind in "pdfl")
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    folder.mkdir()
    with large.open("wb") as stream:
        stream.truncate(2**40)  # without a block on the disk
    for path, words in (
        (pipe, "it is no"),
        (device, "it is no"),
        (folder, "Is a|it is no"),
        (tmp_path / ("a" * 300 + ending), "File name"),
        (large, "larger than"),
    ):
        refused(partial(reader, path), LbtSynthError, f"cannot read .*: .*({words})")


def test_a_link_may_be_read(tmp_path):
    (tmp_path / "a").write_bytes(b"12")
    (tmp_path / "b").symlink_to("a")
    assert read_bytes(tmp_path / "b", FileError, most=2) == b"12"
    short = partial(read_bytes, tmp_path / "b", FileError, most=1)
    refused(short, FileError, "larger than 0 kB")
