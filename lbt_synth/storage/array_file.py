"""Arrays with a text of metadata in one file, FITS or NPZ, and a digest of both.

What reads bytes of another format raises ``ValueError`` or ``KeyError``; the caller turns that into
an error of its own.
"""

from __future__ import annotations

import hashlib
import io
import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, BinaryIO
from zipfile import ZipFile

import numpy as np
import numpy.typing as npt

from lbt_synth.storage.input_files import LARGEST_BYTES
from lbt_synth.storage.warning_filters import ignore_warnings
from lbt_synth.validation import FloatArray

Cards = Mapping[str, tuple[Any, str]]
TEXT = "META"
_CHECKSUM_NOTE = "of this unit"  # in place of the time, so that equal contents give equal files


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
    primary_data: FloatArray | None = None,
) -> bytes:
    """Return a primary HDU of cards, and one image HDU per array and for the text, with checksums.

    The same content gives the same bytes: no date is written.
    """
    from astropy.io import fits

    primary = fits.PrimaryHDU(primary_data)
    primary.header.update(cards)
    for line in comments:
        primary.header.add_comment(line)
    units = fits.HDUList([primary])
    for name, array in (arrays if text is None else _with_text(arrays, text)).items():
        units.append(fits.ImageHDU(np.array(array, order="C"), name=name))
        units[-1].header.update((headers or {}).get(name, {}))
    for unit in units:
        unit.add_checksum(when=_CHECKSUM_NOTE)
    buffer = io.BytesIO()
    units.writeto(buffer, output_verify="exception")
    return buffer.getvalue()


@contextmanager
def open_fits(content: bytes, **options: Any) -> Iterator[Any]:
    """Open FITS content; what is cut or belies a checksum raises a ValueError."""
    from astropy.io import fits

    if not content.startswith(b"SIMPLE  ="):  # astropy would unpack other formats
        raise ValueError("it does not begin as FITS files do")
    with ignore_warnings():  # foreign headers deviate in many small ways
        try:
            units = fits.open(io.BytesIO(content), memmap=False, lazy_load_hdus=False, **options)
            sums = [_is_whole(unit, content) for unit in units]
            rest = units[-1].fileinfo()
        except Exception as error:  # astropy raises many kinds on damaged files
            raise ValueError("its FITS structure is broken") from error
        if not all(sums):
            raise ValueError(f"the checksum of its HDU {sums.index(False)} is wrong")
        if content[rest["datLoc"] + rest["datSpan"] :].strip(b"\0 "):
            raise ValueError(f"what follows its HDU {len(units) - 1} is no FITS")
        with units:
            yield units


def _is_whole(unit: Any, content: bytes) -> bool:
    """Whether an HDU is within the content, and has the checksums of its header."""
    place = unit.fileinfo()
    if place["datLoc"] + place["datSpan"] > len(content):
        raise ValueError("it is truncated")
    return "DATASUM" not in unit.header or bool(unit.verify_datasum() and unit.verify_checksum())


def read_fits(content: bytes) -> tuple[dict[str, FloatArray], str]:
    """Read the arrays and the text of :func:`fits_bytes`."""
    with open_fits(content) as units:
        pairs = [(unit.name, np.array(unit.data)) for unit in units[1:]]
    if len(dict(pairs)) != len(pairs):  # readers differ in which of two they take
        raise ValueError("two of its HDUs have one name")
    return _split_text(dict(pairs))


def read_cards(stream: BinaryIO, names: Iterable[str]) -> dict[str, Any]:
    """Read cards of the primary header of a FITS file, those that are there."""
    from astropy.io import fits

    with ignore_warnings():
        try:
            header = fits.Header.fromfile(stream)
            return {name: header[name] for name in names if name in header}
        except Exception as error:  # astropy raises many kinds on damaged files
            raise ValueError("its FITS header is broken") from error


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


def read_matlab(content: bytes) -> dict[str, Any]:
    """Read the variables of MATLAB before version 7.3, which is HDF5; structures are mappings."""
    from scipy.io import loadmat

    stream: Any = io.BytesIO(content)  # which its types do not know
    return dict(loadmat(stream, simplify_cells=True))


def read_idl(content: bytes) -> dict[str, Any]:
    """Read the variables of IDL, whose first axis is the last one here."""
    from scipy.io import readsav

    with tempfile.NamedTemporaryFile(suffix=".sav") as file, ignore_warnings():
        file.write(content)
        file.flush()
        return dict(readsav(file.name, python_dict=True))


def is_hdf5(content: bytes) -> bool:
    """Whether content begins as HDF5 does, or behind a block of 512 bytes, as of MATLAB 7.3."""
    return b"\x89HDF\r\n\x1a\n" in content[:1024]


def read_hdf5(content: bytes) -> dict[str, Any]:
    """Read data sets by their paths, empty if in another file, and attributes behind ``@``."""
    try:
        import h5py
    except ImportError as error:
        raise ValueError('it needs h5py: pip install "lbt-synth[hdf5]"') from error
    out: dict[str, Any] = {}

    def add(path: str, item: Any) -> None:
        for key, value in item.attrs.items():
            out[f"{path}@{key}"] = value.decode() if isinstance(value, bytes) else value
        if not isinstance(item, h5py.Dataset) or path[0] == "#":  # of MATLAB's cells
            return
        is_elsewhere, kind = item.external or item.is_virtual, item.attrs.get("MATLAB_class")
        series = np.empty(0) if is_elsewhere else item[()]
        if kind is not None:  # its columns come first
            series = series.T if kind != b"char" else "".join(map(chr, np.ravel(series)))
        out[path] = series

    with h5py.File(io.BytesIO(content)) as file:
        add("", file)
        file.visititems(add)  # which follows no links
    return out


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


def error_reason(error: Exception) -> str:
    """Return the message of an error, in one line without its full stop."""
    if isinstance(error, KeyError):
        return f"{error.args[0]} is missing".rstrip(".")
    return str(error).split("\n")[0].rstrip(".") or type(error).__name__
