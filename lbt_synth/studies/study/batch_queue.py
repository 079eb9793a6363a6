"""Split the rows of a study into batches that are long compared with their overhead."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from lbt_synth.studies.study.store import RowRange

_FIRST_ROWS = 4
_MOST_ROWS = 65_536
_GROWTH = 4  # of a batch over a measured one, at most
_SECONDS = 1.5  # long compared with the milliseconds of a task, short enough to wait for
_TRIAL_SECONDS = 6.0  # of the second size, before the cost of a row is known
_OVER_FIXED = 19  # the time that does not grow with the rows is a twentieth of a batch
_CRUMB_SECONDS = 0.1  # towards the end, no batch is shorter
_MOST_PARTS = 4000  # a long study has longer batches rather than more files


class BatchQueue:
    """Ranges of rows that are still to be computed, taken in batches by a number of workers."""

    def __init__(self, ranges: Sequence[RowRange], workers: int) -> None:
        self._ranges = deque(ranges)
        self._workers = workers
        self._small: tuple[int, float] | None = None  # rows and seconds of the smallest batch
        self._best: tuple[int, float] | None = None  # and of the one with the least time per row
        self._least_s = float("inf")  # of all batches
        self.left = sum(stop - start for start, stop in ranges)

    def take(self) -> RowRange:
        """Take the next batch, and return its rows."""
        start, end = self._ranges[0]
        stop = min(end, start + self._size())
        if stop == end:
            self._ranges.popleft()
        else:
            self._ranges[0] = (stop, end)
        self.left -= stop - start
        return start, stop

    def learn(self, rows: int, seconds: float) -> None:
        """Record how long a batch took."""
        seconds = max(seconds, 1e-9)
        self._least_s = min(self._least_s, seconds)
        if self._small is None or (rows, seconds) < self._small:
            self._small = rows, seconds
        if self._best is None or seconds / rows <= self._best[1] / self._best[0] * (1 + 1e-9):
            self._best = rows, seconds

    def _size(self) -> int:
        share = -(-self.left // (2 * self._workers))  # towards the end, some for every worker
        if self._small is None or self._best is None:
            return max(1, min(_FIRST_ROWS, share))
        (few, short), (many, long) = self._small, self._best
        if few == many:
            return max(1, min(int(many * min(_GROWTH, _TRIAL_SECONDS / long)), share))
        slope = max(long - short, 0.0) / (many - few)
        # the first batch includes the warm-up
        fixed_s = max(min(short - few * slope, self._least_s), 0.0)
        row_s = max(long - fixed_s, 1e-3 * long) / many
        target_s = max(_SECONDS, _OVER_FIXED * fixed_s, self.left * row_s / _MOST_PARTS)
        most = min(int(target_s / row_s), _GROWTH * many, _MOST_ROWS)
        crumb = int(max(_CRUMB_SECONDS, 4 * fixed_s) / row_s) if _CRUMB_SECONDS else 0
        crumb = min(crumb, -(-self.left // self._workers))
        return max(1, min(most, max(share, crumb)))
