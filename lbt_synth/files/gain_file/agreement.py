"""Whether a gain file says of its design what the design, rebuilt from its parts, says itself.

A design is its plant, loop, method and gains; all else in a file is computed of these, and is
there for other readers. Nothing of it is believed: it is computed again, and compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lbt_synth.design.record import DesignRecord
from lbt_synth.validation import agree, number

_ARRAYS = 1e-9  # relative, of an entry; and a thousandth of that, of the largest
_NUMBERS = 1e-6  # relative


def require_agreement(found: DesignRecord, expected: DesignRecord) -> None:
    """Refuse a record that lacks something of the expected one, or says something else.

    Entries that no design has are left alone; a certificate is compared by
    :func:`require_certificate`.
    """
    for name, own in expected.arrays.items():
        array = found.arrays[name]
        if array.shape != own.shape:
            raise ValueError(f"{name} must be {own.shape} to match the design; got {array.shape}")
        if not agree(array, own, _ARRAYS):
            apart = float(np.max(np.abs(array - own))) / max(float(np.max(np.abs(own))), 1e-300)
            raise ValueError(
                f"{name} is not what plant, loop and gains make: it differs by {apart:.2g} of its "
                "largest entry"
            )
    for key, value in expected.meta.items():
        if key != "certificate":
            require_same(found.meta[key], value, key)


def require_certificate(found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Refuse a certificate with other norms, checks or limits than the one computed again.

    The values of the checks are rounding to a large part, and are not compared.
    """
    for key in ("gamma", "rms_per_output"):
        require_same(found[key], expected[key], f"certificate.{key}")
    checks, own = ({c["name"]: c for c in cert["checks"]} for cert in (found, expected))
    if unclaimed := checks.keys() - own.keys():
        raise ValueError(f"the design does not claim what was checked: {min(unclaimed)}")
    if missing := own.keys() - checks.keys():
        raise ValueError(f"the certificate lacks a check of the design: {min(missing)}")
    for name in checks:
        require_same(checks[name]["limit"], own[name]["limit"], f"the limit of '{name}'")
        number(checks[name]["value"], f"the value of '{name}'")


def require_same(found: Any, expected: Any, name: str) -> None:
    """Refuse plain metadata that are not the expected ones, numbers to a relative 1e-6."""
    if isinstance(expected, Mapping) and isinstance(found, Mapping):
        for key in expected.keys() | found.keys():
            if key not in expected:
                raise ValueError(f"{name}.{key} is not known")
            if key not in found:
                raise ValueError(f"{name}.{key} is missing")
            require_same(found[key], expected[key], f"{name}.{key}")
        return
    if isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found):
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            require_same(one, other, f"{name}[{i}]")
        return
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in (found, expected))
    same = (
        abs(found - expected) <= _NUMBERS * abs(expected)
        if numbers
        else type(found) is type(expected) and found == expected
    )
    if not same:
        raise ValueError(f"{name} must be {_brief(expected)} for this design; got {_brief(found)}")


def _brief(value: Any) -> str:
    shown = repr(value)
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
