"""The convex programmes of a specification, and demands that clash."""

from dataclasses import replace

import numpy as np
import pytest
from support.shaping import BASIC, ONE, attenuation, channel, margin, shaped, spec

from lbt_synth.design.shaping import Bound, LoopErrors
from lbt_synth.design.shaping.channel import mode_loop
from lbt_synth.design.shaping.solution import solve_mode
from lbt_synth.errors import InfeasibleError


def test_terms_at_other_sensor_gains_are_lowered_step_by_step():
    weak = spec(margin(0.4), terms=[BASIC, replace(BASIC, sensor_gain=0.4)])
    aware = solve_mode(weak, channel(16))
    assert len(aware.objectives_nm2) > 2
    assert np.all(np.diff(aware.objectives_nm2) <= 1e-3 * np.array(aware.objectives_nm2[:-1]))
    unaware = solve_mode(spec(margin(0.4), LoopErrors(low=0.4, high=1)), channel(16))
    assert aware.objectives_nm2[-1] < weak.measured_nm2(mode_loop(ONE, unaware.parameter))


def test_a_smallest_set_of_clashing_demands_is_named_with_a_relaxation_that_suffices():
    deep, stiff = attenuation(0, 50, 0.2), margin(0.7)
    others = Bound(response="noise", at_most=50), LoopErrors(low=0.9, high=1.1)
    with pytest.raises(InfeasibleError, match="hold together with 16 functions") as caught:
        shaped(others[0], deep, others[1], stiff, functions=16)
    assert set(caught.value.conflict) == {deep.label, stiff.label}
    factor = float(str(caught.value).split("relaxed by a factor of ")[1].split(")")[0])
    relaxed = replace(deep, at_most=0.2 * factor * 1.01)
    assert shaped(relaxed, stiff, functions=16).certificate.passed


def test_one_demand_may_be_impossible_by_itself():
    # with a delay of two frames the first two samples of S are 1 and 0: |S| < 1 everywhere fails
    with pytest.raises(InfeasibleError, match="these demands cannot hold with") as caught:
        shaped(attenuation(0, 400, 0.9), functions=12)
    assert len(caught.value.conflict) == 1
