"""The structure of FITS content, checked before astropy reads it.

Source: FITS Standard 4.0, sections 3.3, 4.4 and 7.3, and its appendix J on checksums.
"""

from __future__ import annotations

import math

import numpy as np

from lbt_synth.storage.input_files import LARGEST_BYTES

BLOCK, CARD = 2880, 80
_MOST = {"NAXIS": 999, "ZNAXIS": 999, "TFIELDS": 999}  # the standard's own limits
_ONCE = {*_MOST, "BITPIX", "ZBITPIX", "GCOUNT", "PCOUNT", "DATASUM", "CHECKSUM"}
_MOST_CARDS = 20_000  # of one header
_MOST_UNITS = 5_000
ONES = 2**32 - 1


def check_fits(content: bytes) -> None:
    """Refuse content that lacks what its headers promise, or belies a checksum, by ValueError.

    The time is linear in the size of the content, whatever the headers say.

    Examples
    --------
    >>> from lbt_synth.storage.array_file import fits_bytes
    >>> from lbt_synth.storage.fits_structure import check_fits
    >>> content = fits_bytes({}, {"A": [1.0, 2.0]})
    >>> check_fits(content)
    >>> check_fits(content[:-1] + b"!")
    Traceback (most recent call last):
        ...
    ValueError: the checksum of its HDU 1 is wrong
    """
    if len(content) % BLOCK:
        raise ValueError(f"it is truncated: {len(content)} bytes are not whole blocks of {BLOCK}")
    start, number = 0, 0
    while start < len(content) and (number == 0 or content[start:].strip(b"\0 ")):
        if number == _MOST_UNITS:
            raise ValueError(f"it has more than {_MOST_UNITS} HDUs")
        try:
            start = _check_unit(content, start, b"XTENSION= " if number else b"SIMPLE  = ")
        except ValueError as error:
            raise ValueError(f"{error} of its HDU {number} is wrong") from error
        number += 1


def _check_unit(content: bytes, start: int, first: bytes) -> int:
    """Check an HDU and return where it ends; a ValueError names what is wrong."""
    if not content.startswith(first, start):
        raise ValueError("the first card")
    cards, data = _read_header(content, start)
    stop = data + whole_blocks(_data_bytes(cards))
    if stop > len(content):
        raise ValueError("the size")
    of_data = ones_complement_sum(content, data, stop)
    sums = {name: cards.get(name, "").strip("' ") for name in ("DATASUM", "CHECKSUM")}
    total = ones_complement_sum(content, start, data) + of_data
    if (sums["DATASUM"] and sums["DATASUM"] != str(of_data)) or (
        sums["CHECKSUM"] and total % ONES != 0
    ):
        raise ValueError("the checksum")
    return stop


def _read_header(content: bytes, start: int) -> tuple[dict[str, str], int]:
    """Return the texts of the values by their keywords, and where the data begin."""
    cards: dict[str, str] = {}
    for at in range(start, start + _MOST_CARDS * CARD, CARD):
        card = content[at : at + CARD]
        if card.rstrip() == b"END":
            return cards, start + whole_blocks(at + CARD - start)
        if card[8:10] == b"= ":
            keyword = card[:8].decode("latin-1").rstrip()
            if keyword in cards and keyword.rstrip("0123456789") in _ONCE:
                raise ValueError(f"the second {keyword}")  # readers differ in which counts
            cards[keyword] = card[10:].split(b"/")[0].decode("latin-1").strip()
    raise ValueError("the end of the header")


def _data_bytes(cards: dict[str, str]) -> int:
    """Return the size of the data of an HDU without padding; refuse impossible numbers."""
    item = abs(_read_integer(cards, "BITPIX", 8)) // 8
    for keyword, most in _MOST.items():
        count = _read_integer(cards, keyword, 0)
        if not 0 <= count <= min(most, len(cards)):
            raise ValueError(keyword)
    lengths = _axes(cards, "NAXIS")
    if lengths[:1] == [0] and "GROUPS" in cards:
        lengths = lengths[1:]
    image = math.prod(lengths) if lengths else 0
    packed = _axes(cards, "ZNAXIS")
    if packed and math.prod(packed) * abs(_read_integer(cards, "ZBITPIX", 8)) > 8 * LARGEST_BYTES:
        raise ValueError("the size")
    groups, more = _read_integer(cards, "GCOUNT", 1), _read_integer(cards, "PCOUNT", 0)
    if groups < 0 or more < 0:
        raise ValueError("GCOUNT or PCOUNT")
    return item * groups * (more + image)


def _axes(cards: dict[str, str], keyword: str) -> list[int]:
    """Return the lengths of the axes of an image or table."""
    count = _read_integer(cards, keyword, 0)
    lengths = [_read_integer(cards, f"{keyword}{i + 1}", -1) for i in range(count)]
    if min(lengths, default=0) < 0:
        raise ValueError(keyword)
    return lengths


def _read_integer(cards: dict[str, str], keyword: str, default: int) -> int:
    text = cards.get(keyword, str(default))
    if len(text) > 20 or not text.lstrip("+-").isdecimal():
        raise ValueError(keyword)
    return int(text)


def whole_blocks(size: int) -> int:
    """Return a size rounded up to whole blocks."""
    return -(-size // BLOCK) * BLOCK


def ones_complement_sum(content: bytes, start: int, stop: int) -> int:
    """Return the sum of the words of blocks, with the carry added at the other end."""
    words = np.frombuffer(content, dtype=">u4", offset=start, count=(stop - start) // 4)
    total = int(words.sum(dtype=np.uint64))
    while total >> 32:
        total = (total & ONES) + (total >> 32)
    return total
