"""FITS content is refused for what its headers promise, before anything is allocated."""

from __future__ import annotations

import io
import random

import numpy as np
import pytest
from astropy.io import fits
from support.record_files import image

import lbt_synth as lbt
from lbt_synth.storage.fits_structure import check_fits


def table_file(*, sums=True):
    """A table and an image with checksums by astropy, as bytes."""
    rows = fits.BinTableHDU.from_columns(
        [fits.Column(name, "D", array=np.arange(50.0)) for name in ("y_tip", "y_tilt")], name="R"
    )
    units = fits.HDUList([fits.PrimaryHDU(), rows, image("Y", np.arange(9.0))])
    stream = io.BytesIO()
    units.writeto(stream, checksum=sums)
    return stream.getvalue()


def test_checksums_are_those_of_astropy():
    check_fits(table_file())
    check_fits(table_file(sums=False))
    check_fits(table_file() + bytes(2880))


def test_every_flipped_bit_of_an_hdu_with_a_checksum_is_found():
    """But for those in the two keywords and in padding behind END, which hold no content."""
    content, draw = table_file(), random.Random(1)
    for _ in range(400):
        at = draw.randrange(len(content))
        damaged = bytearray(content)
        damaged[at] ^= 1 << draw.randrange(8)
        card = bytes(content[at - at % 80 :][:80])
        if card.startswith((b"CHECKSUM", b"DATASUM")) and at % 80 < 10:
            continue
        with pytest.raises(ValueError, match="is wrong"):
            check_fits(bytes(damaged))


LIES = {
    "NAXIS   =                    2": ["100000000", "-1", "1e99", "3"],
    "TFIELDS =                    2": ["100000000", "-1"],
    "NAXIS2  =                   50": ["100000000000", "51000", "-50"],
    "PCOUNT  =                    0": ["100000000000", "-1"],
    "GCOUNT  =                    1": ["100000000000", "-1"],
}


@pytest.mark.parametrize(("card", "value"), [(c, v) for c, values in LIES.items() for v in values])
@pytest.mark.parametrize(
    ("reader", "name"),
    [
        (lbt.load_record, "a.fits"),
        (lbt.load_gain, "a.fits"),
        (lbt.files.load_telemetry, "a.fits"),
    ],
)
def test_headers_that_promise_what_is_not_there(tmp_path, card, value, reader, name):
    content = table_file(sums=False)
    assert card.encode() in content
    path = tmp_path / name
    path.write_bytes(content.replace(card.encode(), f"{card[:10]}{value:>20}".encode()))
    with pytest.raises(lbt.errors.FileError, match="of its HDU . is wrong"):
        reader(path)


def test_a_second_card_for_the_size_is_refused():
    """Astropy takes the last one and lists its axes one by one, for ever."""
    unit = fits.PrimaryHDU(np.zeros(3))
    unit.header["SPARE"] = 1
    stream = io.BytesIO()
    unit.writeto(stream)
    content = stream.getvalue()
    check_fits(content)
    lie = content.replace(b"SPARE   =                    1", b"NAXIS   =            100000000")
    with pytest.raises(ValueError, match="the second NAXIS of its HDU 0 is wrong"):
        check_fits(lie)


def test_a_compressed_image_larger_than_anything_is_refused():
    stream = io.BytesIO()
    packed = fits.CompImageHDU(np.zeros((4, 4), dtype=np.int16))
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(stream)
    content = stream.getvalue()
    check_fits(content)
    for card, value in ((b"ZNAXIS  =", b"100000000"), (b"ZNAXIS1 =", b"9999999999")):
        at = content.index(card)
        lie = content[: at + 10] + value.rjust(20) + content[at + 30 :]
        with pytest.raises(ValueError, match="is wrong"):
            check_fits(lie)


def test_a_record_with_a_checksum_and_one_flipped_bit_is_refused(tmp_path):
    content = bytearray(table_file())
    content[content.index(b"XTENSION") + 2 * 2880 - 2000] ^= 4  # in the data of the table
    path = tmp_path / "night.fits"
    path.write_bytes(content)
    with pytest.raises(lbt.errors.TelemetryError, match="the checksum of its HDU 1 is wrong"):
        lbt.load_record(path, kind="open_loop", frame_rate_hz=500, unit="nm")


def test_foreign_bytes_are_no_fits():
    for content in (b"", b"SIMPLE", b"SIMPLE  = " + bytes(2870), b"END".ljust(80) * 36):
        if content:
            with pytest.raises(ValueError, match=r"of its HDU 0 is wrong|truncated"):
                check_fits(content)
