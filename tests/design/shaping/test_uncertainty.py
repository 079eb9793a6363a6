"""Demands on stability, against loops that differ."""

import numpy as np
import pytest
from support.shaping import (
    RATE,
    SLOW,
    spec,
)

import lbt_synth as lbt


@pytest.mark.parametrize(
    ("delay", "error"),
    [(1.0, 1.0), (1.5, 0.3), (2.0, 1.0), (2.3, 0.5), (2.5, 0.5), (2.7, 0.3), (3.0, 0.6)],
)
def test_a_loop_is_stable_at_every_delay_within_its_error(delay, error):
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1)
    eager = lbt.design.shaping.ResidualVariance(turbulence=SLOW, noise_nm=1.0)
    design = lbt.design.shape(
        path,
        spec(lbt.design.shaping.DelayError(frames=error), objective=eager),
        functions=20,
        states=None,
    )
    for e in np.linspace(-error, error, 41):
        real = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=max(delay + e, 1.0), modes=1)
        assert lbt.close_loop(real, design.controller).is_stable
    if delay == 2.5:  # without the demand it is not
        free = lbt.design.shape(path, spec(objective=eager), functions=20, states=None)
        late = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=3.0, modes=1)
        assert not lbt.close_loop(late, free.controller).is_stable
