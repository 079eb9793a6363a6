"""Arrays in files are real numbers, and archives unpack to a bearable size."""

import io
import json
import random
import struct
import zipfile

import numpy as np
import pytest
from astropy.io import fits
from support.record_files import image

import lbt_synth as lbt
from lbt_synth.errors import FileError, TelemetryError
from lbt_synth.storage.array_file import (
    digest,
    fits_bytes,
    npz_bytes,
    open_fits,
    read_fits,
    read_npz,
    read_numpy,
)


def test_complex_arrays_do_not_lose_their_imaginary_part(tmp_path):
    series = {"commands": [[0.0], [1.5]], "measurements": [[3.0], [2.0]]}
    telemetry = lbt.files.Telemetry(frame_rate_hz=800, **series)
    path = lbt.files.save_telemetry(tmp_path / "t.npz", telemetry)
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    np.savez(path, **arrays | {"COMMANDS": arrays["COMMANDS"] + 5j})
    with pytest.raises(TelemetryError, match="COMMANDS holds no real numbers"):
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
    content = npz_bytes({"A": np.ones(2)}, json.dumps(meta | {"digest": digest({}, meta)}))
    at = content.index(b"PK\x01\x02") + 2 + field
    path = tmp_path / "a.npz"
    path.write_bytes(content[:at] + b"\xff\xff" + content[at + 2 :])
    for reader in (lbt.load_gain, lbt.load_record, lbt.files.load_telemetry):
        with pytest.raises(FileError, match="broken"):
            reader(path)


@pytest.mark.parametrize("read", [read_npz, read_fits])
def test_other_bytes(read):
    for content in (b"", b"\x93NUMPY", b"PK\x03\x04", b"SIMPLE"):
        with pytest.raises((ValueError, KeyError)):
            read(content)


def table_file(*, sums=True):
    """Return a table and an image by astropy alone, as bytes."""
    columns = [fits.Column(name, "D", array=np.arange(50.0)) for name in ("y_tip", "y_tilt")]
    rows = fits.BinTableHDU.from_columns(columns, name="R")
    stream = io.BytesIO()
    units = fits.HDUList([fits.PrimaryHDU(), rows, image("Y", np.arange(9.0))])
    units.writeto(stream, checksum=sums)
    return stream.getvalue()


def values(content):
    """Return all cards and data of FITS content."""
    with open_fits(content) as units:
        return [(repr(u.header), None if u.data is None else u.data.tobytes()) for u in units]


def test_files_of_other_programs_are_read_with_and_without_checksums():
    for content in (table_file(), table_file(sums=False), table_file() + bytes(2880)):
        with open_fits(content) as units:
            assert [unit.name for unit in units] == ["PRIMARY", "R", "Y"]


def test_every_flipped_bit_of_an_hdu_with_a_checksum_is_found_or_changes_nothing():
    content, draw, refused = table_file(), random.Random(1), 0
    original = values(content)
    for _ in range(100):
        at = draw.randrange(len(content))
        damaged = bytearray(content)
        damaged[at] ^= 1 << draw.randrange(8)
        card = bytes(content[at - at % 80 :][:80])
        if card.startswith((b"CHECKSUM", b"DATASUM")):  # without these there is nothing to check
            continue
        try:
            assert values(bytes(damaged)) == original  # behind END
        except ValueError:
            refused += 1
    assert refused > 50


@pytest.mark.parametrize("sums", [True, False])
def test_fits_content_that_is_cut_or_goes_on_is_refused(sums):
    content = table_file(sums=sums)
    for damaged in (b"", content[:3000], content[:-1000], content + b"x" * 2880):
        with pytest.raises(ValueError, match="FITS"), open_fits(damaged):
            pass


@pytest.mark.parametrize("value", ["p" * 200, "several words, " * 12 + "end"])
def test_long_strings_go_on_in_further_cards(value):
    header = fits.Header.fromstring(fits_bytes({"LONG": value, "NEXT": 1}, {}).decode())
    assert (header["LONG"], header["NEXT"]) == (value, 1)


def test_the_same_content_gives_the_same_bytes():
    cards, arrays = {"VERSION": (1, "layout")}, {"A": np.eye(2), "B": np.ones(3, dtype="f4")}
    more = {"headers": {"A": {"BUNIT": "nm"}}, "comments": ["note"]}
    one, other = (fits_bytes(cards, arrays, "text", **more) for _ in range(2))
    assert one == other
    with open_fits(one) as units:
        assert units[0].header["COMMENT"][0] == "note"
        assert units["A"].header["BUNIT"] == "nm"
        assert units["B"].data.dtype == ">f4"
    read, text = read_fits(one)
    assert (set(read), text) == ({"A", "B"}, "text")


@pytest.mark.parametrize("text", ["Čerenkov", "two\nlines"])
def test_cards_that_fits_cannot_hold_are_refused(text):
    with pytest.raises(ValueError, match="ASCII|printable"):
        fits_bytes({"NAME": text}, {})
