"""Which rows are computed together: batches of about a second and a half, found by measuring."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from lbt_synth.study.store import Rows

_FIRST_ROWS = 16
_MOST_ROWS = 65_536
_GROWTH = 4  # at most so much larger than one that was measured
_SECONDS = 1.5  # long beside the milliseconds that a task costs, short beside the patience
_CRUMB_SECONDS = 0.1  # towards the end, no batch is shorter
_MOST_PARTS = 4000  # a long study has longer batches rather than more files than that


class Batches:
    """Rows that are still to be computed, given out batch after batch.

    Parameters
    ----------
    ranges : sequence of (int, int)
        Rows from a start up to a stop.
    workers : int
        How many batches run at once.
    """

    def __init__(self, ranges: Sequence[Rows], workers: int) -> None:
        self._ranges = deque(ranges)
        self._workers = workers
        self._rate: float | None = None  # rows a second, of one worker
        self._largest = 0  # rows of the largest batch that was measured
        self.left = sum(stop - start for start, stop in ranges)

    def next(self) -> Rows:
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
        rate = rows / max(seconds, 1e-9)
        # a first batch also warms up; a small one tells little of a large one
        if rows >= self._largest:
            self._largest, self._rate = rows, rate

    def _size(self) -> int:
        share = -(-self.left // (2 * self._workers))  # towards the end, enough for everyone
        if self._rate is None:
            return max(1, min(_FIRST_ROWS, share))
        total_s = self.left / (self._rate * self._workers)
        target_s = max(_SECONDS, total_s * self._workers / _MOST_PARTS)
        most = min(int(self._rate * target_s), _GROWTH * self._largest, _MOST_ROWS)
        return max(1, min(most, max(share, int(self._rate * _CRUMB_SECONDS))))
