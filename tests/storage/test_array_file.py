"""Arrays in files are real numbers, and archives unpack to a bearable size."""

import io
import struct

import numpy as np
import pytest
from astropy.io import fits
from support.record_files import image
from support.refusals import refused

from lbt_synth.storage.array_file import fits_bytes, npz_bytes, open_fits, read_fits, read_npz


def table_file(*, sums):
    """Return a table and an image by astropy alone, as bytes."""
    columns = [fits.Column(name, "D", array=np.arange(50.0)) for name in ("y_tip", "y_tilt")]
    rows = fits.BinTableHDU.from_columns(columns, name="R")
    stream = io.BytesIO()
    units = fits.HDUList([fits.PrimaryHDU(), rows, image("Y", np.arange(9.0))])
    units.writeto(stream, checksum=sums)
    return stream.getvalue()


def fits_names(content):
    with open_fits(content) as units:
        return [unit.name for unit in units]


TABLES = table_file(sums=True), table_file(sums=False)


def test_files_of_other_programs_are_read_with_and_without_checksums():
    for content in (*TABLES, TABLES[0] + bytes(2880)):
        assert fits_names(content) == ["PRIMARY", "R", "Y"]


def patched(place, new):
    """Return an archive that says something else in its directory."""
    content = npz_bytes({"A": np.ones(2)}, "{}")
    at = content.index(b"PK\x01\x02") + place
    return content[:at] + new + content[at + len(new) :]


def write_card(value):
    return fits_bytes({"NAME": value}, {})


FRAGMENTS = b"", b"\x93NUMPY", b"PK\x03\x04", b"SIMPLE"


@pytest.mark.parametrize(
    ("call", "content", "words"),
    [
        (read_npz, npz_bytes({"A": np.array([1.0, 5j])}, "{}"), "A holds no real numbers"),
        (read_npz, patched(24, struct.pack("<I", 2**31)), "unpacks to more than 1024 MB"),
        (read_npz, patched(6, b"\xff\xff"), "broken"),  # the version needed to extract
        (read_npz, patched(8, b"\xff\xff"), "broken"),  # flags
        *((read, content, None) for read in (read_npz, read_fits) for content in FRAGMENTS),
        (fits_names, b"", "FITS"),
        *((fits_names, content[:3000], "FITS") for content in TABLES),
        *((fits_names, content[:-1000], "FITS") for content in TABLES),
        *((fits_names, content + b"x" * 2880, "FITS") for content in TABLES),
        *((write_card, text, "ASCII|printable") for text in ("Čerenkov", "two\nlines")),
    ],
)
def test_what_is_damaged_or_cannot_be_held_is_refused(call, content, words):
    refused(lambda: call(content), ValueError, words)


def test_the_same_content_gives_the_same_bytes():
    cards = {"VERSION": (1, "layout"), "LONG": "several words, " * 12 + "end"}
    arrays = {"A": np.eye(2), "B": np.ones(3, dtype="f4")}
    more = {"headers": {"A": {"BUNIT": "nm"}}, "comments": ["note"]}
    one, other = (fits_bytes(cards, arrays, "text", **more) for _ in range(2))
    assert one == other
    with open_fits(one) as units:
        header = units[0].header
        assert (header["COMMENT"][0], header["LONG"]) == ("note", cards["LONG"])
        assert (units["A"].header["BUNIT"], units["B"].data.dtype) == ("nm", ">f4")
    read, text = read_fits(one)
    assert (set(read), text) == ({"A", "B"}, "text")
