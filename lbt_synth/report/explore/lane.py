"""A thread that works on what was asked for last."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import copy_context
from threading import Condition, Thread


class Lane:
    """Runs one piece of work after another in a thread; newer work replaces what still waits.

    The thread shows wavefronts in the unit of its maker, and ends with the program, even in the
    middle of its work.
    """

    def __init__(self) -> None:
        self._waiting: Callable[[], None] | None = None
        self._open, self._changed = True, Condition()
        self._thread = Thread(target=copy_context().run, args=(self._run,), daemon=True)
        self._thread.start()

    def submit(self, work: Callable[[], None]) -> None:
        """Run a piece of work, instead of any that waits."""
        with self._changed:
            self._waiting = work
            self._changed.notify()

    @property
    def is_waiting(self) -> bool:
        """Whether newer work waits for the one that runs."""
        return self._waiting is not None

    def close(self) -> None:
        """Drop what waits, and end after what runs."""
        with self._changed:
            self._waiting, self._open = None, False
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is not None or not self._open)
                work, self._waiting = self._waiting, None
            if work is None:
                return
            work()
