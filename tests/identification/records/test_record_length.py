"""How long a record is, and how long it has to be."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt

RATE = 1000.0


def test_length():
    y = np.random.default_rng(0).standard_normal(6000)
    y[::200] = np.nan  # stretches of 199
    broken = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    with pytest.raises(
        lbt.errors.ProblemError, match=r"needs 4096 usable frames \(4.1 s at 1000 Hz\).*got 0 "
    ):
        lbt.identification.require_length(broken)
    assert lbt.identification.require_length(broken.bridged()) == 5999
    whole = broken.bridged()
    with pytest.raises(
        lbt.errors.ProblemError, match=r"needs 7000 usable frames \(7 s at 1000 Hz\)"
    ):
        lbt.identification.require_length(whole, seconds=7)
    assert lbt.identification.require_length(whole, resolution_hz=0.2) == 5999
    with pytest.raises(lbt.errors.ProblemError, match="0.1 Hz apart a stretch of 10000 frames"):
        lbt.identification.require_length(whole, resolution_hz=0.1)
    quick = lbt.identification.loop_record(y[1:200], frame_rate_hz=2000, unit="nm")
    with pytest.raises(lbt.errors.ProblemError, match="needs 8000 usable frames"):
        lbt.identification.require_length(quick)


@pytest.mark.parametrize("delay", [1.0, 2.0, 2.5])
def test_commands_before_a_record_do_not_make_it_shorter(delay):
    y = np.random.default_rng(0).standard_normal(5000)
    known = {"frame_rate_hz": RATE, "unit": "nm", "delay_frames": delay}
    whole = lbt.identification.loop_record(y, y, **known)
    assert whole.stretches() == ((int(np.ceil(delay)), 5000),)
    assert lbt.identification.require_length(whole, seconds=5) == 5000
    y[int(np.ceil(delay))] = np.nan  # a frame that was lost
    late = lbt.identification.loop_record(y, np.zeros(5000), **known)
    with pytest.raises(lbt.errors.ProblemError, match="needs 5000 usable frames"):
        lbt.identification.require_length(late, seconds=5)
