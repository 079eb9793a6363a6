"""Arrays with a text of metadata in one file, FITS or NPZ, and a digest of both.

Each ``read_*`` raises ``ValueError``, ``KeyError`` or ``OSError`` on bytes of another format;
the caller turns that into an error of its own.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from zipfile import ZipFile

import numpy as np
import numpy.typing as npt

from lbt_synth.storage.fits_structure import CARD, check_fits
from lbt_synth.storage.fits_writer import image_unit, primary_unit
from lbt_synth.storage.input_files import LARGEST_BYTES
from lbt_synth.validation import FloatArray

Cards = Mapping[str, tuple[Any, str]]
TEXT = "META"
LONGEST_HEADER = 2880 * 36  # that is looked through


def digest(arrays: Mapping[str, npt.NDArray[Any]], meta: Mapping[str, Any]) -> str:
    """SHA-256 over all arrays and all metadata but the digest itself."""
    plain = {key: value for key, value in meta.items() if key != "digest"}
    total = hashlib.sha256(json.dumps(plain, sort_keys=True, allow_nan=False).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name], dtype="<f8")
        total.update(f"|{name}|{array.shape}|".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def fits_bytes(
    cards: Mapping[str, Any],
    arrays: Mapping[str, Any],
    text: str | None = None,
    *,
    headers: Mapping[str, Mapping[str, Any]] | None = None,
    comments: Sequence[str] = (),
) -> bytes:
    """Return a primary HDU of cards, and one image HDU per array and for the text, with checksums.

    The same content gives the same bytes: no date is written.

    Examples
    --------
    >>> import io
    >>> from astropy.io import fits
    >>> from lbt_synth.storage.array_file import fits_bytes
    >>> with fits.open(io.BytesIO(fits_bytes({"VERSION": 1}, {"A": [[1.0, 2.0]]}))) as units:
    ...     units["A"].data.tolist()
    [[1.0, 2.0]]
    """
    arrays = arrays if text is None else _with_text(arrays, text)
    units = [
        image_unit(name, np.asarray(array), (headers or {}).get(name, {}))
        for name, array in arrays.items()
    ]
    return b"".join([primary_unit(cards, comments), *units])


def read_fits(content: bytes) -> tuple[dict[str, FloatArray], str]:
    """Read the arrays and the text of :func:`fits_bytes`."""
    from astropy.io import fits

    check_fits(content)
    try:
        with fits.open(io.BytesIO(content), memmap=False, lazy_load_hdus=False) as units:
            pairs = [(unit.name, np.array(unit.data)) for unit in units[1:]]
    except Exception as error:  # astropy raises many kinds on damaged files
        raise ValueError("its FITS structure is broken") from error
    if len(dict(pairs)) != len(pairs):  # readers differ in which of two they take
        raise ValueError("two of its HDUs have one name")
    return _split_text(dict(pairs))


def read_cards(content: bytes, names: Iterable[str]) -> dict[str, Any]:
    """Read cards of the primary header of a FITS file, those that are there."""
    from astropy.io import fits

    header = fits.Header.fromfile(io.BytesIO(content))
    return {name: header[name] for name in names if name in header}


def npz_bytes(arrays: Mapping[str, npt.NDArray[Any]], text: str) -> bytes:
    """Write a NumPy archive; the text is an array of bytes, so nothing is pickled."""
    buffer = io.BytesIO()
    np.savez(buffer, **_with_text(arrays, text))
    return buffer.getvalue()


def read_npz(content: bytes) -> tuple[dict[str, FloatArray], str]:
    """Read the arrays and the text of :func:`npz_bytes`."""
    if not is_archive(content):
        raise ValueError("it is not a NumPy archive")
    return _split_text(read_numpy(content))


def is_archive(content: bytes) -> bool:
    """Whether content begins as a ZIP archive does."""
    return content.startswith(b"PK\x03\x04")


def read_numpy(content: bytes) -> dict[str, npt.NDArray[Any]]:
    """Read the arrays of a NumPy archive by their names, or the one of an NPY file as ``""``."""
    if not is_archive(content) and not content.startswith(b"\x93NUMPY"):
        raise ValueError("it begins as neither an NPY file nor a ZIP archive does")
    try:
        if not is_archive(content):
            return {"": np.load(io.BytesIO(content), allow_pickle=False)}
        _require_small(ZipFile(io.BytesIO(content)))
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return {name: np.asarray(arrays[name]) for name in arrays.files}
    except Exception as error:  # zip, zlib and NumPy each raise their own kinds
        raise ValueError(f"its NumPy arrays are broken: {error_reason(error)}") from error


def _require_small(archive: ZipFile) -> None:
    """Refuse an archive that unpacks to more than is read, or names two members alike."""
    members = archive.infolist()
    if sum(member.file_size for member in members) > LARGEST_BYTES:
        raise ValueError(f"it unpacks to more than {LARGEST_BYTES >> 20} MB")
    if len({member.filename for member in members}) != len(members):
        raise ValueError("two of its arrays have one name")


def _with_text(arrays: Mapping[str, Any], text: str) -> dict[str, Any]:
    return {**arrays, TEXT: np.frombuffer(text.encode(), dtype=np.uint8)}


def _split_text(data: dict[str, npt.NDArray[Any]]) -> tuple[dict[str, FloatArray], str]:
    text = data.pop(TEXT).astype(np.uint8).tobytes().decode()
    for name, array in data.items():
        if array.dtype.kind not in "fiub":
            raise ValueError(f"{name} holds no real numbers")
    return {name: array.astype(np.float64) for name, array in data.items()}, text


def has_card(content: bytes, keyword: str) -> bool:
    """Whether the first header of a FITS file has a card of that keyword."""
    mark = keyword.ljust(8).encode() + b"="
    for start in range(0, min(len(content), LONGEST_HEADER), CARD):
        card = content[start : start + CARD]
        if card.startswith(mark):
            return True
        if card.startswith(b"END "):
            return False
    return False


def error_reason(error: Exception) -> str:
    """Return the message of an error, in one line without its full stop."""
    if isinstance(error, KeyError):
        return f"{error.args[0]} is missing".rstrip(".")
    return str(error).split("\n")[0].rstrip(".") or type(error).__name__
