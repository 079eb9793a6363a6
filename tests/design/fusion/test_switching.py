"""Filters that take turns: those that switch too often diverge, those that stay do not."""

from dataclasses import replace

import numpy as np
import pytest
from support.fused_loops import FAST, LINES, SLOW, example_plant

import lbt_synth as lbt
from lbt_synth.design.fusion import switching
from lbt_synth.design.fusion.failures import make_fallbacks
from lbt_synth.design.fusion.switching import dwell_frames
from lbt_synth.linear import periodic_kalman

SHARP = tuple(replace(line, damping=0.005) for line in LINES)
CALM = lbt.models.ARModel(coefficients=[1.9975, -0.99755], driving_rms_nm=2, frame_rate_hz=1000)
EARLY = replace(SLOW, delay_frames=1.25)  # its sums are empty when a period begins


def growth_per_frame(plant, turns):
    """Return what a cycle of turns (gains, frames) makes of the error, per frame."""
    errors = [(plant.error_system(gains).A, frames) for gains, frames in turns]
    cycle, phase, total = np.eye(plant.n_states), 0, 0
    for _ in range(plant.period):  # the cycle may end in the midst of a period
        for A, frames in errors:
            for _ in range(frames):
                cycle = A[phase] @ cycle
                phase = (phase + 1) % plant.period
            total += frames
    return np.max(np.abs(np.linalg.eigvals(cycle))) ** (1 / total)


def designed(plant):
    return periodic_kalman(plant).gains, make_fallbacks(plant)


def test_stable_filters_that_take_turns_may_diverge():
    plant = example_plant((FAST,), lines=SHARP, turbulence=CALM, noise_nm=15)
    gains, fallbacks = designed(plant)
    without = next(each.gains for each in fallbacks if each.missing == ("wavefront",))
    for own in (gains, without):
        assert growth_per_frame(plant, [(own, 1)]) < 1
    assert growth_per_frame(plant, [(gains, 3), (without, 30)]) > 1.04
    frames = dwell_frames(plant, gains, fallbacks)
    assert frames > 30
    assert growth_per_frame(plant, [(gains, frames), (without, frames)]) < 1


@pytest.mark.parametrize("sensors", [(FAST,), (FAST, SLOW), (EARLY,)])
def test_filters_that_stay_do_not_diverge(sensors):
    plant, rng = example_plant(sensors), np.random.default_rng(0)
    gains, fallbacks = designed(plant)
    frames = dwell_frames(plant, gains, fallbacks)
    assert 1 < frames < 300
    filters = [gains, *(each.gains for each in fallbacks)]
    for _ in range(5):
        order = rng.permutation(len(filters))
        turns = [(filters[i], frames + int(rng.integers(plant.period))) for i in order]
        assert growth_per_frame(plant, turns) < 1


def test_a_single_filter_is_its_own_proof():
    plant = example_plant((FAST,))
    gains = periodic_kalman(plant).gains
    assert dwell_frames(plant, gains, ()) < 100


def test_what_is_not_proved(monkeypatch):
    plant = example_plant((FAST,))
    monkeypatch.setattr(switching, "LONGEST_DWELL", 10)
    assert dwell_frames(plant, *designed(plant)) is None
