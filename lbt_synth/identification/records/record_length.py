"""Whether a record is long enough for a model to be found."""

from __future__ import annotations

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.validation import integer, number

_LEAST_FRAMES = 4096
LEAST_SECONDS = 4.0
_SHORTEST_STRETCH = 256  # frames of a stretch that counts


def require_length(
    record: LoopRecord,
    *,
    frames: int = _LEAST_FRAMES,
    seconds: float = LEAST_SECONDS,
    resolution_hz: float | None = None,
) -> int:
    """Refuse a record that is too short for a model to be found.

    Parameters
    ----------
    record : LoopRecord
        The record.
    frames : int, optional
        Usable frames that are needed, in stretches of at least 256. Those at the start of a record,
        whose commands came before it, count.
    seconds : float, optional
        The same as a time [s].
    resolution_hz : float, optional
        Distance of frequencies that must be resolved [Hz]: the longest stretch has to last
        ``1 / resolution_hz``.

    Returns
    -------
    int
        Usable frames in stretches of at least 256.

    Raises
    ------
    ProblemError
        If there are too few frames; it says how many there are and are needed, and which faults
        were found.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> brief = lbt.identification.loop_record([[1.0], [2.5], [2.0]], frame_rate_hz=800, unit="nm")
    >>> lbt.identification.require_length(brief)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    lbt_synth.errors.ProblemError: the record needs 4096 usable frames (5.12 s at 800 Hz) ...
    """
    rate = record.frame_rate_hz
    needed = integer(frames, "frames", at_least=1)
    needed = max(needed, int(np.ceil(rate * number(seconds, "seconds", at_least=0) * (1 - 1e-12))))
    known = record.commands is None or record.delay_frames is None
    before = 0 if known else len(record.hardware.mirror_taps)  # commands that no record knows
    lengths = [stop - (start if start > before else 0) for start, stop in record.stretches()]
    count = sum(length for length in lengths if length >= _SHORTEST_STRETCH)
    longest = max(lengths, default=0)
    if count < needed:
        raise ProblemError(
            f"the record needs {needed} usable frames ({needed / rate:.3g} s at {rate:.6g} Hz) in "
            f"stretches of at least {_SHORTEST_STRETCH}; got {count} ({count / rate:.3g} s), the "
            f"longest stretch {longest}. {record.health.summary()} Record for longer, or lose "
            "fewer frames."
        )
    if resolution_hz is None:
        return count
    line = int(np.ceil(rate / number(resolution_hz, "resolution_hz", above=0) * (1 - 1e-12)))
    if longest < line:
        raise ProblemError(
            f"to tell frequencies {resolution_hz:g} Hz apart a stretch of {line} frames "
            f"({line / rate:.3g} s) is needed; the longest has {longest}."
        )
    return count
