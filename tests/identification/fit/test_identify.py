"""One axis and two: lines, noise, sensor gain, standard errors, notes, and what is refused."""

import runpy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.signal import lfilter
from support.eris import eris_example, eris_model, eris_record
from support.plants import ROOT
from support.recorded_loops import (
    LINE,
    expected_periodogram,
    identify_series,
    integrator_loop,
    slow,
    spliced_record,
)
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification import SpectrumRecord, loop_record
from lbt_synth.identification.fit import identify, order_search
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.identified_model import IdentifiedAxis
from lbt_synth.identification.fit.order_search import find_components
from lbt_synth.models import ARModel, SumSpectrum

RATE = 1000.0
LOOP = {"frame_rate_hz": RATE, "delay_frames": 2.0, "unit": "nm"}
LINES = ((17.0, 0.006, 40), (63.0, 0.004, 12))  # frequency [Hz], damping, rms [nm]


def identify_loop(start: IdentifiedAxis | None = None, **loop: object) -> IdentifiedAxis:
    """Return what is found in the loop of an integrator."""
    y, c = integrator_loop(**loop)
    return identify_series(y[:, 0], c[:, 0], start=start)


def test_closed_loop_gives_lines_noise_and_sensor_gain() -> None:
    found = identify_loop(lines=LINES, frames=40_000)
    assert [line.kind for line in found.lines] == ["line", "line"]
    for line, truth in zip(found.lines, LINES, strict=True):
        assert line.resolved
        values = np.array([line.frequency_hz, line.damping, line.rms_nm])
        errors = np.array([line.frequency_error_hz, line.damping_error, line.rms_error_nm])
        assert np.all(np.abs(values - truth) < 5 * errors)
        assert line.frequency_error_hz < 0.08
        assert line.prominence > 1
        assert line.evidence > 50
    assert found.noise_nm == pytest.approx(6.0, abs=5 * found.noise_error_nm)
    assert found.sensor_gain == pytest.approx(0.6, abs=4 * found.sensor_gain_error)
    assert found.sensor_gain_error < 0.03
    assert found.whiteness.white
    assert found.noise_correlation == 0
    assert found.turbulence.rms_nm == pytest.approx(300, abs=5 * found.turbulence_fit.rms_error_nm)
    assert found.turbulence_fit.rms_nm == pytest.approx(found.turbulence.rms_nm, rel=1e-9)
    # the model stands for the spectrum of the phase
    truth = slow().psd(found.frequency_hz) + 2 * (6 / 0.6) ** 2 / RATE
    away = found.frequency_hz > 150
    assert np.median(found.fitted_nm2_hz[away] / truth[away]) == pytest.approx(1, rel=0.1)


@pytest.mark.study
def test_standard_errors_are_honest() -> None:
    deviations = np.zeros((12, 5))
    for seed, row in enumerate(deviations):
        axis = identify_loop(lines=((45.0, 0.02, 25),), seed=seed, frames=12_000)
        (line,) = axis.lines
        row[0] = (line.frequency_hz - 45) / line.frequency_error_hz
        row[1] = np.log(line.damping / 0.02) * line.damping / line.damping_error
        row[2] = (line.rms_nm - 25) / line.rms_error_nm
        row[3] = (axis.noise_nm - 6) / axis.noise_error_nm
        row[4] = (axis.sensor_gain - 0.6) / axis.sensor_gain_error
    squares = np.sum(deviations**2, axis=0)
    # chi-squared of 12 values: 2.2 to 32 with a probability of 0.998
    assert np.all((squares > 2.2) & (squares < 32)), squares


@pytest.mark.parametrize(
    ("colour", "noise_nm", "seed", "gain", "most_errors", "gain_error", "colour_error"),
    [
        pytest.param(0.1, 6, 1, 0.4, 3, (0, 0.15), 0, marks=pytest.mark.study),
        (0.6, 6, 1, 0.4, 3, (0, 0.04), 0),
        # white noise and a gain of 0.85, ten errors off, are nearly as likely
        (0.1, 11.5, 7, 0.3, 2, (0.1, 0.3), 0.05),
    ],
)
def test_noise_that_is_not_white_leaves_the_gain(
    colour, noise_nm, seed, gain, most_errors, gain_error, colour_error
) -> None:
    """As white noise it moved the gain by 10 and by 25 of its errors; a drift explains it as well."""
    driving = noise_nm / 0.6 * np.sqrt(1 - colour**2)
    coloured = ARModel(coefficients=[colour], driving_rms_nm=driving, frame_rate_hz=RATE)
    loop = {"turbulence": SumSpectrum(parts=[slow(), coloured]), "noise": 1e-3, "gain": gain}
    found = identify_loop(lines=((31.0, 0.004, 30.0),), frames=20_000, seed=seed, **loop)
    assert found.sensor_gain == pytest.approx(0.6, abs=most_errors * found.sensor_gain_error)
    assert gain_error[0] < found.sensor_gain_error < gain_error[1]
    assert found.noise_correlation_error > colour_error
    assert found.noise_correlation == pytest.approx(colour, abs=3 * found.noise_correlation_error)
    assert found.noise_nm == pytest.approx(noise_nm, abs=3 * found.noise_error_nm)
    assert len(found.lines) == len(found.parts) == 1


