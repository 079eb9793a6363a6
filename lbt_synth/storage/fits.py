"""Write arrays as the bytes of a FITS file."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_CARD = 80
LONGEST_HEADER = 2880 * 36  # that is looked through


def has_card(content: bytes, keyword: str) -> bool:
    """Whether the first header of a FITS file has a card of that keyword."""
    mark = keyword.ljust(8).encode() + b"="
    for start in range(0, min(len(content), LONGEST_HEADER), _CARD):
        card = content[start : start + _CARD]
        if card.startswith(mark):
            return True
        if card.startswith(b"END "):
            return False
    return False


def fits_bytes(
    cards: Mapping[str, Any],
    arrays: Mapping[str, Any],
    *,
    headers: Mapping[str, Mapping[str, Any]] | None = None,
    comments: Sequence[str] = (),
) -> bytes:
    """Return a primary HDU of cards and one image HDU per array, each with its checksums.

    The same content gives the same bytes: no date is written.

    Examples
    --------
    >>> import io
    >>> from astropy.io import fits
    >>> from lbt_synth.storage.fits import fits_bytes
    >>> with fits.open(io.BytesIO(fits_bytes({"VERSION": 1}, {"A": [[1.0, 2.0]]}))) as units:
    ...     units["A"].data.tolist()
    [[1.0, 2.0]]
    """
    from astropy.io import fits

    primary = fits.PrimaryHDU()
    primary.header.update(cards)
    for line in comments:
        primary.header.add_comment(line)
    units = [fits.ImageHDU(data=np.array(array), name=name) for name, array in arrays.items()]
    for unit in units:
        unit.header.update((headers or {}).get(unit.name, {}))
    for unit in (primary, *units):  # instead of the time, so that equal contents give equal files
        unit.add_checksum(when="of this unit")
    buffer = io.BytesIO()
    fits.HDUList([primary, *units]).writeto(buffer)
    return buffer.getvalue()
