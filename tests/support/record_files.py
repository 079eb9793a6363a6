"""Files of records: text tables and FITS, as others write them."""

import numpy as np
from astropy.io import fits

RATE = 500.0
FRAMES = 60


def write_csv(path, names, columns, *, sign=",", comments=()):
    rows = [*(f"# {line}" for line in comments), sign.join(names)] if names else []
    rows += [sign.join(repr(float(v)) for v in row) for row in np.column_stack(columns)]
    path.write_text("\n".join(rows) + "\n")
    return path


def hdus(path, *units, **cards):
    primary = fits.PrimaryHDU()
    for key, value in cards.items():
        primary.header[key] = value
    fits.HDUList([primary, *units]).writeto(path)
    return path


def image(name, data, unit=None, **cards):
    unit_hdu = fits.ImageHDU(np.asarray(data), name=name)
    if unit:
        unit_hdu.header["BUNIT"] = unit
    for key, value in cards.items():
        unit_hdu.header[key] = value
    return unit_hdu


def csv(path, text=(), **columns):
    rows = [",".join(columns)]
    rows += [",".join(repr(float(v)) for v in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join([*(f"# {line}" for line in text), *rows]) + "\n")
    return path
