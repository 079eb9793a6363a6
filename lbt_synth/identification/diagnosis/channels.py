"""The channels of a record, one by one: clipped, stuck, dead, drifting and noisy ones."""

from __future__ import annotations

import numpy as np

from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.storage.rows import column, nm_column, table_row
from lbt_synth.validation import BoolArray, FloatArray

AXES = ("tip", "tilt")
_DEAD = 0.5  # of the frames, on one value
_NOISIER = 3.0  # times the other axis
_CHANGED = 2.0  # ratio of the scatter at the ends of the record
_LEAST_QUARTER = 64  # frames
_FEW = 0.01  # of the frames, with a fault
DEAD = "dead"
_WHOLE = ("noisy", "drifting", "scatter changes")  # what concerns the whole channel
_WORDS = {"saturated": "clipped", "stuck": "stuck", "outlier": "outliers", "held": "held"}


@table_row
class ChannelRow:
    """One channel of a record."""

    channel: str = column("channel", help="What it is")
    rms_nm: float = nm_column("rms", help="Deviation from its mean")
    step_nm: float = column(
        "frame to frame", unit="nm", format=".3g", help="Rms difference of two frames"
    )
    mean_nm: float = column(unit="nm", help="Mean")
    drift_nm: float = nm_column("drift", help="Mean of the last quarter less that of the first")
    change: float = column(
        "scatter, end/start", format=".2f", help="Rms difference, last quarter over first"
    )
    faulty: float = column(help="Part of the frames with a fault of this channel")
    state: str = column("state", help="What is wrong with it, or good")

    @property
    def serious(self) -> bool:
        """Whether something is wrong with it that more than a few frames have."""
        return self.state == DEAD or self.faulty > _FEW or any(map(self.state.count, _WHOLE))


def judge_channels(record: LoopRecord) -> tuple[ChannelRow, ...]:
    """Return what is known of each channel of a record, the measurements first."""
    names = AXES if record.axes == len(AXES) else ("",)
    measured = record.usable if record.measured is None else record.measured
    everything = np.ones(record.frames, dtype=np.bool_)
    commanded = everything if record.commanded is None else record.commanded
    closed = record.commands is not None
    rows = _judge_series(record, "measurements", record.measurements, measured, names, closed)
    if record.commands is not None:
        rows += _judge_series(record, "commands", record.commands, commanded, names, closed)
    return tuple(rows)


def live_axes(record: LoopRecord) -> list[int]:
    """Return the axes whose measurements are not dead."""
    rows = judge_channels(record)[: record.axes]
    return [axis for axis, row in enumerate(rows) if row.state != DEAD]


def _judge_series(
    record: LoopRecord,
    series: str,
    values: FloatArray,
    good: BoolArray,
    names: tuple[str, ...],
    closed: bool,
) -> list[ChannelRow]:
    steps = [_step_rms(one, good) for one in values.T]
    rows = []
    for axis, one in enumerate(values.T):
        found = [
            each
            for each in record.health.findings
            if each.series == series and each.axis == axis and each.kind in _WORDS
        ]
        here = one[good] if good.any() else one
        first, last = _quarters(good)
        ends = [_step_rms(one, part) for part in (first, last)]
        change = ends[1] / ends[0] if ends[0] > 0 else np.nan
        drift = float(np.mean(one[last]) - np.mean(one[first])) if last.any() else np.nan
        held = sum(each.fraction for each in found if each.kind in ("stuck", "held"))
        words = [f"{_WORDS[each.kind]} ({_percent(each.fraction)})" for each in found]
        if np.ptp(here) == 0 or held > _DEAD:
            words = [DEAD]
        elif series == "measurements":
            others = [step for i, step in enumerate(steps) if i != axis]
            if others and steps[axis] > _NOISIER * max(others):
                words.append(_WHOLE[0])
            if closed and abs(drift) > float(np.std(here)):
                words.append(_WHOLE[1])
            if not 1 / _CHANGED <= (1.0 if np.isnan(change) else change) <= _CHANGED:
                words.append(_WHOLE[2])
        rows.append(
            ChannelRow(
                channel=f"{names[axis]} {series.removesuffix('s')}".strip(),
                rms_nm=float(np.std(here)),
                step_nm=steps[axis],
                mean_nm=float(np.mean(here)),
                drift_nm=drift,
                change=change,
                faulty=sum(each.fraction for each in found),
                state=", ".join(words) or "good",
            )
        )
    return rows


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.2g} %"


def _step_rms(series: FloatArray, good: BoolArray) -> float:
    """Return the rms difference of neighbouring good frames, nan without any."""
    pairs = good[1:] & good[:-1]
    return float(np.sqrt(np.mean(np.diff(series)[pairs] ** 2))) if pairs.any() else np.nan


def _quarters(good: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Return the good frames of the first and of the last quarter, none if they are few."""
    first, last = np.zeros((2, len(good)), dtype=np.bool_)
    where = np.flatnonzero(good)
    quarter = where.size // 4
    if quarter >= _LEAST_QUARTER:
        first[where[:quarter]] = True
        last[where[-quarter:]] = True
    return first, last
