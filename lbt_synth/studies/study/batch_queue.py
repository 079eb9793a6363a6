"""Which rows are computed together: batches that are long beside what each of them costs."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from lbt_synth.studies.study.store import RowRange

_FIRST_ROWS = 4
_MOST_ROWS = 65_536
_GROWTH = 4  # at most so much larger than one that was measured
_SECONDS = 1.5  # long beside the milliseconds that a task costs, short beside the patience
_TRIAL_SECONDS = 6.0  # of the second size, before it is known what grows with the rows
_OVER_FIXED = 19  # what does not grow with the rows is a twentieth of a batch
_CRUMB_SECONDS = 0.1  # towards the end, no batch is shorter
_MOST_PARTS = 4000  # a long study has longer batches rather than more files than that


class BatchQueue:
    """Rows that are still to be computed, given out batch after batch.

    Parameters
    ----------
    ranges : sequence of (int, int)
        Rows from a start up to a stop.
    workers : int
        How many batches run at once.
    """

    def __init__(self, ranges: Sequence[RowRange], workers: int) -> None:
        self._ranges = deque(ranges)
        self._workers = workers
        self._small: tuple[int, float] | None = None  # rows and seconds of the smallest batch
        self._best: tuple[int, float] | None = None  # and of that with the least time a row
        self._least_s = float("inf")  # of all batches
        self.left = sum(stop - start for start, stop in ranges)

    def next(self) -> RowRange:
        """Return the rows of the next batch."""
        start, end = self._ranges[0]
        stop = min(end, start + self._size())
        if stop == end:
            self._ranges.popleft()
        else:
            self._ranges[0] = (stop, end)
        self.left -= stop - start
        return start, stop

    def learn(self, rows: int, seconds: float) -> None:
        """Take the time that a batch took."""
        seconds = max(seconds, 1e-9)
        self._least_s = min(self._least_s, seconds)
        if self._small is None or (rows, seconds) < self._small:
            self._small = rows, seconds
        if self._best is None or seconds / rows <= self._best[1] / self._best[0] * (1 + 1e-9):
            self._best = rows, seconds

    def _cost(self) -> tuple[float, float]:
        """Return the seconds that every batch takes, and those of each row."""
        assert self._small is not None  # both are there after the first batch
        assert self._best is not None
        (few, short), (many, long) = self._small, self._best
        slope = max(long - short, 0.0) / (many - few)
        fixed = min(short - few * slope, self._least_s)  # the first one also warmed up
        return max(fixed, 0.0), max(long - fixed, 1e-3 * long) / many

    def _size(self) -> int:
        share = -(-self.left // (2 * self._workers))  # towards the end, enough for everyone
        if self._small is None or self._best is None:
            return max(1, min(_FIRST_ROWS, share))
        many, long = self._best
        if self._small[0] == many:
            return max(1, min(int(many * min(_GROWTH, _TRIAL_SECONDS / long)), share))
        fixed_s, row_s = self._cost()
        total_s = self.left * row_s
        target_s = max(_SECONDS, _OVER_FIXED * fixed_s, total_s / _MOST_PARTS)
        most = min(int(target_s / row_s), _GROWTH * many, _MOST_ROWS)
        crumb = int(max(_CRUMB_SECONDS, 4 * fixed_s) / row_s) if _CRUMB_SECONDS else 0
        crumb = min(crumb, -(-self.left // self._workers))
        return max(1, min(most, max(share, crumb)))
