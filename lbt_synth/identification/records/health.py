"""The health of a record: faults that were found, and a table of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.validation import BoolArray

HEADINGS = ("finding", "series", "axis", "frames", "%", "first frame", "effect")


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One kind of fault in one series.

    Attributes
    ----------
    kind : str
        "missing", "repeated", "not finite", "stuck", "saturated", "outlier", "loop open",
        "held" or "correction not known".
    series : str
        "measurements", "commands" or "frames".
    axis : int or None
        Axis from 0; None for all axes.
    count : int
        Frames.
    first_frame : int
        The first of them.
    fraction : float
        Their part of all frames.
    spoils : bool
        Whether these frames are not usable; otherwise they are only reported.
    """

    kind: str
    series: str
    axis: int | None
    count: int
    first_frame: int
    fraction: float
    spoils: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordHealth:
    """What was found in a record.

    Attributes
    ----------
    frames, usable : int
        All frames, and those that count as data.
    findings : tuple of Finding
        The faults; empty for a clean record.
    notes : tuple of str
        How a file was read, what was repaired, what changes with time.
    bridged : int
        Frames that were interpolated.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> seen = lbt.identification.loop_record(
    ...     [1.0, 3.0, float("nan"), 2.0], frame_rate_hz=500, unit="nm"
    ... )
    >>> for row in seen.health.rows():
    ...     print(row)
    ('not finite', 'measurements', 0, 1, 25.0, 2, 'spoilt')
    """

    frames: int
    usable: int
    findings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()
    bridged: int = 0

    @property
    def clean(self) -> bool:
        """Whether nothing was found that spoils a frame."""
        return not any(found.spoils for found in self.findings)

    def rows(self) -> tuple[tuple[str, str, int | None, int, float, int, str], ...]:
        """Return a row per finding, under the headings ``HEADINGS`` of this module."""
        return tuple(
            (
                found.kind,
                found.series,
                found.axis,
                found.count,
                round(100 * found.fraction, 4),
                found.first_frame,
                "spoilt" if found.spoils else "reported",
            )
            for found in self.findings
        )

    def summary(self) -> str:
        """Return one line: how many frames are usable, and why the others are not."""
        text = f"{self.usable} of {self.frames} frames are usable"
        spoilt = [f"{f.count} {f.kind} ({f.series})" for f in self.findings if f.spoils]
        return f"{text}; {', '.join(spoilt)}." if spoilt else f"{text}."


def findings_in(
    found: BoolArray, kind: str, series: str, axis: int | None = None, *, spoils: bool = True
) -> tuple[Finding, ...]:
    """Return the finding of a fault in some frames, (frames,); none where there are none."""
    where = np.flatnonzero(found)
    if not where.size:
        return ()
    only = Finding(
        kind=kind,
        series=series,
        axis=axis,
        count=where.size,
        first_frame=int(where[0]),
        fraction=where.size / len(found),
        spoils=spoils,
    )
    return (only,)


def merge_notes(*parts: Sequence[str]) -> tuple[str, ...]:
    """Return the notes of all parts in their order, each once."""
    return tuple(dict.fromkeys(note for part in parts for note in part))