def test_a_rough_gain_has_rivals() -> None:
    """Five seconds under a drift: the gains were 4 to 6 of their errors below the truth."""
    rate = {"frame_rate_hz": 518.0}
    lines = ((112.0, 0.005, 85.0), (87.4, 0.0026, 84.0), (42.3, 0.0029, 64.0))
    vibrations = tuple(
        lbt.Vibration(frequency_hz=f, damping=z, rms_nm=r, direction=(1.0,)) for f, z, r in lines
    )
    air = ARModel(coefficients=[1.99691631, -0.99694883], driving_rms_nm=0.13346734, **rate)
    drift = ARModel(coefficients=[0.99984], driving_rms_nm=214 * np.sqrt(1 - 0.99984**2), **rate)
    known = {"turbulence": SumSpectrum(parts=[air, drift]), "noise_nm": 7.73, "sensor_gain": 0.95}
    path = lbt.LoopHardware(**rate, modes=1)
    size = {"hardware": path, "frames": 2590, "settle_frames": 2000, "frame_means": True}
    law = lbt.integrator(path, gain=0.25).controller
    truth = lbt.Truth(**known, vibrations=vibrations)
    run = lbt.simulate(law, truth, seed=8, **size)
    found = identify_series(run.measurements[0, 2:, 0], run.commands[0, :-2, 0], **rate)
    assert found.sensor_gain == pytest.approx(0.95, abs=3 * found.sensor_gain_error)


def test_an_implausible_gain_is_doubted_however_well_it_is_known(monkeypatch) -> None:
    """Two good records under a drift were refused for fits at 1.4, 20 errors from the truth."""
    tried = []

    def spy(search, *arguments, **options):
        tried.append(search.gain)
        return find_components(search, *arguments, **options)

    monkeypatch.setattr(order_search, "find_components", spy)
    air = lbt.Atmosphere(seeing_arcsec=1.0, outer_scale_m=25, wind_speed_m_s=12, diameter_m=8.22)
    for gain, doubted in ((0.6, False), (1.5, True)):
        found = identify.find_axis(Search(data=expected_periodogram(air, 5.0, gain, 8)))
        assert any(tried) == doubted
        assert found.sensor_gain == pytest.approx(gain, rel=0.03)  # and stays where it is right


def test_what_the_loop_does_not_show_is_said() -> None:
    y, c = integrator_loop(gain=0.002, frames=8192, noise=20.0)
    found = identify_series(y[:, 0], c[:, 0])
    assert 0.3 < found.sensor_gain_error / found.sensor_gain <= 0.5  # no more than sensors differ
    assert abs(np.log(found.sensor_gain / 0.7)) < 0.5
    assert "leave it open" in found.sensor_gain_note
    for axis, gain, note in (
        (identify_series(y[:, 0] + 0.6 * c[:, 0]), 1, "1: of an open loop it has no meaning"),
        (identify_series(y[:, 0], c[:, 0], sensor_gain=0.6), 0.6, "given"),
    ):
        assert axis.sensor_gain == pytest.approx(gain, rel=1e-12)
        assert axis.sensor_gain_note == note
    quiet = spliced_record(lines=((40, 0.01, 30.0),), frames=4000, noise=1e-3)
    (words,) = lbt.identify(quiet, sensor_gain=0.6).notes
    assert "the noise of axis 0 is not seen under the rest of its spectrum" in words


