"""FITS files are those that astropy writes, byte for byte, and astropy reads long strings whole."""

from __future__ import annotations

import io

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st

from lbt_synth.storage.array_file import fits_bytes
from lbt_synth.storage.fits_structure import check_fits
from lbt_synth.storage.fits_writer import image_unit, primary_unit

CARDS = {
    "VERSION": (1, "layout of the HDUs A, B, C, D"),
    "NEWSTATE": (True, "u(k) = C x(k+1) + D y(k)"),
    "OFF": np.bool_(False),
    "EMPTY": "",
    "QUOTE": ("it's", "the telescope's"),
    "METHOD": "kalman",
    "LONGEST": "x" * 67,
    "RATE_HZ": (800.0, "[Hz] frame rate"),
    "TINY": -1.2345678901234567e-107,
    "THIRD": 1 / 3,
    "HUGE": np.float64(2.0**70),
    "COUNT": np.int64(-(2**62)),
}
ARRAYS = {
    "A": np.arange(6.0).reshape(2, 3) - 1 / 3,
    "SMALL": np.array([[1.5, -2.5]], dtype=np.float32),
    "COUNTS": np.array([3, -4], dtype=np.int64),
    "INTS": np.arange(2000, dtype=np.int32),
    "SHORT": np.array([-1, 7], dtype=np.int16),
    "CUBE": np.linspace(0, 1, 24).reshape(2, 3, 4),
    "LOOKED": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
}


def by_astropy(cards, arrays, text, headers, comments):
    """Write the same with astropy."""
    primary = fits.PrimaryHDU()
    primary.header.update(cards)
    for line in comments:
        primary.header.add_comment(line)
    everything = {**arrays, "META": np.frombuffer(text.encode(), dtype=np.uint8)}
    units = [fits.ImageHDU(data=np.array(a, order="C"), name=n) for n, a in everything.items()]
    for unit in units:
        unit.header.update(headers.get(unit.name, {}))
    for unit in (primary, *units):
        unit.add_checksum(when="of this unit")
    buffer = io.BytesIO()
    fits.HDUList([primary, *units]).writeto(buffer)
    return buffer.getvalue()


def test_the_bytes_are_those_of_astropy():
    headers = {"A": {"BUNIT": ("nm", "rms of wavefront"), "CONTENT": "what was seen"}}
    comments = ["short", "loop: " + "a long line of words " * 9, "y" * 144]
    found = fits_bytes(CARDS, ARRAYS, "the text", headers=headers, comments=comments)
    assert found == by_astropy(CARDS, ARRAYS, "the text", headers, comments)
    check_fits(found)


@settings(max_examples=60, deadline=None)
@given(
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(alphabet=st.characters(min_codepoint=32, max_codepoint=126), max_size=60),
    st.lists(st.floats(width=64, allow_nan=False), min_size=1, max_size=9),
)
def test_any_values_have_the_bytes_of_astropy(number, words, values):
    words = words.replace("'", "").rstrip()
    cards, arrays = {"NUMBER": (number, "any"), "WORDS": words}, {"X": np.array(values)}
    assert fits_bytes(cards, arrays, "t") == by_astropy(cards, arrays, "t", {}, [])


@pytest.mark.parametrize("value", ["p" * 200, "'" * 90, "several words, " * 12 + "it's"])
def test_long_strings_go_on_in_further_cards(value):
    content = fits_bytes({"LONG": (value, "of many characters"), "NEXT": 1}, {})
    check_fits(content)
    header = fits.Header.fromstring(content.decode())
    assert header["LONG"] == value
    assert header.comments["LONG"] == "of many characters"
    assert header["NEXT"] == 1


def test_a_long_comment_is_cut_at_the_end_of_its_card():
    header = fits.Header.fromstring(fits_bytes({"N": (1, "c" * 90)}, {}).decode())
    assert header["N"] == 1
    assert header.comments["N"] == "c" * (80 - 33)


@pytest.mark.parametrize("text", ["Čerenkov", "two\nlines"])
def test_what_is_no_printable_ascii_is_refused(text):
    with pytest.raises(ValueError, match="printable ASCII"):
        fits_bytes({"NAME": text}, {})


@pytest.mark.parametrize(
    ("cards", "match"),
    [
        ({"K": float("nan")}, "finite"),
        ({"K": float("-inf")}, "finite"),
        ({"LONGKEYWORD": 1}, "keyword"),
        ({"lower": 1}, "keyword"),
    ],
)
def test_cards_that_are_not_fits_are_refused(cards, match):
    with pytest.raises(ValueError, match=match):
        primary_unit(cards)


@pytest.mark.parametrize(
    "array", [np.array(5.0), np.zeros(2, dtype="u2"), np.zeros(2, dtype="c16")]
)
def test_arrays_that_are_not_written_are_refused(array):
    with pytest.raises(ValueError, match="an axis|must be of"):
        image_unit("A", array, {})
