"""Files of records: text tables and FITS, as others write them."""

import struct

import numpy as np
from astropy.io import fits

RATE = 500.0


def write_csv(path, names, columns, *, sign=",", comments=()):
    rows = [*(f"# {line}" for line in comments), sign.join(names)] if names else []
    rows += [sign.join(repr(float(v)) for v in row) for row in np.column_stack(columns)]
    path.write_text("\n".join(rows) + "\n")
    return path


def hdus(path, *units, **cards):
    fits.HDUList([fits.PrimaryHDU(header=fits.Header(cards)), *units]).writeto(path)
    return path


def image(name, data, unit=None, **cards):
    cards |= {"BUNIT": unit} if unit else {}
    return fits.ImageHDU(np.asarray(data), name=name, header=fits.Header(cards))


def csv(path, text=(), **columns):
    return write_csv(path, columns, list(columns.values()), comments=text)


def write_sav(path, **variables):
    """A save file of IDL: C. B. Markwardt, "Unofficial Format Specification for the IDL SAVE File"."""

    def padded(content):
        return content + b"\0" * (-len(content) % 4)

    def variable(name, value):
        head = padded(struct.pack(">i", len(name)) + name.upper().encode())
        if isinstance(value, str):
            content = struct.pack(">5i", 7, 0, 7, len(value), len(value)) + value.encode()
            return head + padded(content)
        array = np.asarray(value, dtype=">f8")
        if array.ndim == 0:
            return head + struct.pack(">3i", 5, 0, 7) + array.tobytes()
        dims = [*array.shape[::-1], *[1] * (8 - array.ndim)]  # the first axis of IDL is the fastest
        counts = array.nbytes, array.size, array.ndim
        content = struct.pack(">10i", 5, 4, 8, 8, *counts, 0, 0, 8) + struct.pack(">8i", *dims)
        return head + content + struct.pack(">i", 7) + array.tobytes()

    content = b"SR\0\4"
    for name, value in variables.items():
        data = variable(name, value)
        content += struct.pack(">4i", 2, len(content) + 16 + len(data), 0, 0) + data
    path.write_bytes(content + struct.pack(">4i", 6, 0, 0, 0))
    return path


def sparta_table(path, gradients, positions, *, seconds, rate=None):
    """A table of loop frames as ESO's SPARTA writes it, with the rate of its loop in the header."""
    whole = np.floor(seconds)
    columns = [
        ("FrameCounter", "J", 7000 + np.arange(len(seconds))),
        ("Seconds", "J", whole),
        ("USeconds", "J", np.round(1e6 * (seconds - whole))),
        ("Gradients", f"{gradients.shape[1]}D", gradients),
        ("HODM_Positions", "60E", np.ones((len(seconds), 60))),
        ("ITTM_Positions", "2D", positions),
        ("Observer", "4A", np.full(len(seconds), "calm")),
    ]
    unit = fits.BinTableHDU.from_columns([fits.Column(n, f, array=a) for n, f, a in columns])
    unit.name = "LoopFrame"
    return hdus(path, unit, **({} if rate is None else {"HIERARCH ESO AOS LOOP RATE": rate}))
