"""Write arrays as FITS, of a primary HDU of cards and one image HDU per array.

astropy does the same and more; its import takes longer than most designs (see the decisions on
storage). Tests compare the bytes with those that astropy writes.

Source: FITS Standard 4.0, sections 4.1, 4.2 and 7.1, and its appendix J on checksums.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lbt_synth.storage.fits_structure import (
    CARD,
    ONES,
    ones_complement_sum,
    whole_blocks,
)

_KEYWORD = re.compile(r"[A-Z0-9_-]{1,8}")
_BITS = {"u1": 8, "i2": 16, "i4": 32, "i8": 64, "f4": -32, "f8": -64}  # BITPIX of a type
_PIECE = 33  # characters of a long string in one card: all may be quotes, which are doubled
_LONGEST_TEXT = 67  # of a string in one card, quotes doubled
_LONGEST_NUMBER = 20
_ZERO = ord("0")
_NO_DIGIT = {*range(_ZERO + 10, ord("A")), *range(ord("Z") + 1, ord("a"))}  # not in checksums
_NOTE = "of this unit"  # in place of the time, so that equal contents give equal files


def primary_unit(cards: Mapping[str, Any], comments: Sequence[str] = ()) -> bytes:
    """Return a primary HDU without data: cards, each a value or a pair with a comment."""
    head = {
        "SIMPLE": (True, "conforms to FITS standard"),
        "BITPIX": (8, "array data type"),
        "NAXIS": (0, "number of array dimensions"),
        "EXTEND": True,
    }
    return _unit({**head, **cards}, b"", comments)


def image_unit(name: str, array: npt.NDArray[Any], cards: Mapping[str, Any]) -> bytes:
    """Return an image HDU; its first axis is the last of FITS."""
    if not array.ndim:
        raise ValueError(f"the image {name} needs an axis at least; got a number")
    if array.dtype.str[1:] not in _BITS:
        raise ValueError(f"the image {name} must be of {', '.join(_BITS)}; got {array.dtype}")
    lengths = array.shape[::-1]
    head: dict[str, Any] = {
        "XTENSION": ("IMAGE", "Image extension"),
        "BITPIX": (_BITS[array.dtype.str[1:]], "array data type"),
        "NAXIS": (len(lengths), "number of array dimensions"),
        **{f"NAXIS{i}": length for i, length in enumerate(lengths, start=1)},
        "PCOUNT": (0, "number of parameters"),
        "GCOUNT": (1, "number of groups"),
        "EXTNAME": (name, "extension name"),
    }
    data = array.astype(array.dtype.newbyteorder(">")).tobytes()
    return _unit({**head, **cards}, data, ())


def _unit(cards: Mapping[str, Any], data: bytes, comments: Sequence[str]) -> bytes:
    """Return an HDU with its checksums; as in astropy, the comments come last."""
    data = data.ljust(whole_blocks(len(data)), b"\0")
    of_data = ones_complement_sum(data, 0, len(data))
    remarks = [
        f"COMMENT {line[i : i + CARD - 8]}"
        for line in comments
        for i in range(0, max(len(line), 1), CARD - 8)
    ]

    def header(checksum: str) -> bytes:
        sums = {"CHECKSUM": (checksum, _NOTE), "DATASUM": (str(of_data), _NOTE)}
        pairs = {**cards, **sums}.items()
        lines = [card for keyword, given in pairs for card in _cards(keyword, given)]
        lines += [*remarks, "END"]
        if strange := next((s for s in lines if not (s.isascii() and s.isprintable())), ""):
            raise ValueError(f"a FITS header is of printable ASCII alone; got {strange!r}")
        text = "".join(line.ljust(CARD) for line in lines).encode()
        return text.ljust(whole_blocks(len(text)))

    blank = header("0" * 16)
    total = ones_complement_sum(blank, 0, len(blank)) + of_data
    return header(_checksum_text(total)) + data


def _cards(keyword: str, given: Any) -> list[str]:
    """Return the cards of a value, or of a pair of value and comment."""
    if not _KEYWORD.fullmatch(keyword):
        raise ValueError(f"a keyword has at most 8 of A-Z, 0-9, _ and -; got {keyword!r}")
    value, comment = given if isinstance(given, tuple) else (given, "")
    end = f" / {comment}" if comment else ""
    if not isinstance(value, str):
        return [f"{keyword:8}= {_number_text(value):>20}{end}"[:CARD]]
    quoted = value.replace("'", "''")
    if len(quoted) <= _LONGEST_TEXT:
        text = f"'{quoted:8}'" if quoted else "''"
        return [f"{keyword:8}= {text:20}{end}"[:CARD]]
    pieces = [value[i : i + _PIECE].replace("'", "''") for i in range(0, len(value), _PIECE)]
    starts = [f"{keyword:8}= ", *["CONTINUE  "] * len(pieces)]
    lines = [*(f"{piece}&" for piece in pieces), ""]
    cards = [f"{start}'{line}'" for start, line in zip(starts, lines, strict=True)]
    return [*cards[:-1], f"{cards[-1]}{end}"[:CARD]]


def _number_text(value: Any) -> str:
    """Return a logical value, an integer, or a float of at most 20 characters."""
    if isinstance(value, bool | np.bool_):
        return "T" if value else "F"
    if isinstance(value, int | np.integer):
        return str(int(value))
    if not np.isfinite(value):
        raise ValueError(f"a number of a FITS header is finite; got {value}")
    mantissa, letter, exponent = repr(float(value)).upper().partition("E")
    return mantissa[: _LONGEST_NUMBER - len(letter + exponent)] + letter + exponent


def _checksum_text(total: int) -> str:
    """Return the 16 letters and digits that make the sum of an HDU zero, given what it is."""
    text = bytearray(16)
    while total >> 32:
        total = (total & ONES) + (total >> 32)
    for place, byte in enumerate((total ^ ONES).to_bytes(4, "big")):
        quarter, rest = divmod(byte, 4)
        parts = [quarter + rest + _ZERO, *[quarter + _ZERO] * 3]
        for i in (0, 2):
            while not _NO_DIGIT.isdisjoint(parts[i : i + 2]):
                parts[i], parts[i + 1] = parts[i] + 1, parts[i + 1] - 1
        text[place::4] = bytes(parts)
    return (text[-1:] + text[:-1]).decode("ascii")
