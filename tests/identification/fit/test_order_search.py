"""Backgrounds beside lines, gains of a start, bands with too much power, and rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.drawn_spectra import NOISE, drawn_search, empty_search, white_noise
from support.recorded_loops import hidden_resonance_record, identify_series, integrator_loop

from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.order_search import find_components, find_excesses, fit_background
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.fit.spectrum_model import Background, SpectrumModel
from lbt_synth.identification.fit.whittle import density

RATE = 1000.0


def test_neither_lines_that_are_missing_nor_rounding_carry_the_gain_away() -> None:
    lines = ((39.7, 0.01, 4.1), (135.3, 0.004, 5.0), (109.0, 0.01, 14.9))
    known = {"noise": 2.9, "sensor_gain": 1.15, "gain": 0.2, "frames": 30_000, "seed": 30}
    y, c = (series[:, 0] for series in integrator_loop(lines=lines, **known))
    one, other = (identify_series(y * scale, c * scale) for scale in (1.0, 1.0 + 2e-12))
    assert one.sensor_gain == pytest.approx(1.15, abs=3 * one.sensor_gain_error)
    frequencies = [line.frequency_hz for line in one.lines]
    assert frequencies == pytest.approx(sorted(f for f, _, _ in lines), abs=0.3)
    assert one.whiteness.white
    assert len(one.parts) == len(other.parts)
    assert one.fitted_model.contrast == pytest.approx(other.fitted_model.contrast, abs=0.5)


def test_rounding_does_not_move_the_search_and_a_resonance_widens_the_error_of_the_gain() -> None:
    """A lower gain and one resonance less are nearly as likely: rounding moved from 0.76 to 0.93."""
    record = hidden_resonance_record(3)
    y, c = record.measurements[:, 0], record.corrections()[:, 0]
    known = {"stretches": record.stretches()}
    one, other = (identify_series(y * scale, c * scale, **known) for scale in (1.0, 1.0 + 1e-11))
    assert len(one.parts) == len(other.parts)
    assert one.fitted_model.contrast == pytest.approx(other.fitted_model.contrast, abs=0.5)
    # a seventh of the gain
    assert one.sensor_gain == pytest.approx(other.sensor_gain, abs=0.15 * one.sensor_gain_error)
    assert one.sensor_gain_error == pytest.approx(other.sensor_gain_error, rel=0.2)
    assert abs(one.sensor_gain - 0.995) < 2 * one.sensor_gain_error


def test_narrow_lines_are_hardly_touched_and_wide_ones_are_held() -> None:
    search = empty_search()
    data = search.data
    slow = search.component("turbulence", 1.4, 0.45, 6000.0)
    wide = search.component("line", 30.0, 0.25, 4000.0)
    narrow = search.component("line", 77.0, 0.002, 3000.0)
    truth = white_noise().add(slow, wide, narrow)
    drawn = drawn_search(truth, 0)
    found = fit_background(drawn, 1.0, [wide, narrow])
    (turbulence,) = found.spectrum.components
    assert np.exp(turbulence.log_power) == pytest.approx(6000, rel=0.4)
    assert np.exp(found.spectrum.background.log_noise) == pytest.approx(NOISE, rel=0.1)
    own = density(data, found.spectrum)[data.frequency_hz < 300]
    expected = density(data, white_noise().add(slow))[data.frequency_hz < 300]
    assert np.median(own / expected) == pytest.approx(1, rel=0.15)
    blind = fit_background(drawn, 1.0)  # as if nothing were there
    near = np.argmin(np.abs(data.frequency_hz - 30))
    assert density(data, blind.spectrum)[near] > 3 * density(data, found.spectrum)[near]


def test_a_drift_is_a_process_beside_the_turbulence() -> None:
    """Overdamped turbulence beside a slow part explains it as well, with a parameter more."""
    search = empty_search()
    truth = white_noise().add(search.component("turbulence", 2.0, 0.4, 3000.0))
    truth = truth.add(search.drift(1 / 30, 20_000.0))
    drawn = drawn_search(truth, 0)
    spectrum = find_components(drawn).spectrum
    assert [c.kind for c in spectrum.components] == ["turbulence", "drift"]
    f = search.data.frequency_hz
    middle = (f > 0.2) & (f < 100)
    ratio = density(drawn.data, spectrum)[middle] / density(search.data, truth)[middle]
    assert np.median(ratio) == pytest.approx(1, rel=0.15)


def drawn_from(whole: np.ndarray) -> Search:
    """Return the search of random periodograms of a density."""
    search, chance = empty_search(), np.random.default_rng(0).exponential(size=whole.size)
    return replace(search, data=replace(search.data, measured=whole * chance))


def test_smooth_bumps_and_resonances_are_one_component_each() -> None:
    """One 8 Hz wide was five lines, with errors of 0.1 Hz each; a line stays beside it."""
    search = empty_search()
    f = search.data.frequency_hz
    air = white_noise().add(search.component("turbulence", 1.0, 0.5, 3000.0))
    smooth = 2.0 * np.exp(-4 * np.log(2) * ((f - 40) / 8) ** 2)
    line = 20 / np.pi * 0.05 / ((f - 41) ** 2 + 0.05**2)

    def lines_beside_air(density_nm2_hz: np.ndarray) -> tuple:
        return find_components(
            drawn_from(density(search.data, air) + density_nm2_hz)
        ).spectrum.lines

    (bump,) = lines_beside_air(smooth)
    assert bump.sections > 1
    assert np.exp(bump.log_power) == pytest.approx(2.0 * 8 * 1.0645, rel=0.1)
    assert sorted(c.sections > 1 for c in lines_beside_air(smooth + line)) == [False, True]
    truth = air.add(search.component("line", 40.0, 0.1, 400.0))
    (resonance,) = find_components(drawn_search(truth, 0)).spectrum.lines
    assert resonance.sections == 1


def test_turbulence_is_not_taken_for_a_resonance() -> None:
    """A strong resonance over steep air was the turbulence, and the air a drift beside it."""
    search = empty_search()
    f = search.data.frequency_hz
    air = 2000 / (1 + f**2) ** (11 / 6) + 0.05
    shape = 1 / ((1 - (f / 40) ** 2) ** 2 + (0.2 * f / 40) ** 2)
    drawn = drawn_from(air + 300 * np.interp(40, f, air) * shape / np.max(shape))
    assert search.place(find_components(drawn).spectrum.components[0])[0] < 5


def test_scan_finds_a_line_and_nothing_in_noise() -> None:
    rng = np.random.default_rng(3)
    n = 20_000
    noise = rng.standard_normal(n)
    for amplitude, count in ((0.0, 0), (0.3, 1)):
        y = noise + amplitude * np.sin(2 * np.pi * 77.7 * np.arange(n) / RATE)
        data = loop_periodogram(y, None, frame_rate_hz=RATE, stretches=[(0, n)])
        search = Search(data=data, gain=1.0)
        found = find_excesses(search, SpectrumModel((Background(0.0, 0.0, 0.0, 0.0),), ()))
        assert len(found) == count
        if count:
            assert search.place(found[0][1])[0] == pytest.approx(77.7, abs=0.1)