def test_neither_units_nor_a_start_move_the_fit() -> None:
    loop = {"lines": ((40, 0.01, 30),), "frames": 8192}
    once = identify_loop(**loop)
    y, c = (1e-3 * series[:, 0] for series in integrator_loop(**loop))
    other, again = identify_series(y, c), identify_loop(once, **loop)
    assert other.sensor_gain == pytest.approx(once.sensor_gain, rel=1e-3)
    assert again.sensor_gain == pytest.approx(once.sensor_gain, rel=1e-3)
    assert 1e3 * other.noise_nm == pytest.approx(once.noise_nm, rel=1e-3)
    for line, small, same in zip(once.lines, other.lines, again.lines, strict=True):
        assert small.frequency_hz == pytest.approx(line.frequency_hz, rel=1e-4)
        assert 1e3 * small.rms_nm == pytest.approx(line.rms_nm, rel=1e-3)
        assert same.frequency_hz == pytest.approx(line.frequency_hz, abs=0.005)


def test_two_close_lines_are_separated() -> None:
    found = identify_loop(lines=((60.0, 0.002, 40), (61.2, 0.002, 25)), frames=40_000)
    assert [line.frequency_hz for line in found.lines] == pytest.approx([60.0, 61.2], abs=0.1)


def test_spectrum_of_known_averages() -> None:
    f = np.arange(1, 1600) * 0.25
    line = lbt.Vibration(frequency_hz=52, damping=0.02, rms_nm=30).ar_model(RATE)
    chance = np.random.default_rng(0).gamma(20.0, 1 / 20.0, f.size)
    density = (line.psd(f) + slow().psd(f) + 0.05) * chance
    for averages in (20, None):
        record = SpectrumRecord(frequency_hz=f, density_nm2_hz=density, averages=averages)
        (found,) = lbt.identify(record, frame_rate_hz=RATE).axes
        (peak,) = found.lines
        assert peak.frequency_hz == pytest.approx(52, abs=5 * peak.frequency_error_hz)
        assert peak.rms_nm == pytest.approx(30, abs=5 * peak.rms_error_nm)
        assert found.data.count[0] == pytest.approx(20, rel=0.25)


def test_a_sinusoid_is_not_resolved_and_its_rms_is_right() -> None:
    rng, k = np.random.default_rng(0), np.arange(40_000)
    wave = 300 * np.sqrt(2) * np.cos(2 * np.pi * 20.0037 * k / RATE)
    walk = np.cumsum(rng.standard_normal(k.size))
    found = identify_series(wave + walk + 5 * rng.standard_normal(k.size))
    (line,) = found.lines
    assert not line.resolved
    assert line.damping * line.frequency_hz * 40 == pytest.approx(0.01, rel=1e-2)
    assert line.frequency_hz == pytest.approx(20.0037, abs=0.002)
    assert line.rms_nm == pytest.approx(300, abs=3 * line.rms_error_nm)
    assert line.rms_error_nm < 40
    assert found.noise_nm == pytest.approx(5, rel=0.02)


@pytest.mark.study
def test_random_closed_loops_reach_what_the_page_says() -> None:
    studied = runpy.run_path(str(ROOT / "benchmarks" / "identification.py"))["studied"]
    results = [studied(seed, 60_000) for seed in range(40)]
    found, missed, false = (sum(len(r[k]) for r in results) for k in ("found", "missed", "false"))
    assert found / (found + missed) > 0.95
    assert false / len(results) < 0.2
    ratio, half = (np.array([r[key] for r in results]) for key in ("ratio", "replay_ratio"))
    assert np.median(ratio) < 1.03
    assert np.percentile(ratio, 95) < 1.10
    assert np.median(half) < 1.01
    assert np.mean(half < 1) > 0.5


def test_short_stretches_do_not_lead_to_a_sidelobe() -> None:
    rng, k, stretch = np.random.default_rng(3), np.arange(20_000), 667
    air = lfilter([1], [1, -0.99], 4 * rng.standard_normal(k.size))
    line = 50 * np.sqrt(2) * np.cos(2 * np.pi * 60.0 * k / RATE + 1)
    pieces = [(j, j + stretch) for j in range(0, k.size - stretch, stretch + 5)]
    found = identify_series(air + 5 * rng.standard_normal(k.size) + line, stretches=pieces)
    (line,) = found.lines
    assert line.frequency_hz == pytest.approx(60.0, abs=0.1)
    assert line.rms_nm == pytest.approx(50, rel=0.15)
    assert found.turbulence_fit.damping > 0.05


