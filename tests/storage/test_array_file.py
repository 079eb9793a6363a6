"""Arrays in files are real numbers, and archives unpack to a bearable size."""

from __future__ import annotations

import io
import json
import struct
import zipfile

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.storage.array_file import digest, npz_bytes, read_fits, read_npz, read_numpy


def test_complex_arrays_do_not_lose_their_imaginary_part(tmp_path):
    telemetry = lbt.files.Telemetry(
        frame_rate_hz=800, commands=[[0.0], [1.5]], measurements=[[3.0], [2.0]]
    )
    path = lbt.files.save_telemetry(tmp_path / "t.npz", telemetry)
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    arrays["COMMANDS"] = arrays["COMMANDS"] + 5j
    with path.open("wb") as stream:
        np.savez(stream, **arrays)
    with pytest.raises(lbt.errors.TelemetryError, match="COMMANDS holds no real numbers"):
        lbt.files.load_telemetry(path)


def test_an_archive_that_unpacks_to_too_much_is_refused():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", bytes(2**20))
    content = stream.getvalue()
    at = content.index(b"PK\x01\x02")
    lie = content[: at + 24] + struct.pack("<I", 2**31) + content[at + 28 :]
    with pytest.raises(ValueError, match="unpacks to more than 1024 MB"):
        read_numpy(lie)


@pytest.mark.parametrize("field", [4, 6])  # version needed to extract, flags
def test_archives_that_zipfile_does_not_read(tmp_path, field):
    meta = {"a": 1}
    meta["digest"] = digest({}, meta)
    content = npz_bytes({"A": np.ones(2)}, json.dumps(meta))
    at = content.index(b"PK\x01\x02") + 2 + field
    path = tmp_path / "a.npz"
    path.write_bytes(content[:at] + b"\xff\xff" + content[at + 2 :])
    for reader in (lbt.load_gain, lbt.load_record, lbt.files.load_telemetry):
        with pytest.raises(lbt.errors.FileError, match="broken"):
            reader(path)


@pytest.mark.parametrize("read", [read_npz, read_fits])
def test_other_bytes(read):
    for content in (b"", b"\x93NUMPY", b"PK\x03\x04", b"SIMPLE"):
        with pytest.raises((ValueError, KeyError)):
            read(content)
