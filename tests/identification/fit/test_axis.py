"""One axis identified: lines, noise, sensor gain, standard errors, and what is refused."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter
from support.plants import ROOT
from support.recorded_loops import (
    expected_periodogram,
    hidden_resonance_record,
    integrator_loop,
    slow,
)

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.identification.fit import axis
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.order_search import try_other_gains

RATE = 1000.0


FRAMES = 16_384


def test_closed_loop_gives_lines_noise_and_sensor_gain() -> None:
    y, c = integrator_loop(lines=((17.0, 0.006, 40), (63.0, 0.004, 12)), frames=40_000)
    found = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)
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
    found = lbt.identification.identify_axis(y[2:], u[:-2], frame_rate_hz=RATE)
    assert found.sensor_gain_error is not None
    assert abs(found.sensor_gain - 0.995) < 2 * found.sensor_gain_error


def test_standard_errors_are_honest() -> None:
    deviations: dict[str, list[float]] = {"f": [], "z": [], "rms": [], "noise": [], "gain": []}
    for seed in range(12):
        y, c = integrator_loop(lines=((45.0, 0.02, 25),), seed=seed, frames=12_000)
        found = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)
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
    return lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)


@pytest.mark.parametrize("colour", [0.1, 0.6])
def test_noise_that_is_not_white_leaves_the_gain(colour: float) -> None:
    """As white noise it moved the gain by 10 and by 25 of its standard errors."""
    found = identify_coloured(colour, 6, seed=1)
    assert found.sensor_gain_error is not None
    assert found.sensor_gain == pytest.approx(0.6, abs=3 * found.sensor_gain_error)
    assert found.sensor_gain_error < 0.04
    assert found.noise_correlation == pytest.approx(colour, abs=3 * found.noise_correlation_error)
    assert found.noise_nm == pytest.approx(6, abs=3 * found.noise_error_nm)
    assert len(found.lines) == len(found.parts) == 1


def test_a_colour_that_falls_short_of_its_price_widens_the_error_of_the_gain() -> None:
    """White noise and a gain of 0.85 for 0.6, ten errors off, are nearly as likely."""
    found = identify_coloured(0.1, 11.5, seed=7, gain=0.3)
    assert found.sensor_gain_error is not None
    assert found.sensor_gain == pytest.approx(0.6, abs=2 * found.sensor_gain_error)
    assert found.noise_correlation == 0
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
    found = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)
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
    found = lbt.identification.identify_axis(y[2:], u[:-2], frame_rate_hz=rate)
    if found.sensor_gain_error is None:
        assert "not found" in found.sensor_gain_note
        low, high = found.likely_gains or (0.0, 0.0)
        assert 0.2 < low < truth_gain < 1.1 * high < 2.0
    else:
        assert found.sensor_gain == pytest.approx(truth_gain, abs=3 * found.sensor_gain_error)


@pytest.mark.parametrize(("gain", "doubted"), [(0.6, False), (1.5, True), (0.15, True)])
def test_an_implausible_gain_is_doubted_however_well_it_is_known(
    monkeypatch: pytest.MonkeyPatch, gain: float, doubted: bool
) -> None:
    """Two good records under a drift were refused for fits at 1.4, 20 errors from the truth."""
    tried = []

    def spy(search, model, rivals):
        tried.append(model.spectrum.gain)
        return try_other_gains(search, model, rivals)

    monkeypatch.setattr(axis, "try_other_gains", spy)
    air = lbt.Atmosphere(seeing_arcsec=1.0, outer_scale_m=25, wind_speed_m_s=12, diameter_m=8.22)
    search = Search(data=expected_periodogram(air, 5.0, gain))
    found = axis.find_axis(search, assumed_gain=1.0, start=None)
    assert bool(tried) == doubted
    assert found.sensor_gain == pytest.approx(gain, rel=0.03)  # and stays where it is right


@given(scale=st.sampled_from([1e-3, 0.02, 50.0]))
@settings(max_examples=3, deadline=None)
def test_units_do_not_matter(scale: float) -> None:
    y, c = integrator_loop(lines=((40, 0.01, 30),), frames=8192)
    one = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    other = lbt.identification.identify_axis(scale * y[:, 0], scale * c[:, 0], frame_rate_hz=RATE)
    assert other.sensor_gain == pytest.approx(one.sensor_gain, rel=1e-3)
    assert other.noise_nm == pytest.approx(scale * one.noise_nm, rel=1e-3)
    for a, b in zip(one.lines, other.lines, strict=True):
        assert b.frequency_hz == pytest.approx(a.frequency_hz, rel=1e-4)
        assert b.rms_nm == pytest.approx(scale * a.rms_nm, rel=1e-3)


def test_the_model_designs_a_filter_as_good_as_the_truth() -> None:
    lines = ((17.0, 0.006, 40), (63.0, 0.004, 12))
    y, c = integrator_loop(lines=lines, frames=40_000)
    axis = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)
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
    found = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE, assumed_gain=0.7)
    assert found.sensor_gain == pytest.approx(0.7, rel=1e-12)
    assert found.sensor_gain_error is None
    assert "assumed to be 0.7, not found" in found.sensor_gain_note
    open_loop = lbt.identification.identify_axis(y[:, 0] + 0.6 * c[:, 0], frame_rate_hz=RATE)
    assert open_loop.sensor_gain == 1
    assert "open loop" in open_loop.sensor_gain_note
    given_gain = lbt.identification.identify_axis(
        y[:, 0], c[:, 0], frame_rate_hz=RATE, sensor_gain=0.6
    )
    assert given_gain.sensor_gain == pytest.approx(0.6, rel=1e-12)
    assert given_gain.sensor_gain_note == "given"


def test_an_announced_line_is_found_where_a_search_would_not_dare() -> None:
    rng = np.random.default_rng(5)
    n = 16_384
    y = rng.standard_normal(n) + 0.05 * np.sin(2 * np.pi * 90.0 * np.arange(n) / RATE)
    plain = lbt.identification.identify_axis(10 * y, frame_rate_hz=RATE)
    known = lbt.identification.identify_axis(10 * y, frame_rate_hz=RATE, announced=[(90.0, 0.05)])
    wrong = lbt.identification.identify_axis(10 * y, frame_rate_hz=RATE, announced=[(140.0, 0.05)])
    assert not plain.lines
    assert not wrong.lines
    (line,) = known.lines
    assert line.announced
    assert line.frequency_hz == pytest.approx(90, abs=0.1)


def test_a_start_leads_to_the_same_place() -> None:
    y, c = integrator_loop(lines=((40, 0.01, 30),))
    once = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    again = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE, start=once)
    assert again.sensor_gain == pytest.approx(once.sensor_gain, rel=1e-3)
    assert [line.frequency_hz for line in again.lines] == pytest.approx(
        [line.frequency_hz for line in once.lines], abs=0.005
    )


def test_two_close_lines_are_separated() -> None:
    y, c = integrator_loop(lines=((60.0, 0.002, 40), (61.2, 0.002, 25)), frames=40_000)
    found = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    assert [line.frequency_hz for line in found.lines] == pytest.approx([60.0, 61.2], abs=0.1)


def test_spectrum_of_known_averages() -> None:
    f = np.arange(1, 1600) * 0.25
    line = lbt.Vibration(frequency_hz=52, damping=0.02, rms_nm=30).ar_model(RATE)
    density = line.psd(f) + slow().psd(f) + 0.05
    chance = np.random.default_rng(0).gamma(20.0, 1 / 20.0, f.size)
    for averages in (20.0, None):
        found = axis.identify_spectrum(f, density * chance, frame_rate_hz=RATE, averages=averages)
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
        ({"assumed_gain": 0.0}, ProblemError, "assumed_gain"),
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
        lbt.identification.identify_axis(**(good | change))  # type: ignore[arg-type]


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
        axis.identify_spectrum(f, density, frame_rate_hz=RATE)


def test_a_sinusoid_is_not_resolved_and_its_rms_is_right() -> None:
    rng = np.random.default_rng(0)
    k = np.arange(40_000)
    wave = 300 * np.sqrt(2) * np.cos(2 * np.pi * 20.0037 * k / RATE)
    slow = np.cumsum(rng.standard_normal(k.size))
    found = lbt.identification.identify_axis(
        wave + slow + 5 * rng.standard_normal(k.size), frame_rate_hz=RATE
    )
    (line,) = found.lines
    assert not line.resolved
    assert line.damping * line.frequency_hz * 40 == pytest.approx(0.01, rel=1e-2)
    assert line.frequency_hz == pytest.approx(20.0037, abs=0.002)
    assert line.rms_nm == pytest.approx(300, abs=3 * line.rms_error_nm)
    assert line.rms_error_nm < 40
    assert found.noise_nm == pytest.approx(5, rel=0.02)


def test_a_line_that_is_resolved_says_so() -> None:
    y, c = integrator_loop(lines=((40, 0.01, 30),), frames=20_000)
    (line,) = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE).lines
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
    found = lbt.identification.identify_axis(z, frame_rate_hz=RATE, stretches=pieces)
    (line,) = found.lines
    assert line.frequency_hz == pytest.approx(frequency, abs=0.1)
    assert line.rms_nm == pytest.approx(50, rel=0.15)
    assert found.turbulence_fit.damping > 0.05