def test_axes_share_a_sensor_gain_where_they_agree() -> None:
    models = []
    for gains, loop_gains in (
        ((0.6, 0.6), (0.4, 0.4)),
        ((0.9, 0.4), (0.4, 0.4)),
        ((0.6, 0.6), (0.4, 0.002)),
        ((0.6, 0.65), (0.4, 0.4)),
    ):
        axes = [
            integrator_loop(sensor_gain=g, gain=k, seed=i, frames=20_000, noise=10.0)
            for i, (g, k) in enumerate(zip(gains, loop_gains, strict=True))
        ]
        y, c = map(np.hstack, zip(*axes, strict=True))
        models.append(lbt.identify(loop_record(y[:-2], c[2:], **LOOP)))
    same, other, one, near = models
    for model in (same, one, near):
        assert model.sensor_gains[0] == model.sensor_gains[1]
    assert same.sensor_gains[0] == pytest.approx(0.6, abs=4 * same.axes[0].sensor_gain_error)
    assert same.axes[0].sensor_gain_error < 0.013
    assert other.sensor_gains == pytest.approx((0.9, 0.4), rel=0.1)
    assert "different sensor gains" in other.notes[0]
    # the error of a mean of two is half their difference where that exceeds their errors
    assert near.axes[0].sensor_gain_error == pytest.approx(0.025, rel=0.15)


def identify_density(f: np.ndarray, density: np.ndarray, **options: object) -> object:
    record = SpectrumRecord(frequency_hz=f, density_nm2_hz=density)
    return lbt.identify(record, frame_rate_hz=RATE, **options)


def test_what_cannot_be_identified_is_refused() -> None:
    white = np.random.default_rng(0).standard_normal(2000)
    series, density = partial(identify_series, white), partial(identify_density, np.arange(1, 100))
    loop = partial(lbt.identify, spliced_record(frames=6000))
    late = loop_record(white, white, frame_rate_hz=RATE, unit="nm")
    eris = partial(lbt.identify, eris_example().record(averages=None), frame_rate_hz=1000)
    brief, uneven = np.arange(470, 600), np.geomspace(1, 400, 99)
    refused(partial(identify_density, brief, np.ones(130)), DimensionError, "at least 32")
    rows = [
        (partial(identify_series, np.ones(2000)), "measurement is constant"),
        (partial(identify_series, 1e200 * white), "units"),
        (partial(series, stretches=[(0, 300)]), "at least 512 frames"),
        (partial(series, sensor_gain=-1.0), "sensor_gain"),
        (partial(series, lowest_line_hz=501), "lowest_line_hz"),
        (partial(series, most_lines=-1), "most_lines"),
        (partial(identify_density, uneven, np.ones(99)), "evenly spaced"),
        (partial(density, np.zeros(99)), "above 0"),
        (partial(loop, sensor_gain=1e300), "sensor_gain must be"),
        (partial(loop, sensor_gain="x"), "sensor_gain must be an array of numbers"),
        (partial(loop, sensor_gain=[1.0, 2.0]), r"or one per measurement \(1\)"),
        (partial(loop, noise_nm=5.0), "noise_nm is for spectra"),
        (partial(loop, start=3), "IdentifiedModel"),
        (partial(loop, frame_rate_hz=900.0), "frame_rate_hz is for spectra"),
        (partial(lbt.identify, late), "give delay_frames"),
        (partial(eris, sensor_gain=0.5), "is for series of a loop"),
        (partial(eris, noise_nm=0.0), "noise_nm must be above 0"),
        (partial(eris, start=eris_model()), "is for series of a loop"),
    ]
    require_refusals((call, ProblemError, words) for call, words in rows)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        pytest.param(1 / 500, "leave it open", marks=pytest.mark.study),
        (0.5, "--command-scale 2"),
        (0.7, ""),
        (100.0, "units, signs and axes of the commands"),
    ],
)
def test_commands_in_other_units_and_of_part_size_are_doubted(factor: float, words: str) -> None:
    record = spliced_record((0,), lines=LINE, frames=20_000)
    model = lbt.identify(replace(record, commands=factor * record.commands))
    (axis,) = model.axes
    assert axis.sensor_gain == pytest.approx(0.6 / factor, rel=0.05)
    doubts = [*model.notes, axis.sensor_gain_note]
    assert any(words in doubt for doubt in doubts)
    assert bool(model.notes) == (factor in (0.5, 100.0))


def test_a_wide_resonance_is_no_turbulence() -> None:
    axis = lbt.identify(spliced_record((1,), lines=((60.0, 0.3, 30.0),), frames=12_000)).axes[0]
    assert axis.turbulence_fit.frequency_hz < 3
    assert axis.turbulence.rms_nm == pytest.approx(300, rel=0.3)
    (part,) = axis.parts
    assert part.kind == "broad"
    assert part.frequency_hz == pytest.approx(60, rel=0.1)


