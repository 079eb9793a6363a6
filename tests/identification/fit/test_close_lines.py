"""Lines that may be two, against the exact likelihood of the pair that is there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

import lbt_synth as lbt
from lbt_synth.identification.fit.close_lines import (
    describe_close_lines,
    separable_hz,
    split_gain,
)
from lbt_synth.identification.fit.fitting import Search, fit
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.spectrum_model import SpectrumModel
from lbt_synth.identification.fit.whittle import contrast, density

RATE, DURATION_S = 500.0, 60.0
DAMPING = 0.005


def exact(separation: float, second_nm2: float = 500.0):
    """Return the exact spectrum of a pair as data, its model, and that of one line fitted to it.

    The separation is in half widths; the second line has half the power of the first.
    """
    f = np.arange(1, int(RATE / 2 * DURATION_S)) / DURATION_S
    data = LoopPeriodogram(
        frequency_hz=f,
        measured=np.ones_like(f),
        crossed=np.zeros_like(f),
        corrected=np.zeros_like(f),
        count=np.ones_like(f),
        frame_rate_hz=RATE,
        resolution_hz=1 / DURATION_S,
        duration_s=DURATION_S,
    )
    search = Search(data=data)
    slow = search.component("turbulence", 1.0, 0.5, 1e4)
    ground = SpectrumModel(0.0, 0.0, 0.0, 0.0, (slow,)).without_roll_off()
    places = ((40.0, 1000.0), (40.0 * (1 + separation * DAMPING), second_nm2))
    pair = ground.add(*(search.component("line", hz, DAMPING, power) for hz, power in places))
    data = replace(data, measured=density(data, pair))
    search = Search(data=data)
    single = fit(search, ground.add(search.component("line", 40.05, DAMPING, 1500.0)))
    assert single is not None
    return search, pair, single.spectrum


@pytest.mark.parametrize("separation", [2.5, 3.5])
def test_a_split_gains_what_the_pair_is_likelier(separation: float) -> None:
    search, pair, single = exact(separation)
    gain = contrast(search.data, single) - contrast(search.data, pair)
    assert gain > 1
    # the rest of the model stays, and merged bins see a little less
    assert split_gain(search, single, 1) == pytest.approx(gain, rel=0.15)


def test_a_single_line_gains_nothing() -> None:
    search, _, single = exact(0.0)
    assert split_gain(search, single, 1) == pytest.approx(0, abs=0.1)


def test_lines_can_be_separated_where_a_split_tells_the_exact_pair() -> None:
    def gain(separation: float) -> float:
        search, pair, single = exact(separation, 1000.0)
        return contrast(search.data, single) - contrast(search.data, pair)

    there = brentq(lambda x: gain(x) - 5.5, 1.0, 6.0, xtol=0.01)
    search, _, single = exact(there, 1000.0)
    assert separable_hz(search, single, 1) == pytest.approx(40.0 * DAMPING * there, rel=0.08)


def test_a_longer_record_or_one_of_less_noise_separates_closer_lines() -> None:
    search, _, single = exact(0.0)
    first = separable_hz(search, single, 1)
    longer = replace(search, data=replace(search.data, count=10 * search.data.count))
    loud = replace(single, log_noise=single.log_noise + np.log(1e6))
    assert separable_hz(longer, single, 1) < 0.8 * first
    assert separable_hz(search, loud, 1) > 1.2 * first


def test_a_line_beside_zero_is_not_split() -> None:
    search, _, single = exact(0.0)
    slow = search.component("line", 1 / DURATION_S, DAMPING, 1.0)
    assert split_gain(search, single.add(slow), 2) == 0


def simulated(second_hz: float, seed: int):
    """Identify a loop with a line at 40 Hz and another."""
    lines = tuple(
        lbt.Vibration(frequency_hz=hz, damping=DAMPING, rms_nm=50, direction=(1.0,))
        for hz in (40.0, second_hz)
    )
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=2.0, frame_rate_hz=RATE)
    truth = lbt.Truth(turbulence=slow, vibrations=lines, noise_nm=5.0)
    loop = lbt.integrator(lbt.LoopHardware(frame_rate_hz=RATE, modes=1), gain=0.4)
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    run = lbt.simulate(loop.controller, truth, hardware=path, frames=30_000, seed=seed)
    y, u = run.measurements[0, :, 0], run.commands[0, :, 0]
    return lbt.identification.identify_axis(y[2:], u[:-2], frame_rate_hz=RATE)


def test_a_note_names_the_line_that_may_be_two() -> None:
    axis = simulated(40.5, 4)
    (line,) = axis.lines
    (note,) = describe_close_lines(axis, 0)
    assert f"the line of axis 0 at {line.frequency_hz:.4g} Hz may be two" in note


def test_a_note_names_a_line_that_is_hardly_separate() -> None:
    axis = simulated(41.2, 1)
    second = axis.lines[1]
    assert not list(describe_close_lines(axis, 1))
    model = axis.fitted_model
    at = 1 + int(model.spectrum.components[2].frequency > model.spectrum.components[1].frequency)
    weak = replace(model, evidence=tuple(20.0 if i == at else 500.0 for i in range(3)))
    (note,) = describe_close_lines(replace(axis, fitted_model=weak), 1)
    assert f"the line of axis 1 at {second.frequency_hz:.4g} Hz lies in the skirts" in note
