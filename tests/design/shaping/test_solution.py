"""The convex programmes of a specification, and demands that clash."""

from dataclasses import replace

import numpy as np
import pytest
from support.shaping import (
    BASIC,
    ONE,
    channel,
    spec,
)

import lbt_synth as lbt
from lbt_synth.design.shaping.channel import mode_loop
from lbt_synth.design.shaping.solution import solve_mode


def test_terms_at_other_sensor_gains_are_lowered_step_by_step():
    weak = lbt.design.shaping.Total(terms=(BASIC, replace(BASIC, sensor_gain=0.4)))
    aware = solve_mode(
        spec(lbt.design.shaping.ModulusMargin(at_least=0.4), objective=weak), channel(16)
    )
    assert len(aware.objectives_nm2) > 2
    assert np.all(np.diff(aware.objectives_nm2) <= 1e-3 * np.array(aware.objectives_nm2[:-1]))
    unaware = solve_mode(
        spec(
            lbt.design.shaping.ModulusMargin(at_least=0.4),
            lbt.design.shaping.LoopErrors(low=0.4, high=1),
        ),
        channel(16),
    )
    assert aware.objectives_nm2[-1] < weak.measured_nm2(mode_loop(ONE, unaware.parameter))


def test_the_worst_of_two_bands_is_balanced():
    bands = [
        lbt.design.shaping.VibrationBand(low_hz=10, high_hz=11, rms_nm=200),
        lbt.design.shaping.VibrationBand(low_hz=40, high_hz=42, rms_nm=200),
    ]
    objective = lbt.design.shaping.Total(
        terms=(BASIC, lbt.design.shaping.Worst(terms=tuple(bands))), weights=(0.1, 1)
    )
    design = lbt.design.shape(
        ONE,
        spec(lbt.design.shaping.ModulusMargin(at_least=0.4), objective=objective),
        functions=40,
        states=None,
    )
    (_, _, _), (_, _, low), (_, _, high) = design.terms_nm()
    assert low == pytest.approx(high, rel=0.02)


def test_a_smallest_set_of_clashing_demands_is_named():
    deep = lbt.design.shaping.Attenuation(low_hz=0, high_hz=50, at_most=0.2)
    stiff = lbt.design.shaping.ModulusMargin(at_least=0.7)
    idle = lbt.design.shaping.NoisePeak(at_most=50)
    with pytest.raises(
        lbt.errors.InfeasibleError, match="cannot hold together with 16 functions"
    ) as caught:
        lbt.design.shape(
            ONE,
            spec(idle, deep, lbt.design.shaping.LoopErrors(low=0.9, high=1.1), stiff),
            functions=16,
            states=None,
        )
    assert set(caught.value.conflict) == {deep.label, stiff.label}
    assert "relaxed by a factor of" in str(caught.value)


def test_one_demand_may_be_impossible_by_itself():
    # with a delay of two frames the first two samples of S are 1 and 0: |S| < 1 everywhere fails
    with pytest.raises(
        lbt.errors.InfeasibleError, match="these demands cannot hold with"
    ) as caught:
        lbt.design.shape(
            ONE,
            spec(lbt.design.shaping.Attenuation(low_hz=0, high_hz=400, at_most=0.9)),
            functions=12,
            states=None,
        )
    assert len(caught.value.conflict) == 1


def test_the_relaxation_that_is_named_suffices():
    demands = (
        lbt.design.shaping.Attenuation(low_hz=0, high_hz=50, at_most=0.2),
        lbt.design.shaping.ModulusMargin(at_least=0.7),
    )
    with pytest.raises(lbt.errors.InfeasibleError) as caught:
        lbt.design.shape(ONE, spec(*demands), functions=16, states=None)
    factor = float(str(caught.value).split("factor of ")[1].split(")")[0])
    relaxed = replace(demands[0], at_most=0.2 * factor * 1.01)
    assert lbt.design.shape(
        ONE, spec(relaxed, demands[1]), functions=16, states=None
    ).certificate.passed
