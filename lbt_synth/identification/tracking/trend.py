"""The trend of a line: a straight line through its last frequencies."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.stats import linregress, theilslopes

from lbt_synth.models import Vibration
from lbt_synth.validation import FloatArray

_LEAST_POINTS = 4
_OUTLIER = 3 * 1.4826  # median absolute deviations that make three standard deviations
_GAP_HZ = 2.0  # a line that jumps by more than this is another line
_ALIGNED = 0.9  # cosine between directions of the same line


def extrapolate(
    time_s: FloatArray, frequency_hz: FloatArray, at_s: float, *, overlap: float = 1.0
) -> tuple[float, float, float]:
    """Extrapolate the last of several frequencies along their trend, as far as it is significant.

    The trend is a least-squares line through what is left when outliers from a Theil-Sen line are
    dropped (P. K. Sen, J. Am. Stat. Assoc. 63, 1379 (1968), doi:10.1080/01621459.1968.10480934).
    Between the last frequency and the line the answer is weighted with ``slope^2 / (slope^2 +
    error^2)``: a slope within its error changes little.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.identification.tracking.trend import extrapolate
    >>> time_s = np.arange(6.0)
    >>> frequency, slope, error = extrapolate(time_s, 17 + 0.1 * time_s, 8.0)
    >>> round(frequency, 6), round(slope, 6)
    (17.8, 0.1)
    """
    last = float(frequency_hz[-1])
    if time_s.size < _LEAST_POINTS:
        return last, float("nan"), float("nan")
    rest = frequency_hz - theilslopes(frequency_hz, time_s).slope * time_s
    rest = np.abs(rest - np.median(rest))
    inside = rest <= max(_OUTLIER * float(np.median(rest)), 1e-9 * abs(last))
    changed = not inside[-2:].any()  # one frequency may be wrong, two are another trend
    if changed or np.count_nonzero(inside) < _LEAST_POINTS:
        return last, float("nan"), float("nan")
    line = linregress(time_s[inside], frequency_hz[inside])
    slope, error = float(line.slope), float(line.stderr * np.sqrt(max(1.0, overlap)))
    if slope == 0:
        return last, slope, error
    on_line = line.intercept + slope * at_s
    start = last if inside[-1] else line.intercept + slope * float(time_s[-1])
    return float(start + (on_line - start) / (1 + (error / slope) ** 2)), slope, error


@dataclass(slots=True, eq=False)
class LineTrack:
    """The frequencies of one line, window after window."""

    direction: FloatArray
    points: list[tuple[float, float]] = field(default_factory=list)  # time [s], frequency [Hz]

    def add(self, time_s: float, frequency_hz: float, *, since_s: float) -> None:
        """Add the frequency of a window, and forget those before a time."""
        every = [*self.points, (time_s, frequency_hz)]
        self.points = [point for point in every if point[0] >= since_s - 1e-6]  # not for rounding

    def frequency_at(self, time_s: float, *, overlap: float) -> float:
        """Return the frequency at a time by the trend [Hz]."""
        times, frequencies = np.array(self.points).T
        return extrapolate(times, frequencies, time_s, overlap=overlap)[0]


def match_tracks(tracks: list[LineTrack], lines: tuple[Vibration, ...]) -> list[LineTrack]:
    """Return a track for each line: the nearest in frequency of those along its direction.

    The closest pairs are matched first. A line without a near track begins a new one.
    """
    pairs = sorted(
        (abs(track.points[-1][1] - line.frequency_hz), i, j)
        for i, line in enumerate(lines)
        for j, track in enumerate(tracks)
        if abs(float(track.direction @ np.array(line.direction))) > _ALIGNED
    )
    found: dict[int, int] = {}
    for gap, i, j in pairs:
        if gap <= _GAP_HZ and i not in found and j not in found.values():
            found[i] = j
    return [
        tracks[found[i]] if i in found else LineTrack(direction=np.array(line.direction))
        for i, line in enumerate(lines)
    ]
