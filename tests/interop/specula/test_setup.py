"""Set-ups of an end-to-end simulation and their controllers."""

from __future__ import annotations

import numpy as np
import pytest
from support.end_to_end import CONFIG

import lbt_synth as lbt
from lbt_synth.errors import ProblemError


def test_leaks_and_gains_of_the_mixed_controller(setup):
    control = setup.controller(None, tip_tilt_gain=0.7)
    first = control.step(np.ones(672))
    assert first[:2].tolist() == [0.7, 0.7]
    assert set(first[2:]) == {setup.gain}
    second = control.step(np.zeros(672))
    assert second[49] == setup.gain
    assert second[50] == pytest.approx(setup.leak * setup.gain)


def test_a_filter_of_another_loop_is_refused(setup):
    other = lbt.integrator(lbt.LoopHardware(frame_rate_hz=1000), gain=0.5)
    with pytest.raises(ProblemError, match=r"1000 Hz and 2 frames"):
        setup.controller(other)
    three = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=3), gain=0.5)
    with pytest.raises(ProblemError):
        setup.controller(three)


def test_a_filter_for_another_mirror_is_refused(setup):
    slow = lbt.load_config("examples/lbt_slow_mirror.yaml")
    with pytest.raises(ProblemError, match="another mirror"):
        setup.controller(lbt.lqg(slow.plant))
    with pytest.raises(ProblemError, match="another mirror"):
        slow.end_to_end.controller(lbt.kalman(lbt.load_config(CONFIG).plant))
    assert slow.end_to_end.controller(lbt.lqg(slow.plant)).n_modes == 672
