"""Vibration lines that are known beforehand, from lists or from accelerometers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError, TelemetryError
from lbt_synth.identification.records.columns import Column
from lbt_synth.identification.records.contents import TEXTS, join_names, read_contents
from lbt_synth.storage.atomic_files import require_ending
from lbt_synth.validation import (
    BoolArray,
    FloatArray,
    NotNegative,
    Positive,
    check_fields,
    integer,
    number,
    real_array,
)

_FEWEST_AVERAGES = 8
_AVERAGES = 32  # segments that a record is cut into
_FINEST_HZ = 0.25
_SHORTEST_SEGMENT = 64
_DIP = 0.5  # of a peak, by which the power must fall before another peak counts


@dataclass(frozen=True, slots=True, kw_only=True)
class LinePrior:
    """A frequency at which a vibration is expected.

    Parameters
    ----------
    frequency_hz : float
        Frequency [Hz].
    frequency_error_hz : float, optional
        Standard error of it [Hz]; 0 where it is not known.
    source : str, optional
        Who says so.

    Raises
    ------
    ProblemError
        If the frequency is not above 0 or the error is negative.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.identification.LinePrior(frequency_hz=20, source="swing arm").frequency_error_hz
    0.0
    """

    frequency_hz: Positive
    frequency_error_hz: NotNegative = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        check_fields(self)
        if not isinstance(self.source, str):
            raise ProblemError(f"source must be a text; got {self.source!r}.")


def load_lines(lines: str | os.PathLike[str] | Sequence[Any] | FloatArray) -> tuple[LinePrior, ...]:
    """Take vibration lines from a list or from a text file.

    Parameters
    ----------
    lines : path-like or sequence
        A text file (.csv, .tsv, .txt, .dat) with a frequency per row [Hz], and its error in a
        second column if there is one (or by the headings frequency_hz and error_hz); or a list
        of frequencies, of pairs of frequency and error, or of LinePrior.

    Returns
    -------
    tuple of LinePrior
        The lines, by rising frequency.

    Raises
    ------
    TelemetryError
        If the file cannot be read or holds something else.
    ProblemError
        If an entry of a list is none of these.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> [line.frequency_hz for line in lbt.identification.load_lines([45.5, (16.0, 0.2)])]
    [16.0, 45.5]
    """
    if isinstance(lines, str | os.PathLike):
        priors = _read_lines(Path(lines))
    elif isinstance(lines, list | tuple | np.ndarray):
        priors = [_line_prior(one, "list") for one in lines]
    else:
        raise ProblemError(
            f"lines must be a file or a list of frequencies; got {type(lines).__name__}."
        )
    return tuple(sorted(priors, key=lambda line: line.frequency_hz))


def _line_prior(one: Any, source: str) -> LinePrior:
    if isinstance(one, LinePrior):
        return one
    parts = list(one) if isinstance(one, list | tuple | np.ndarray) else [one]
    if not 1 <= len(parts) <= 2:
        raise ProblemError(
            f"a line must be a frequency, or a pair of frequency and error; got {one!r}."
        )
    error = parts[1] if len(parts) == 2 else 0.0
    return LinePrior(frequency_hz=parts[0], frequency_error_hz=error, source=source)


def _read_lines(path: Path) -> list[LinePrior]:
    require_ending(path, "a list of lines", TEXTS, TelemetryError)
    columns = read_contents(path).columns
    try:
        rows = _frequency_rows(columns)
        return [_line_prior(row[~np.isnan(row)], str(path)) for row in rows]
    except ProblemError as error:
        raise TelemetryError(f"{path}: {error}", path=path) from error


def _frequency_rows(columns: list[Column]) -> FloatArray:
    """Return frequencies and, if there are any, errors, (lines, 1 or 2), NaN without an error."""
    fit = len(columns) <= 2
    if any(column.name for column in columns):  # errors may come first
        columns = sorted(columns, key=lambda column: column.role != "frequency")
        fit = [column.role == "frequency" for column in columns] in ([True], [True, False])
    if not fit or any((column.unit or "hz").lower() != "hz" for column in columns):
        raise ProblemError(
            "its one or two columns must be frequency_hz, and error_hz if there is one; got "
            f"{join_names(columns)}."
        )
    gaps = np.flatnonzero(np.isnan(columns[0].values))
    if gaps.size:
        raise ProblemError(f"row {gaps[0] + 1} of the numbers has no frequency.")
    return np.column_stack([column.values for column in columns])


def accelerometer_lines(
    accelerations: ArrayLike,
    measurement: ArrayLike,
    frame_rate_hz: float,
    *,
    usable: ArrayLike | None = None,
    segment_frames: int | None = None,
    false_alarm: float = 1e-3,
    lowest_hz: float = 1.0,
) -> tuple[LinePrior, ...]:
    """Find the frequencies at which accelerometers and the wavefront move together.

    The magnitude-squared coherence of every sensor with every axis is averaged over segments
    that do not overlap (Hann's window, on differences of two frames, which leak less). Of K
    segments of independent series it exceeds t with probability ``(1 - t)^(K-1)``
    (G. C. Carter, C. H. Knapp, A. H. Nuttall, IEEE Trans. Audio Electroacoust. 21, 337 (1973),
    doi:10.1109/TAU.1973.1162496); at the threshold the
    probability that any bin of any pair exceeds it is ``false_alarm``.

    Parameters
    ----------
    accelerations : (frames, sensors) or (frames,) array_like
        What the accelerometers gave, in any unit, at the times of the measurements.
    measurement : (frames, axes) or (frames,) array_like
        Pseudo-open-loop measurement.
    frame_rate_hz : float
        Frame rate of both [Hz].
    usable : (frames,) bool array_like, optional
        Frames that count; a segment that holds another is left out.
    segment_frames : int, optional
        Length of a segment [frames], at least 64; by default such that there are 32 of them, but no
        longer than 4 s.
    false_alarm : float, optional
        Probability that independent series give any line at all.
    lowest_hz : float, optional
        Frequencies below are left out [Hz].

    Returns
    -------
    tuple of LinePrior
        A line per peak of the coherent power, by rising frequency; the error is that of a peak
        within a bin, at least a whole bin over sqrt(12).

    Raises
    ------
    ProblemError
        If the sizes clash, a value is not finite or out of range, or there are fewer than 8
        segments.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> rng, k = np.random.default_rng(1), np.arange(40_000)
    >>> shake = np.cos(2 * np.pi * 20.2 * k / 1000)
    >>> found = lbt.identification.accelerometer_lines(
    ...     shake + rng.standard_normal(k.size), 2 * shake + rng.standard_normal(k.size), 1000
    ... )
    >>> [round(line.frequency_hz, 1) for line in found]
    [20.2]
    """
    from scipy.signal import csd

    rate = number(frame_rate_hz, "frame_rate_hz", above=0)
    a, z = _as_columns(accelerations, "accelerations"), _as_columns(measurement, "measurement")
    if len(a) != len(z):
        raise DimensionError(
            f"accelerations and measurement must have as many frames; got {len(a)} and {len(z)}."
        )
    chance = number(false_alarm, "false_alarm", above=0, below=1)
    good = np.ones(len(z), dtype=np.bool_) if usable is None else np.asarray(usable)
    if good.shape != (len(z),) or good.dtype != np.bool_:
        raise DimensionError(f"usable must be {len(z)} truth values, one per frame.")
    if segment_frames is None:
        longest = rate / _FINEST_HZ
        length = int(min(longest, max((len(z) - 1) / _AVERAGES, _SHORTEST_SEGMENT)))
    else:
        length = integer(segment_frames, "segment_frames", at_least=_SHORTEST_SEGMENT)
    sensors, series = a.shape[1], _whole_segments(np.hstack([a, z]), good, length)
    count = len(series) // length
    if count < _FEWEST_AVERAGES:
        raise ProblemError(
            f"coherence needs at least {_FEWEST_AVERAGES} segments of {length} usable frames; got "
            f"{count}. Record more, or shorten segment_frames."
        )
    window: Any = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2
    pair = series[:, :, None], series[:, None, :]
    frequency, cross = csd(*pair, fs=rate, window=window, nperseg=length, noverlap=0, axis=0)
    power = np.diagonal(cross, axis1=1, axis2=2).real
    power_a, power_z = power[:, :sensors, None], power[:, None, sensors:]
    cross = cross[:, :sensors, sensors:]  # (f, sensors, axes)
    coherence = np.abs(cross) ** 2 / np.maximum(power_a * power_z, np.finfo(np.float64).tiny)
    inside = (frequency >= max(lowest_hz, rate / length)) & (frequency < rate / 2)
    tried = max(int(np.sum(inside)) * coherence.shape[1] * coherence.shape[2], 1)
    threshold = 1 - (chance / tried) ** (1 / (count - 1))
    significant = inside & np.any(coherence > threshold, axis=(1, 2))
    # power of the phase (not of its difference) that goes with a sensor
    steps = 4 * np.sin(np.pi * frequency / rate) ** 2
    shared = np.max(coherence * power_z, axis=(1, 2)) / np.where(inside, steps, 1.0)
    source = f"accelerometers: coherence over {count} segments, false alarm {chance:g}"
    return _find_lines(frequency, np.where(inside, shared, 0.0), significant, source)


def _as_columns(value: Any, name: str) -> FloatArray:
    out = real_array(value, name)
    out = out[:, None] if out.ndim == 1 else out
    if out.ndim != 2 or out.size == 0:
        raise DimensionError(f"{name} must be (frames, columns); got shape {out.shape}.")
    return out


def _whole_segments(series: FloatArray, good: BoolArray, length: int) -> FloatArray:
    """Return the steps of the segments without a spoilt frame, one after another."""
    steps, fine = np.diff(series, axis=0), good[1:] & good[:-1]
    count = len(steps) // length
    complete = np.repeat(fine[: count * length].reshape(count, length).all(axis=1), length)
    return np.asarray(steps[: count * length][complete])


def _find_lines(
    frequency: FloatArray, power: FloatArray, significant: BoolArray, source: str
) -> tuple[LinePrior, ...]:
    """Return the local maxima among the significant bins, each with a dip to the next."""
    from scipy.signal import find_peaks

    seen = np.where(significant, power, 0.0)
    at, peaks = find_peaks(seen, prominence=0)
    out = []
    for k in at[peaks["prominences"] >= _DIP * seen[at]]:
        around = np.arange(k - 1, k + 2)
        weight = power[around]
        centre = float(weight @ frequency[around] / weight.sum())
        spread = float(np.sqrt(weight @ (frequency[around] - centre) ** 2 / weight.sum()))
        error = max(frequency[1] / np.sqrt(12), spread / 2)
        out.append(LinePrior(frequency_hz=centre, frequency_error_hz=error, source=source))
    return tuple(out)