def test_the_limit_of_lines_is_kept_and_noted() -> None:
    """Without the lines that it leaves the innovations are not white."""
    lines = ((40, 0.01, 30.0), *((58.0 + 12 * i, 0.004, 30.0) for i in range(3)))
    record = spliced_record(lines=lines, frames=8192)
    for most_lines, kinds in ((2, ["line", "broad"]), (20, ["line"] * 4)):
        model = lbt.identify(record, sensor_gain=0.6, most_lines=most_lines)
        (axis,), limits = model.axes, most_lines == 2
        assert [part.kind for part in axis.parts] == kinds
        assert (axis.whiteness.p_value < 1e-6, axis.whiteness.white) == (limits, not limits)
        for words in ("limit of 2 lines was reached", "are not white", "errors do not cover"):
            assert any(words in note for note in model.notes) is limits


def test_spectrum_without_scatter_is_taken_for_one_periodogram():
    plain = eris_example().record(averages=None)
    model = identify_density(plain.frequency_hz, plain.density_nm2_hz[:, 1:])
    (note,), (axis,) = model.notes, model.axes
    assert "does not scatter" in note
    assert axis.data.count[0] == 1
    assert len(axis.lines) >= 8
    peaks = np.array(eris_example().peaks(plain.frequency_hz, plain.density_nm2_hz[:, 1]))[:, 0]
    assert all(np.min(np.abs(peaks - line.frequency_hz)) < 0.06 for line in axis.lines)
    assert all(line.rms_nm < 30 for line in axis.lines)  # 332 where it counts as a million


def test_the_noise_of_a_spectrum_without_any_is_stated():
    """A spectrum of wind shake has none, and no filter is designed for that."""
    f = np.arange(0.5, 400, 0.5)
    shake = 3000 / (1 + (f / 1.5) ** 2) ** 2 + 16 / np.pi / ((f - 18) ** 2 + 0.16)
    stated = identify_density(f, shake[:, None], noise_nm=5.0)
    assert stated.axes[0].noise_nm == 5.0
    assert lbt.kalman(stated.plant()).certificate.passed
    assert stated.truth().noise_nm.tolist() == [5.0]


def test_known_lines_are_found_with_the_rms_of_their_bins():
    known = [10, 16, 25.8, 45.5, 48.3, 96.7], [10, 16, 45.5, 48.3, 72.5, 96.7]
    model, seen, strong = eris_model(), eris_record(), 0
    assert not model.notes
    densities = seen.density_nm2_hz.T
    for axis, frequencies, density in zip(model.axes, known, densities, strict=True):
        places = np.array([line.frequency_hz for line in axis.lines])
        assert all(np.min(np.abs(places - frequency)) < 0.06 for frequency in frequencies)
        peaks = np.array(eris_example().peaks(seen.frequency_hz, density))
        for line in axis.lines:
            near = peaks[np.abs(peaks[:, 0] - line.frequency_hz) < 0.08]
            size = np.sqrt(np.sum(near[:, 1] ** 2))
            assert size > 0  # none is where the file has nothing
            assert 0.4 * size < line.rms_nm < 1.4 * size
            assert 0 < line.rms_error_nm < line.rms_nm
            strong += abs(line.rms_nm - size) < 2 * line.rms_error_nm
    assert strong >= 17  # of 22


def test_a_jump_is_found_noted_and_cut() -> None:
    """Where records were spliced, or frames lost, which do not move the gain."""
    spliced, made = (spliced_record(seeds, lines=LINE, frames=20_000) for seeds in ((0, 1), (3,)))
    torn = []
    for lost in ((5008, 6154), (2000, 9000)):
        kept = np.delete(np.arange(made.frames), np.arange(*lost))
        torn.append(loop_record(made.measurements[kept], made.commands[kept], **LOOP))
    models = [lbt.identify(record) for record in (spliced, *torn)]
    for model in models:
        (axis,) = model.axes
        assert axis.sensor_gain == pytest.approx(0.6, abs=4 * axis.sensor_gain_error)
        assert axis.sensor_gain_error < 0.05
        assert any("jump" in note for note in model.notes)
    (note,) = models[0].notes
    assert note.startswith("warning: 1 jump of the commands, the largest at frame 19998 ")
    assert note.endswith("the record was cut there")
    axis = models[0].axes[0]
    assert axis.noise_nm == pytest.approx(6, abs=4 * axis.noise_error_nm)
