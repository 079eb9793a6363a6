"""One axis and two: lines, noise, sensor gain, standard errors, notes, and what is refused."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter
from support.eris import ERIS_FILE, eris_example, eris_model, eris_record
from support.plants import ROOT
from support.recorded_loops import (
    LINE,
    expected_periodogram,
    hidden_resonance_record,
    identify_series,
    integrator_loop,
    slow,
    spliced_record,
)

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.identification.fit import identify
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.order_search import find_rivals

RATE = 1000.0


FRAMES = 16_384


def test_closed_loop_gives_lines_noise_and_sensor_gain() -> None:
    y, c = integrator_loop(lines=((17.0, 0.006, 40), (63.0, 0.004, 12)), frames=40_000)
    found = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    assert [line.kind for line in found.lines] == ["line", "line"]
    for line, (f, z, r) in zip(found.lines, ((17.0, 0.006, 40), (63.0, 0.004, 12)), strict=True):
        assert line.frequency_hz == pytest.approx(f, abs=5 * line.frequency_error_hz)
        assert line.frequency_error_hz < 0.08
        assert line.damping == pytest.approx(z, abs=5 * line.damping_error)
        assert line.rms_nm == pytest.approx(r, abs=5 * line.rms_error_nm)
        assert line.prominence > 1
        assert line.evidence > 50
    assert found.noise_nm == pytest.approx(6.0, abs=5 * found.noise_error_nm)
    assert found.sensor_gain_error is not None
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


def test_a_gain_that_a_wide_resonance_may_explain_has_a_wide_error() -> None:
    """A lower gain and one resonance less are nearly as likely as the truth."""
    record = hidden_resonance_record()
    y, u = np.asarray(record.measurements)[:, 0], np.asarray(record.commands)[:, 0]
    found = identify_series(y[2:], u[:-2], frame_rate_hz=RATE)
    assert found.sensor_gain_error is not None
    assert abs(found.sensor_gain - 0.995) < 2 * found.sensor_gain_error


def test_standard_errors_are_honest() -> None:
    deviations: dict[str, list[float]] = {"f": [], "z": [], "rms": [], "noise": [], "gain": []}
    for seed in range(12):
        y, c = integrator_loop(lines=((45.0, 0.02, 25),), seed=seed, frames=12_000)
        found = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE)
        (line,) = found.lines
        assert found.sensor_gain_error is not None
        deviations["f"].append((line.frequency_hz - 45) / line.frequency_error_hz)
        deviations["z"].append(np.log(line.damping / 0.02) * line.damping / line.damping_error)
        deviations["rms"].append((line.rms_nm - 25) / line.rms_error_nm)
        deviations["noise"].append((found.noise_nm - 6) / found.noise_error_nm)
        deviations["gain"].append((found.sensor_gain - 0.6) / found.sensor_gain_error)
    for name, values in deviations.items():
        # chi-squared of 12 values: 2.2 to 32 with a probability of 0.998
        assert 2.2 < np.sum(np.square(values)) < 32, name


def identify_coloured(
    colour: float, noise: float, seed: int, gain: float = 0.4
) -> lbt.identification.IdentifiedAxis:
    """Identify a loop whose noise, of some nm and sensor gain 0.6, has a correlation."""
    own = lbt.models.ARModel(
        coefficients=[colour],
        driving_rms_nm=noise / 0.6 * np.sqrt(1 - colour**2),
        frame_rate_hz=RATE,
    )
    y, c = integrator_loop(
        lines=((31.0, 0.004, 30.0),),
        noise=1e-3,
        gain=gain,
        turbulence=lbt.models.SumSpectrum(parts=[slow(), own]),
        frames=20_000,
        seed=seed,
    )
    return identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE)


@pytest.mark.parametrize(("colour", "most"), [(0.1, 0.15), (0.6, 0.04)])
def test_noise_that_is_not_white_leaves_the_gain(colour: float, most: float) -> None:
    """As white noise it moved the gain by 10 and by 25 of its standard errors.

    A drift explains the weaker colour as well, at a gain of 0.75.
    """
    found = identify_coloured(colour, 6, seed=1)
    assert found.sensor_gain_error is not None
    assert found.sensor_gain == pytest.approx(0.6, abs=3 * found.sensor_gain_error)
    assert found.sensor_gain_error < most
    assert found.noise_correlation == pytest.approx(colour, abs=3 * found.noise_correlation_error)
    assert found.noise_nm == pytest.approx(6, abs=3 * found.noise_error_nm)
    assert len(found.lines) == len(found.parts) == 1


def test_a_colour_that_is_hardly_likelier_widens_the_error_of_the_gain() -> None:
    """White noise and a gain of 0.85 for 0.6, ten errors off, are nearly as likely."""
    found = identify_coloured(0.1, 11.5, seed=7, gain=0.3)
    assert found.sensor_gain_error is not None
    assert found.sensor_gain == pytest.approx(0.6, abs=2 * found.sensor_gain_error)
    assert found.noise_correlation_error > 0.05


def test_a_drift_is_not_taken_for_coloured_noise() -> None:
    """It was: 73 nm of a correlation of 0.95, which a design would take for white noise."""
    air = lbt.Atmosphere(seeing_arcsec=1.0, outer_scale_m=25, wind_speed_m_s=12, diameter_m=8.22)
    drift = lbt.models.ARModel(coefficients=[0.999], driving_rms_nm=30, frame_rate_hz=RATE)
    y, c = integrator_loop(
        lines=((30.0, 0.004, 60.0),),
        noise=2.4,
        sensor_gain=0.76,
        turbulence=lbt.models.SumSpectrum(parts=[air, drift]),
        frames=12_000,
        seed=12,
    )
    found = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    assert found.noise_nm < 10
    assert found.noise_correlation == 0
    assert found.sensor_gain_error is not None
    assert found.sensor_gain == pytest.approx(0.76, abs=3 * found.sensor_gain_error)


@pytest.mark.parametrize(("gain", "seed"), [(0.25, 8), (0.25, 9), (0.4, 0), (0.4, 8)])
def test_a_rough_gain_has_rivals(gain: float, seed: int) -> None:
    """Five seconds under a drift: the gains were 4 to 6 of their errors below the truth."""
    rate, truth_gain, pole = 518.0, 0.95, 0.99984
    slow = lbt.models.ARModel(
        coefficients=[1.99691631, -0.99694883], driving_rms_nm=0.13346734, frame_rate_hz=rate
    )
    drift = lbt.models.ARModel(
        coefficients=[pole], driving_rms_nm=214 * np.sqrt(1 - pole**2), frame_rate_hz=rate
    )
    truth = lbt.Truth(
        turbulence=lbt.models.SumSpectrum(parts=[slow, drift]),
        vibrations=tuple(
            lbt.Vibration(frequency_hz=f, damping=z, rms_nm=rms, direction=(1.0,))
            for f, z, rms in ((112.0, 0.005, 85.0), (87.4, 0.0026, 84.0), (42.3, 0.0029, 64.0))
        ),
        noise_nm=7.73,
        sensor_gain=truth_gain,
    )
    path = lbt.LoopHardware(frame_rate_hz=rate, modes=1)
    law = lbt.integrator(path, gain=gain).controller
    run = lbt.simulate(
        law, truth, hardware=path, frames=2590, seed=seed, settle_frames=2000, frame_means=True
    )
    y, u = run.measurements[0, :, 0], run.commands[0, :, 0]
    found = identify_series(y[2:], u[:-2], frame_rate_hz=rate)
    assert found.sensor_gain == pytest.approx(truth_gain, abs=3 * found.sensor_gain_error)


@pytest.mark.parametrize(("gain", "doubted"), [(0.6, False), (1.5, True), (0.15, True)])
def test_an_implausible_gain_is_doubted_however_well_it_is_known(
    monkeypatch: pytest.MonkeyPatch, gain: float, doubted: bool
) -> None:
    """Two good records under a drift were refused for fits at 1.4, 20 errors from the truth."""
    tried = []

    def spy(search, model, *, other_gains):
        tried.append(other_gains)
        return find_rivals(search, model, other_gains=other_gains)

    monkeypatch.setattr(identify, "find_rivals", spy)
    air = lbt.Atmosphere(seeing_arcsec=1.0, outer_scale_m=25, wind_speed_m_s=12, diameter_m=8.22)
    search = Search(data=expected_periodogram(air, 5.0, gain))
    found = identify.find_axis(search)
    assert tried == [doubted]
    assert found.sensor_gain == pytest.approx(gain, rel=0.03)  # and stays where it is right


@given(scale=st.sampled_from([1e-3, 0.02, 50.0]))
@settings(max_examples=3, deadline=None)
def test_units_do_not_matter(scale: float) -> None:
    y, c = integrator_loop(lines=((40, 0.01, 30),), frames=8192)
    one = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    other = identify_series(scale * y[:, 0], scale * c[:, 0], frame_rate_hz=RATE)
    assert other.sensor_gain == pytest.approx(one.sensor_gain, rel=1e-3)
    assert other.noise_nm == pytest.approx(scale * one.noise_nm, rel=1e-3)
    for a, b in zip(one.lines, other.lines, strict=True):
        assert b.frequency_hz == pytest.approx(a.frequency_hz, rel=1e-4)
        assert b.rms_nm == pytest.approx(scale * a.rms_nm, rel=1e-3)


def test_the_model_designs_a_filter_as_good_as_the_truth() -> None:
    lines = ((17.0, 0.006, 40), (63.0, 0.004, 12))
    y, c = integrator_loop(lines=lines, frames=40_000)
    axis = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    model = lbt.identification.IdentifiedModel(axes=(axis,), frame_rate_hz=RATE, delay_frames=2.0)
    vibrations = [
        lbt.Vibration(frequency_hz=f, damping=z, rms_nm=r, direction=(1.0,)) for f, z, r in lines
    ]
    exact = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=slow(),
        vibrations=vibrations,
        noise_nm=6.0,
        sensor_gain=0.6,
        modes=1,
    )
    truth = lbt.Truth(
        turbulence=slow(), vibrations=tuple(vibrations), noise_nm=6.0, sensor_gain=0.6
    )
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)

    def left(plant: lbt.models.TipTiltPlant) -> float:
        loop = lbt.close_loop(path, lbt.kalman(plant).controller, sensor_gain=0.6)
        return lbt.residual_budget(loop, truth).rms_nm ** 2

    assert left(model.plant()) / left(exact) < 1.03


def test_what_the_loop_does_not_show_is_said() -> None:
    y, c = integrator_loop(gain=0.002, frames=8192, noise=20.0)
    found = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    assert 0.3 < found.sensor_gain_error / found.sensor_gain <= 0.5  # no more than sensors differ
    assert abs(np.log(found.sensor_gain / 0.7)) < 0.5
    assert "leave it open" in found.sensor_gain_note
    open_loop = identify_series(y[:, 0] + 0.6 * c[:, 0], frame_rate_hz=RATE)
    assert open_loop.sensor_gain == 1
    assert "open loop" in open_loop.sensor_gain_note
    given_gain = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE, sensor_gain=0.6)
    assert given_gain.sensor_gain == pytest.approx(0.6, rel=1e-12)
    assert given_gain.sensor_gain_note == "given"


def test_an_announced_line_is_found_where_a_search_would_not_dare() -> None:
    rng = np.random.default_rng(5)
    n = 16_384
    y = rng.standard_normal(n) + 0.05 * np.sin(2 * np.pi * 90.0 * np.arange(n) / RATE)
    plain = identify_series(10 * y, frame_rate_hz=RATE)
    known = identify_series(10 * y, frame_rate_hz=RATE, announced=[(90.0, 0.05)])
    wrong = identify_series(10 * y, frame_rate_hz=RATE, announced=[(140.0, 0.05)])
    assert not plain.lines
    assert not wrong.lines
    (line,) = known.lines
    assert line.announced
    assert line.frequency_hz == pytest.approx(90, abs=0.1)


def test_a_start_leads_to_the_same_place() -> None:
    y, c = integrator_loop(lines=((40, 0.01, 30),))
    once = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    again = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE, start=once)
    assert again.sensor_gain == pytest.approx(once.sensor_gain, rel=1e-3)
    assert [line.frequency_hz for line in again.lines] == pytest.approx(
        [line.frequency_hz for line in once.lines], abs=0.005
    )


def test_two_close_lines_are_separated() -> None:
    y, c = integrator_loop(lines=((60.0, 0.002, 40), (61.2, 0.002, 25)), frames=40_000)
    found = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    assert [line.frequency_hz for line in found.lines] == pytest.approx([60.0, 61.2], abs=0.1)


def test_spectrum_of_known_averages() -> None:
    f = np.arange(1, 1600) * 0.25
    line = lbt.Vibration(frequency_hz=52, damping=0.02, rms_nm=30).ar_model(RATE)
    density = line.psd(f) + slow().psd(f) + 0.05
    chance = np.random.default_rng(0).gamma(20.0, 1 / 20.0, f.size)
    for averages in (20.0, None):
        found = identify.identify_spectrum(
            f, density * chance, frame_rate_hz=RATE, averages=averages
        )
        (peak,) = found.lines
        assert peak.frequency_hz == pytest.approx(52, abs=5 * peak.frequency_error_hz)
        assert peak.rms_nm == pytest.approx(30, abs=5 * peak.rms_error_nm)
        assert found.data.count[0] == pytest.approx(20, rel=0.25)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"measurement": np.zeros((20, 2))}, DimensionError, "must be a series"),
        ({"measurement": np.full(2000, np.nan)}, NonFiniteError, "measurement"),
        ({"correction": np.zeros(10)}, DimensionError, "correction must have shape"),
        ({"frame_rate_hz": 0}, ProblemError, "frame_rate_hz"),
        ({"stretches": [(0, 5000)]}, ProblemError, "stretches must be .* within 2000 frames"),
        ({"stretches": [(0, 300)]}, ProblemError, "at least 512 frames"),
        ({"stretches": []}, ProblemError, "at least one stretch"),
        ({"sensor_gain": -1.0}, ProblemError, "sensor_gain"),
        ({"announced": [(600.0, 0.1)]}, ProblemError, "announced frequency"),
        ({"announced": [(60.0, -0.1)]}, ProblemError, "error of an announced"),
        ({"lowest_line_hz": 501}, ProblemError, "lowest_line_hz"),
        ({"most_lines": -1}, ProblemError, "most_lines"),
        ({"measurement": np.zeros(2000)}, ProblemError, "constant"),
        (
            {"measurement": 1e200 * np.random.default_rng(0).standard_normal(2000)},
            ProblemError,
            "units",
        ),
    ],
)
def test_bad_series_are_refused(
    change: dict[str, object], error: type[Exception], words: str
) -> None:
    good: dict[str, object] = {
        "measurement": np.random.default_rng(0).standard_normal(2000),
        "frame_rate_hz": RATE,
    }
    with pytest.raises(error, match=words):
        identify_series(**(good | change))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("f", "density", "words"),
    [
        (np.arange(1, 10), np.ones(9), "at least 32"),
        (np.arange(0, 100), np.ones(100), "from above 0"),
        (np.arange(1, 600), np.ones(599), "below 500"),
        (np.geomspace(1, 400, 99), np.ones(99), "evenly spaced"),
        (np.arange(1, 100), np.zeros(99), "above 0"),
        (np.arange(1, 100), np.ones(98), "same length"),
    ],
)
def test_bad_spectra_are_refused(f: np.ndarray, density: np.ndarray, words: str) -> None:
    with pytest.raises(ProblemError, match=words):
        identify.identify_spectrum(f, density, frame_rate_hz=RATE)


def test_a_sinusoid_is_not_resolved_and_its_rms_is_right() -> None:
    rng = np.random.default_rng(0)
    k = np.arange(40_000)
    wave = 300 * np.sqrt(2) * np.cos(2 * np.pi * 20.0037 * k / RATE)
    slow = np.cumsum(rng.standard_normal(k.size))
    found = identify_series(wave + slow + 5 * rng.standard_normal(k.size), frame_rate_hz=RATE)
    (line,) = found.lines
    assert not line.resolved
    assert line.damping * line.frequency_hz * 40 == pytest.approx(0.01, rel=1e-2)
    assert line.frequency_hz == pytest.approx(20.0037, abs=0.002)
    assert line.rms_nm == pytest.approx(300, abs=3 * line.rms_error_nm)
    assert line.rms_error_nm < 40
    assert found.noise_nm == pytest.approx(5, rel=0.02)


def test_a_line_that_is_resolved_says_so() -> None:
    y, c = integrator_loop(lines=((40, 0.01, 30),), frames=20_000)
    (line,) = identify_series(y[:, 0], c[:, 0], frame_rate_hz=RATE).lines
    assert line.resolved
    assert line.damping == pytest.approx(0.01, abs=5 * line.damping_error)


@pytest.mark.study
def test_random_closed_loops_reach_what_the_page_says() -> None:
    sys.path.insert(0, str(Path(ROOT) / "benchmarks"))
    try:
        from identification import studied
    finally:
        sys.path.pop(0)
    results = [studied(seed, 60_000) for seed in range(40)]
    found, missed, false = (
        sum(len(r[key]) for r in results) for key in ("found", "missed", "false")
    )
    assert found / (found + missed) > 0.95
    assert false / len(results) < 0.2
    ratio = np.array([r["ratio"] for r in results])
    assert np.median(ratio) < 1.03
    assert np.percentile(ratio, 95) < 1.10
    half = np.array([r["half_ratio"] for r in results])
    assert np.median(half) < 1.01
    assert np.mean(half < 1) > 0.5


@pytest.mark.parametrize(("frequency", "stretch"), [(60.0, 667), (30.0, 667), (51.603, 1000)])
def test_short_stretches_do_not_lead_to_a_sidelobe(frequency: float, stretch: int) -> None:
    rng = np.random.default_rng(3)
    k = np.arange(20_000)
    slow = lfilter([1], [1, -0.99], 4 * rng.standard_normal(k.size))
    z = slow + 5 * rng.standard_normal(k.size)
    z += 50 * np.sqrt(2) * np.cos(2 * np.pi * frequency * k / RATE + 1)
    pieces = [(j, j + stretch) for j in range(0, k.size - stretch, stretch + 5)]
    found = identify_series(z, frame_rate_hz=RATE, stretches=pieces)
    (line,) = found.lines
    assert line.frequency_hz == pytest.approx(frequency, abs=0.1)
    assert line.rms_nm == pytest.approx(50, rel=0.15)
    assert found.turbulence_fit.damping > 0.05


def joint(
    gains: tuple[float, float], loop_gains: tuple[float, float]
) -> lbt.identification.IdentifiedModel:
    parts = [
        integrator_loop(sensor_gain=g, gain=k, seed=i, frames=20_000, noise=10.0)
        for i, (g, k) in enumerate(zip(gains, loop_gains, strict=True))
    ]
    y, c = (np.hstack([part[i] for part in parts]) for i in range(2))
    u = np.vstack([c, np.zeros((2, 2))])
    record = lbt.identification.loop_record(
        np.vstack([np.zeros((2, 2)), y]), u, frame_rate_hz=RATE, delay_frames=2.0, unit="nm"
    )
    return lbt.identify(record)


def test_axes_share_a_sensor_gain_where_they_agree() -> None:
    same = joint((0.6, 0.6), (0.4, 0.4))
    assert same.axes[0].sensor_gain == same.axes[1].sensor_gain
    assert same.axes[0].sensor_gain_error is not None
    assert same.sensor_gains[0] == pytest.approx(0.6, abs=4 * same.axes[0].sensor_gain_error)
    other = joint((0.9, 0.4), (0.4, 0.4))
    assert other.sensor_gains == pytest.approx((0.9, 0.4), rel=0.1)
    assert "different sensor gains" in other.notes[0]
    one = joint((0.6, 0.6), (0.4, 0.002))
    assert one.axes[0].sensor_gain == one.axes[1].sensor_gain


def test_a_mean_gain_is_no_better_than_its_axes_agree() -> None:
    """The error of a mean of two is half their difference where that exceeds their errors."""
    model = joint((0.6, 0.65), (0.4, 0.4))
    assert model.sensor_gains[0] == model.sensor_gains[1]
    assert model.axes[0].sensor_gain_error == pytest.approx(0.025, rel=0.15)
    agreed = joint((0.6, 0.6), (0.4, 0.4))
    assert agreed.axes[0].sensor_gain_error < 0.013


def test_identify_needs_what_it_needs() -> None:
    y = np.random.default_rng(0).standard_normal((6000, 1))
    without = lbt.identification.loop_record(y, y, frame_rate_hz=RATE, unit="nm")
    with pytest.raises(ProblemError, match="give delay_frames"):
        lbt.identify(without)
    with pytest.raises(ProblemError, match="one number, or one per measurement \\(1\\)"):
        lbt.identify(
            lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm"), sensor_gain=[1.0, 2.0]
        )
    with pytest.raises(ProblemError, match="expected an IdentifiedModel"):
        lbt.report.figures.identification_figure("model")


def with_commands_of_size(
    record: lbt.identification.LoopRecord, factor: float
) -> lbt.identification.LoopRecord:
    assert record.commands is not None
    return replace(record, commands=factor * record.commands)


@pytest.mark.parametrize("factor", [1 / 500, 100.0])
def test_commands_in_other_units_are_doubted(factor: float) -> None:
    record = spliced_record((0,), lines=LINE, frames=20_000)
    found = lbt.identify(with_commands_of_size(record, factor))
    doubted = any("units, signs and axes of the commands" in note for note in found.notes)
    assert doubted or "leave it open" in found.axes[0].sensor_gain_note


@pytest.mark.parametrize(("factor", "doubted"), [(0.5, True), (0.7, False), (1.0, False)])
def test_a_gain_above_one_is_named_as_commands_of_part_size(factor: float, doubted: bool) -> None:
    record = spliced_record((0,), lines=LINE, frames=40_000)
    found = lbt.identify(with_commands_of_size(record, factor))
    assert found.axes[0].sensor_gain == pytest.approx(0.6 / factor, rel=0.05)
    assert any("--command-scale 2" in note for note in found.notes) == doubted


def test_wide_resonances_that_hide_the_gain_are_noted() -> None:
    lines = ((20.0, 0.1, 60.0), (60.0, 0.3, 40.0), (130.0, 0.5, 40.0))
    axis = lbt.identify(spliced_record((1,), lines=lines, frames=60_000, noise=8.0)).axes[0]
    assert axis.sensor_gain == pytest.approx(0.6, abs=3 * axis.sensor_gain_error)


def test_innovations_that_are_not_white_are_noted() -> None:
    record = spliced_record(lines=((40, 0.01, 30.0),), frames=8192)
    for most_lines, count in ((0, 1), (5, 0)):
        model = lbt.identify(record, sensor_gain=0.6, most_lines=most_lines)
        notes = [note for note in model.notes if "are not white" in note]
        assert len(notes) == count
        assert all("standard errors do not cover" in note for note in notes)


def test_a_wide_resonance_is_no_turbulence() -> None:
    axis = lbt.identify(spliced_record((1,), lines=((60.0, 0.3, 30.0),), frames=60_000)).axes[0]
    assert axis.turbulence_fit.frequency_hz < 3
    assert axis.turbulence.rms_nm == pytest.approx(300, rel=0.3)
    (part,) = axis.parts
    assert part.kind == "broad"
    assert part.frequency_hz == pytest.approx(60, rel=0.1)


def test_standard_errors_hold_the_error_of_the_gain() -> None:
    deviations = []
    for seed in range(10):
        parts = [
            integrator_loop(lines=((31, 0.05, 60),), gain=0.15, seed=10 * seed + i, frames=15_000)
            for i in range(2)
        ]
        y, c = (np.hstack([part[i] for part in parts]) for i in range(2))
        record = lbt.identification.loop_record(
            y[:-2], np.vstack([c[2:], c[-2:]])[:-2], frame_rate_hz=RATE, delay_frames=2, unit="nm"
        )
        model = lbt.identify(record)
        alone = identify_series(
            y[:, 0], c[:, 0], frame_rate_hz=RATE, sensor_gain=model.sensor_gains[0]
        )
        deviations += [
            (axis.lines[0].rms_nm - 60) / axis.lines[0].rms_error_nm
            for axis in model.axes
            if axis.lines
        ]
        # a gain that is given without an error makes them smaller
        assert model.axes[0].lines[0].rms_error_nm > alone.lines[0].rms_error_nm
    assert 0.5 < np.sqrt(np.mean(np.square(deviations))) < 1.6


def test_the_limit_of_lines_is_kept_and_noted() -> None:
    lines = tuple((10.0 + 12 * i, 0.004, 30.0) for i in range(8))
    record = spliced_record(lines=lines, frames=20_000)
    found = lbt.identify(record, most_lines=5, sensor_gain=0.6)
    assert sum(part.kind != "turbulence" for part in found.axes[0].parts) <= 5
    assert any("limit of 5 lines was reached" in note for note in found.notes)
    assert not any("limit" in note for note in lbt.identify(record, sensor_gain=0.6).notes)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sensor_gain": 1e300}, "sensor_gain must be"),
        ({"sensor_gain": "x"}, "sensor_gain must be an array of numbers"),
        ({"announced": [[31.0, 0.1, 0.0]]}, "announced must be"),
        ({"start": 3}, "IdentifiedModel"),
        ({"stretches": [(2, 4000), (3000, 5000)]}, "in order, apart"),
        ({"stretches": [(0, 4000)]}, "usable"),
        ({"frame_rate_hz": 900.0}, "for spectra only"),
        ({"delay_frames": 3.0}, "with_delay"),
    ],
)
def test_bad_requests(options: dict[str, object], words: str) -> None:
    with pytest.raises(ProblemError, match=words):
        lbt.identify(spliced_record(frames=6000), **options)  # type: ignore[arg-type]


def test_a_dead_axis_is_named() -> None:
    y = np.random.default_rng(0).standard_normal((6000, 2))
    y[:, 1] = 0
    record = lbt.identification.LoopRecord(
        frame_rate_hz=RATE,
        measurements=y,
        measured=np.ones(6000, dtype=bool),
        commanded=np.ones(6000, dtype=bool),
    )
    with pytest.raises(ProblemError, match="axis 1 of the record is constant"):
        lbt.identify(record)


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return eris_example()


@pytest.fixture(scope="module")
def seen() -> lbt.identification.SpectrumRecord:
    return eris_record()


@pytest.fixture(scope="module")
def model() -> lbt.identification.IdentifiedModel:
    return eris_model()


def test_spectrum_without_scatter_is_taken_for_one_periodogram(example):
    plain = lbt.load_record(ERIS_FILE, kind="spectrum", unit="nm^2/Hz")
    found = lbt.identify(plain, frame_rate_hz=1000)
    assert len(found.notes) == 2
    assert all("does not scatter" in note for note in found.notes)
    for column, axis in zip(plain.density_nm2_hz.T, found.axes, strict=True):
        assert axis.data.count[0] == 1
        assert len(axis.lines) >= 8
        peaks = np.array(example.peaks(plain.frequency_hz, column))[:, 0]
        assert all(np.min(np.abs(peaks - line.frequency_hz)) < 0.06 for line in axis.lines)
        assert all(line.rms_nm < 30 for line in axis.lines)  # 332 where it counts as a million


@pytest.mark.parametrize(
    "option", [{"sensor_gain": 0.5}, {"stretches": [(0, 600)]}, {"start": "model"}]
)
def test_a_spectrum_takes_no_options_of_series(option, model):
    plain = lbt.load_record(ERIS_FILE, kind="spectrum", unit="nm^2/Hz")
    given = {"start": model} if "start" in option else option
    with pytest.raises(lbt.errors.ProblemError, match="is for series of a loop"):
        lbt.identify(plain, frame_rate_hz=1000, **given)


def test_the_noise_of_a_spectrum_without_any_is_stated():
    """A spectrum of wind shake has none, and no filter is designed for that."""
    f = np.arange(0.5, 400, 0.5)
    shake = 3000 / (1 + (f / 1.5) ** 2) ** 2 + 16 / np.pi / ((f - 18) ** 2 + 0.16)
    spectrum = lbt.identification.SpectrumRecord(frequency_hz=f, density_nm2_hz=shake[:, None])
    stated = lbt.identify(spectrum, frame_rate_hz=1000, noise_nm=5.0)
    assert stated.axes[0].noise_nm == 5.0
    design = lbt.kalman(stated.plant())
    assert design.certificate.passed
    assert stated.truth().noise_nm.tolist() == [5.0]
    with pytest.raises(lbt.errors.ProblemError, match="noise_nm must be above 0"):
        lbt.identify(spectrum, frame_rate_hz=1000, noise_nm=0.0)
    with pytest.raises(lbt.errors.ProblemError, match="noise_nm is for spectra"):
        lbt.identify(spliced_record((0,), frames=4096), noise_nm=5.0)


def test_known_lines_are_found(model):
    for axis, known in zip(
        model.axes,
        ([10, 16, 25.8, 45.5, 48.3, 96.7], [10, 16, 45.5, 48.3, 72.5, 96.7]),
        strict=True,
    ):
        places = np.array([line.frequency_hz for line in axis.lines])
        for frequency in known:
            assert np.min(np.abs(places - frequency)) < 0.06
    assert not model.notes


def test_identified_rms_are_those_of_the_bins(model, seen, example):
    strong = 0
    for i, axis in enumerate(model.axes):
        peaks = np.array(example.peaks(seen.frequency_hz, seen.density_nm2_hz[:, i]))
        for line in axis.lines:
            near = peaks[np.abs(peaks[:, 0] - line.frequency_hz) < 0.08]
            size = np.sqrt(np.sum(near[:, 1] ** 2))
            assert size > 0  # none is where the file has nothing
            assert 0.4 * size < line.rms_nm < 1.4 * size
            assert 0 < line.rms_error_nm < line.rms_nm
            strong += abs(line.rms_nm - size) < 2 * line.rms_error_nm
    assert strong >= 17  # of 22


def test_kalman_removes_what_the_integrator_leaves_of_the_lines(model, seen, example):
    met, plant = example.disturbance(seen), example.composed(model)
    lines = {}
    for name, design in {
        "integrator": lbt.design.model_integrator(plant),
        "Kalman": lbt.kalman(plant),
    }.items():
        assert design.certificate.passed
        loop = lbt.close_loop(plant.hardware, design.controller)
        parts = example.residual(loop, met)
        lines[name] = example.rms(parts["lines"])
        # bin by bin, without quadrature
        f, step = seen.frequency_hz, np.median(np.diff(seen.frequency_hz))
        excess = np.array([part.psd(f) for part in met.lines]).T
        power = np.einsum("fij,fj->", np.abs(loop.sensitivity(f)) ** 2, excess) * step
        assert lines[name] == pytest.approx(np.sqrt(power), rel=0.16)
        assert example.rms(parts["total"]) ** 2 == pytest.approx(
            sum(example.rms(parts[key]) ** 2 for key in parts if key != "total")
        )
        limit = lbt.loop.least_residual(plant.hardware, met.whole)
        assert limit.rms_nm < example.rms(parts["total"])
    assert lines["Kalman"] < 0.3 * lines["integrator"]


def test_turbulence_of_the_plant_is_the_atmospheres(model, example):
    plant = example.composed(model)
    air = lbt.models.ar2_turbulence(example.AIR, frame_rate_hz=1000, noise_nm=example.NOISE_NM)
    made = plant.vibrations[0].ar_model(1000)
    assert made.coefficients == pytest.approx(air.coefficients, rel=1e-9)
    assert made.rms_nm == pytest.approx(air.rms_nm, rel=1e-9)


def test_a_printed_model_lists_its_vibrations_with_their_errors(model):
    shown = [line.split() for line in str(model).splitlines()]
    for part in model.parts:
        rows = [row for row in shown if f"{part.frequency_hz:.3f}" in row]
        assert any(f"{part.frequency_error_hz:.2g}" in row for row in rows)
        assert any(f"{part.rms_nm:.2f}" in row for row in rows)
    assert len(repr(model)) <= 100
    assert len(repr(model.axes[0])) <= 100
