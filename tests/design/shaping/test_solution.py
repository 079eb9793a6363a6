"""The convex programmes of a specification, and demands that clash."""

from dataclasses import replace

import numpy as np
import pytest
from support.shaping import BASIC, ONE, channel, shaped, spec

from lbt_synth.design.shaping import (
    Attenuation,
    LoopErrors,
    ModulusMargin,
    NoisePeak,
    Total,
    VibrationBand,
    Worst,
)
from lbt_synth.design.shaping.channel import mode_loop
from lbt_synth.design.shaping.solution import solve_mode
from lbt_synth.errors import InfeasibleError

MARGIN = ModulusMargin(at_least=0.4)


def test_terms_at_other_sensor_gains_are_lowered_step_by_step():
    weak = Total(terms=(BASIC, replace(BASIC, sensor_gain=0.4)))
    aware = solve_mode(spec(MARGIN, objective=weak), channel(16))
    assert len(aware.objectives_nm2) > 2
    assert np.all(np.diff(aware.objectives_nm2) <= 1e-3 * np.array(aware.objectives_nm2[:-1]))
    unaware = solve_mode(spec(MARGIN, LoopErrors(low=0.4, high=1)), channel(16))
    assert aware.objectives_nm2[-1] < weak.measured_nm2(mode_loop(ONE, unaware.parameter))


def test_the_worst_of_two_bands_is_balanced():
    bands = tuple(VibrationBand(low_hz=f, high_hz=1.05 * f, rms_nm=200) for f in (10, 40))
    objective = Total(terms=(BASIC, Worst(terms=bands)), weights=(0.1, 1))
    design = shaped(MARGIN, objective=objective, functions=40)
    (_, _, _), (_, _, low), (_, _, high) = design.terms_nm()
    assert low == pytest.approx(high, rel=0.02)


def test_a_smallest_set_of_clashing_demands_is_named_with_a_relaxation_that_suffices():
    deep, stiff = Attenuation(low_hz=0, high_hz=50, at_most=0.2), ModulusMargin(at_least=0.7)
    others = NoisePeak(at_most=50), LoopErrors(low=0.9, high=1.1)
    with pytest.raises(InfeasibleError, match="hold together with 16 functions") as caught:
        shaped(others[0], deep, others[1], stiff, functions=16)
    assert set(caught.value.conflict) == {deep.label, stiff.label}
    factor = float(str(caught.value).split("relaxed by a factor of ")[1].split(")")[0])
    relaxed = replace(deep, at_most=0.2 * factor * 1.01)
    assert shaped(relaxed, stiff, functions=16).certificate.passed


def test_one_demand_may_be_impossible_by_itself():
    # with a delay of two frames the first two samples of S are 1 and 0: |S| < 1 everywhere fails
    with pytest.raises(InfeasibleError, match="these demands cannot hold with") as caught:
        shaped(Attenuation(low_hz=0, high_hz=400, at_most=0.9), functions=12)
    assert len(caught.value.conflict) == 1
