"""The worst error over an interval: what is found, and what is guaranteed."""

from __future__ import annotations

import dataclasses

import pytest
from support.intervals import IntervalDesigns, predictor
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.design.worst_case import bound_worst_error, error_size, search_worst_error
from lbt_synth.models.plant.frequency_interval import FrequencyInterval

RATE = 800


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


@pytest.fixture(scope="module")
def made():
    return IntervalDesigns()


@pytest.mark.parametrize("modes", [1, 2])
@pytest.mark.parametrize("shift", [-1.7, 0.0, 0.6])
def test_guarantee_and_search_meet_for_any_filter(modes, shift):
    """The two computations of the worst case, on filters whose worst frequency is anywhere."""
    plant = lbt_axis_plant(modes=modes, damping=0.02)
    interval = FrequencyInterval(plant=plant, half_width_hz=2.0)
    wide = [dataclasses.replace(v.at_frequency(20 + shift), rms_nm=200.0) for v in plant.vibrations]
    other = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=plant.turbulence, vibrations=wide, noise_nm=15.5, modes=modes
    )
    for filtered in (
        predictor(lbt.kalman(other)),
        predictor(lbt.hinf(other, gamma_ratio=1.3, route="riccati")),
    ):
        for norm, gap in (("hinf", 1e-8), ("h2", 6e-5)):
            found, where = search_worst_error(interval, filtered, norm)
            sure = bound_worst_error(interval, filtered, norm)
            assert found * (1 - 1e-10) <= sure <= found * (1 + gap)
            assert interval.low_hz <= where <= interval.high_hz


def test_a_worst_frequency_inside_the_interval():
    """The envelope decides, not the ends: a filter that knows the ends and not the middle."""
    plant = lbt_axis_plant()
    interval = FrequencyInterval(plant=plant, half_width_hz=1.0)
    ends = lbt.models.spread_plant(plant, frequencies_hz=[19.0, 21.0])
    filtered = predictor(lbt.kalman(ends))
    at_ends = max(
        error_size(interval.error_system(a, filtered), "hinf") for a in interval.coefficients
    )
    found, where = search_worst_error(interval, filtered, "hinf")
    sure = bound_worst_error(interval, filtered, "hinf")
    assert found > 1.5 * at_ends
    assert 19.1 < where < 20.9
    assert found * (1 - 1e-10) <= sure <= found * (1 + 1e-8)


def test_a_line_too_narrow_to_be_bounded(made):
    sharp = lbt_axis_plant(damping=1e-7)
    interval = FrequencyInterval(plant=sharp, half_width_hz=2.0)
    with pytest.raises(lbt.errors.NumericalError, match="too narrow a line"):
        bound_worst_error(interval, made["h2", 1.0].predictor, "h2")
