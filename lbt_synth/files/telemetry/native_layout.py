"""The package's own layout of a telemetry file: named arrays, metadata and FITS cards."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

import lbt_synth
from lbt_synth.errors import ProblemError
from lbt_synth.files.telemetry.fields import FACTS, LAYERS, REQUIRED
from lbt_synth.files.telemetry.telemetry import Telemetry
from lbt_synth.linear import Controller
from lbt_synth.models import PositionLoop
from lbt_synth.storage.array_file import Cards
from lbt_synth.validation import FloatArray

SCHEMA = "lbt_synth telemetry"
SCHEMA_VERSION = 1
PRECISIONS = ("float64", "float32")
Arrays = dict[str, npt.NDArray[Any]]
Meta = dict[str, Any]
_SAME_TAPS = 1e-9  # largest difference between the taps of a file and those of its mirror
_LARGEST_CARD = 2**63 - 1


def pack(telemetry: Telemetry, precision: str) -> tuple[Arrays, Meta]:
    """Return the arrays and the metadata; ``precision`` is that of the series."""
    arrays: Arrays = {}
    for name, layer in LAYERS.items():
        if (value := getattr(telemetry, layer.field)) is None:
            continue
        arrays[name] = value
        if precision == "float32" and layer.is_series and layer.field != "times_s":
            with np.errstate(over="ignore"):
                arrays[name] = value.astype(np.float32)
            if not np.all(np.isfinite(arrays[name])):
                raise ProblemError(
                    f"{layer.field} has values beyond the range of float32; write float64."
                )
    meta: Meta = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "library_version": lbt_synth.__version__,
        "convention": telemetry.convention,
        **{name: getattr(telemetry, name) for name in FACTS},
        "metadata": dict(telemetry.metadata),
    }
    if (k := telemetry.controller) is not None:
        arrays |= {f"CTRL_{name}": getattr(k, name) for name in "ABCD"}
        meta["controller_dt_s"] = k.dt_s
    if telemetry.mirror is not None:
        meta["mirror"] = asdict(telemetry.mirror)
    return arrays, meta


def unpack(arrays: dict[str, FloatArray], meta: Meta) -> Telemetry:
    """Rebuild telemetry; missing keys raise KeyError, what does not fit a ProblemError."""
    left = dict(arrays)
    fields: dict[str, Any] = {
        layer.field: left.pop(name)
        for name, layer in LAYERS.items()
        if name in left or layer.field in REQUIRED
    }
    if "controller_dt_s" in meta:
        fields["controller"] = Controller(
            **{name: left.pop(f"CTRL_{name}") for name in "ABCD"}, dt_s=meta["controller_dt_s"]
        )
    if left:
        raise ValueError(f"it has arrays that no telemetry has: {', '.join(sorted(left))}")
    taps = fields.pop("mirror_taps", None)
    if "mirror" in meta:  # a mirror that settles at once is not in the file
        fields["mirror"] = PositionLoop(**meta["mirror"])
    fields |= {name: meta[name] for name in FACTS}
    return check_taps(Telemetry(**fields, metadata=dict(meta["metadata"])), taps)


def check_taps(telemetry: Telemetry, taps: npt.ArrayLike | None) -> Telemetry:
    """Return telemetry, or refuse it if its mirror does not have the taps of its file."""
    own = telemetry.mirror_taps
    if (own is None) != (taps is None):
        raise ValueError("a mirror and its taps go together; it has one of them")
    if own is not None and taps is not None:
        found = np.asarray(taps, dtype=np.float64)
        size = max(own.size, found.size)
        one, other = (np.pad(each.ravel(), (0, size - each.size)) for each in (own, found))
        if not np.allclose(one, other, rtol=0, atol=_SAME_TAPS):
            raise ValueError("its taps are not those of its mirror")
    return telemetry


def primary_cards(telemetry: Telemetry, meta: Meta) -> dict[str, tuple[Any, str]]:
    """Cards for people who look at the header; META is what is read back."""
    cards: dict[str, tuple[Any, str]] = {
        "CREATOR": (f"lbt_synth {meta['library_version']}", "writer of this file"),
        "LBTTELEM": (SCHEMA_VERSION, "version of the lbt_synth telemetry layout"),
    }
    for name, fact in FACTS.items():
        value = getattr(telemetry, name)
        too_large = isinstance(value, int) and value > _LARGEST_CARD
        if fact.card and value is not None and not too_large:
            cards[fact.card] = (value, fact.comment)
    cards["TIMING"] = (telemetry.convention, "")
    cards["SHA256"] = (meta["digest"], "")
    return cards


def layer_cards(telemetry: Telemetry) -> dict[str, Cards]:
    """Cards of each array: unit, meaning, axes."""
    out: dict[str, Cards] = {}
    for name, layer in LAYERS.items():
        cards: dict[str, tuple[Any, str]] = {}
        if unit := layer.unit_in(telemetry):
            cards["BUNIT"] = (unit, "rms of wavefront" if unit == "nm" else "")
        cards["CONTENT"] = (layer.meaning, "")
        for number, axis in enumerate(reversed(layer.axes.split(", ")), start=1):
            cards[f"CTYPE{number}"] = (axis.upper(), "")  # FITS counts axes from the fastest
        out[name] = cards
    return out
