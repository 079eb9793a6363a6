"""Names of parameters that fit a table."""

from __future__ import annotations

from collections.abc import Sequence


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return for each path its last keys, as many as it takes to tell it from the others.

    Examples
    --------
    >>> from lbt_synth.studies.study.table_names import short_names
    >>> found = short_names(
    ...     ["truth.vibrations[0].rms_mas", "truth.vibrations[1].rms_mas", "truth.sensor_gain"]
    ... )
    >>> list(found.values())
    ['vibrations[0].rms_mas', 'vibrations[1].rms_mas', 'sensor_gain']
    """
    out = {}
    for name in names:
        keys = name.split(".")
        for count in range(1, len(keys) + 1):
            short = ".".join(keys[-count:])
            if sum(other == short or other.endswith(f".{short}") for other in names) == 1:
                break
        out[name] = short
    return out
