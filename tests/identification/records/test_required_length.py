"""Records that are too short."""

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
        lbt.errors.ProblemError, match=r"needs 4096 usable frames \(4.1 s\).*got 0, the l"
    ):
        lbt.identification.require_length(broken)
    assert lbt.identification.require_length(broken.bridged()) == 5999
    whole = broken.bridged()
    with pytest.raises(lbt.errors.ProblemError, match=r"needs 7000 usable frames \(7 s\)"):
        lbt.identification.require_length(whole, seconds=7)
    assert lbt.identification.require_length(whole, resolution_hz=0.2) == 5999
    with pytest.raises(lbt.errors.ProblemError, match="0.1 Hz apart a stretch of 10000 frames"):
        lbt.identification.require_length(whole, resolution_hz=0.1)
    quick = lbt.identification.loop_record(y[1:200], frame_rate_hz=2000, unit="nm")
    with pytest.raises(lbt.errors.ProblemError, match="needs 8000 usable frames"):
        lbt.identification.require_length(quick)
