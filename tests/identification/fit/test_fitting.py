"""Fits of given components: what adds too little is dropped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.drawn_spectra import drawn_search, empty_search, white_noise

from lbt_synth.identification.fit.fitting import Search, cost, fit, prune, required_evidence
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.fit.spectrum_model import Background, Component, SpectrumModel
from lbt_synth.identification.fit.whittle import contrast
from lbt_synth.models.vibration import coefficient_rows, sampled_lines

RATE = 1000.0


def test_a_line_that_would_leave_the_band_stays_at_its_end_and_is_dropped() -> None:
    white = np.random.default_rng(0).standard_normal(8192)
    data = loop_periodogram(white, None, frame_rate_hz=RATE, stretches=[(0, white.size)])
    search = Search(data=data, gain=1.0)
    slow = search.component("turbulence", 1.0, 0.5, 0.1)
    line = search.component("line", 100.0, 0.01, 1e-4)
    start = SpectrumModel((Background(0.0, 0.0, 0.0, search.log_angle(50.0)),), (slow, line))
    inside = fit(search, start)
    assert len(inside.spectrum.components) == 2
    away = replace(line, log_frequency=search.log_angle(1e-9), log_power=-30.0)
    found = fit(search, replace(start, components=(slow, away)))
    assert found is not None
    assert search.place(found.spectrum.components[1])[0] >= 0.0999 * data.step_hz
    assert len(prune(search, found).spectrum.components) == 1


def test_a_component_costs_what_its_parameters_do() -> None:
    """A drift has two, a line whose place is known beforehand need not be searched for."""
    search = empty_search()
    line = search.component("line", 100.0, 0.01, 0.1)
    bump = replace(line, sections=2)

    def required(*components: Component) -> float:
        """Return what the last of them must add."""
        return required_evidence(search, SpectrumModel((), (line, *components)), len(components))

    values = float(search.data.count.sum())
    assert required(line) == pytest.approx(1.5 * np.log(values))
    drift = required(search.drift(0.03, 1.0))
    assert drift == pytest.approx(2 / 3 * required(line))
    assert required(bump) == pytest.approx(4 / 3 * required(line))
    assert required(bump, line) == pytest.approx(1e-3 * values)
    assert required(bump, line.shift(0.1, 0.0, 0.0)) == required(line)


def test_a_wide_component_in_the_place_of_the_noise_becomes_noise() -> None:
    """A resonance near the Nyquist frequency, damped within a frame, is white as noise is."""
    rng = np.random.default_rng(2)
    walk = np.cumsum(rng.standard_normal(32768))
    series = 26 * rng.standard_normal(walk.size) + walk - np.linspace(0, walk[-1], walk.size)
    data = loop_periodogram(series, None, frame_rate_hz=RATE, stretches=[(0, walk.size)])
    search = Search(data=data, gain=1.0)
    slow = search.component("turbulence", 0.3, 0.5, 50.0**2)
    wide = search.component("line", 450.0, 0.826, 26.0**2)
    background = Background(0.0, float(np.log(0.3**2)), 0.0, search.log_angle(50.0))
    start = SpectrumModel((background,), (slow, wide))
    found = fit(search, start)
    stuck = replace(found, spectrum=start, contrast=contrast(data, start))
    pruned = prune(search, stuck).spectrum
    assert pruned.lines == ()
    assert np.exp(pruned.background.log_noise) == pytest.approx(26**2, rel=0.05)


def resonances(*places: tuple[float, float, float]) -> SpectrumModel:
    """Return turbulence under resonances."""
    component = empty_search().component
    air = white_noise().add(component("turbulence", 0.9, 0.31, 3000.0))
    return air.add(*(component("line", *place) for place in places))


def test_two_close_resonances_become_one_of_their_power() -> None:
    """Without one of them, the model of the other looks hopeless beside that of both."""
    search = drawn_search(resonances((102.0, 0.146, 1800.0)), 0)
    both = fit(search, resonances((98.5, 0.17, 900.0), (107.0, 0.11, 900.0)))
    one = prune(search, both, thorough=True)
    assert [len(model.spectrum.components) for model in (both, one)] == [3, 2]
    assert cost(search, one) < cost(search, both) - 5
    assert search.place(one.spectrum.components[1])[0] == pytest.approx(102, abs=2)


def test_what_a_part_of_the_turbulence_explains_the_rest_takes_over() -> None:
    """On a way that a trial of the search gives up."""
    truth = resonances()
    search, parts = drawn_search(truth, 0), ((3.0, 0.5, 300.0), (0.5, 0.3, 300.0))
    several = fit(search, truth.add(*(search.component("slow", *part) for part in parts)))
    kept, dropped = (prune(search, several, thorough=thorough) for thorough in (False, True))
    assert [len(model.spectrum.components) for model in (kept, dropped)] == [2, 1]
    assert cost(search, dropped) < cost(search, kept) - 5


def test_a_bump_stays_one_that_double_precision_holds() -> None:
    """The process of four sections at 3 Hz had a variance below zero."""
    search = empty_search()
    bump = replace(search.component("line", 20.0, 0.05, 100.0), sections=4)
    spectrum = white_noise().add(search.component("turbulence", 1.0, 0.5, 10.0), bump)
    low = search.priors(spectrum).bounds[0][spectrum.place(1) : spectrum.place(1) + 2]
    narrowest = replace(bump, log_frequency=low[0], damping=low[1])
    hertz = narrowest.frequency / search.data.angle_s
    ratio, rate = np.array([narrowest.damping_ratio]), search.data.frame_rate_hz
    _, drive = sampled_lines(np.array([hertz]), ratio, 1.0, rate, 4)
    z = np.exp(-1j * np.linspace(0, np.pi, 400_001)[1:])
    a1, a2 = coefficient_rows(np.array([narrowest.frequency]), ratio)[0]
    exact = np.mean(np.abs(1 / (1 - a1 * z - a2 * z**2)) ** 8)
    assert drive[0] * np.sqrt(exact) == pytest.approx(1, abs=1e-3)
