"""Single outliers of a window."""

from __future__ import annotations

import numpy as np
import pytest

from lbt_synth.identification.tracking.glitches import find_glitches


@pytest.mark.parametrize("frames", [16, 100, 3200])
def test_clean_windows_have_no_outliers(frames):
    rng = np.random.default_rng(frames)
    swing = 500 * np.sin(0.15 * np.arange(frames))[:, None]
    for _ in range(100):
        series = swing + 15 * rng.standard_normal((frames, 2))
        assert not find_glitches(series).any()
        series[frames // 2, 1] += 3000
        assert np.flatnonzero(find_glitches(series)).tolist() == [frames // 2]
    assert not find_glitches(swing).any()
    assert not find_glitches(np.zeros((frames, 1))).any()
