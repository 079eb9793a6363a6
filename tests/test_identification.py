"""Identification: spectra with gradients, likelihood of a closed loop, lines, sensor gain."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import approx_fprime

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.identification.fit.line_candidates import find_candidates
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.fit.whittle import GAIN, Likelihood
from lbt_synth.models.resonance_spectrum import coefficients, log_density, log_roll_off

RATE = 1000.0
FRAMES = 16_384


def loop_of(
    *,
    lines: tuple[tuple[float, float, float], ...] = (),
    noise: float = 6.0,
    sensor_gain: float = 0.6,
    gain: float = 0.4,
    frames: int = FRAMES,
    seed: int = 0,
    turbulence: lbt.models.ARModel | None = None,
    axes: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Measurements and corrections of an integrator's loop, (frames, axes) each."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=axes)
    direction = (1.0,) if axes == 1 else (1.0, 0.0)
    truth = lbt.Truth(
        turbulence=slow() if turbulence is None else turbulence,
        vibrations=tuple(
            lbt.Vibration(frequency_hz=f, damping=z, rms_nm=r, direction=direction)
            for f, z, r in lines
        ),
        noise_nm=noise,
        sensor_gain=sensor_gain,
    )
    controller = lbt.integrator(path, gain=gain).controller
    run = lbt.simulate(controller, truth, hardware=path, frames=frames, seed=seed)
    return run.measurements[0][2:], run.commands[0][:-2]


def slow() -> lbt.models.ARModel:
    """Turbulence of 300 nm around 1 Hz."""
    a1, a2, drive = coefficients(2 * np.pi * 1.0 / RATE, 0.6)
    return lbt.models.ARModel(
        coefficients=[a1, a2], driving_rms_nm=300 * np.sqrt(drive), frame_rate_hz=RATE
    )


@given(
    frequency=st.floats(0.01, 400),
    damping=st.floats(1e-4, 20).filter(lambda z: abs(z - 1) > 1e-6),
)
@settings(max_examples=60, deadline=None)
def test_density_is_that_of_the_process_and_its_derivatives_are_right(
    frequency: float, damping: float
) -> None:
    f = np.array([0.02, 0.7, 5.0, 60.0, 333.0, 499.0])
    s = 4 * np.sin(np.pi * f / RATE) ** 2
    w = 2 * np.pi * frequency / RATE
    value, by_frequency, by_damping = log_density(w, damping, s)
    a1, a2, drive = coefficients(w, damping)
    # the direct formula loses digits to cancellation where b is small
    direct = np.log(drive) - 2 * np.log(
        np.abs(1 - a1 * np.exp(-2j * np.pi * f / RATE) - a2 * np.exp(-4j * np.pi * f / RATE))
    )
    assert value == pytest.approx(direct, abs=1e-15 / w**2 + 1e-8)
    h = 1e-5
    for found, move in ((by_frequency, (h, 0)), (by_damping, (0, h))):
        up, down = (
            log_density(w * np.exp(t * move[0]), damping * np.exp(t * move[1]), s)[0]
            for t in (1, -1)
        )
        numeric = (up - down) / (2 * h)
        assert found == pytest.approx(numeric, abs=1e-5 * (1 + np.max(np.abs(numeric))))


def test_density_has_unit_variance_and_passes_critical_damping_smoothly() -> None:
    f = np.linspace(0, RATE / 2, 400_001)
    s = 4 * np.sin(np.pi * f / RATE) ** 2
    for damping in (0.05, 1 - 1e-9, 1 + 1e-9, 3.0):
        value, *_ = log_density(2 * np.pi * 20 / RATE, damping, s)
        mean = np.trapezoid(np.exp(value), f) / (RATE / 2)
        assert mean == pytest.approx(1, rel=1e-6)
    around = [log_density(0.1, z, s[1:]) for z in (1 - 1e-9, 1 + 1e-9)]
    for one, other in zip(*around, strict=True):
        assert np.allclose(one, other, rtol=1e-6, atol=1e-6)


def test_roll_off_has_unit_gain_at_zero_and_a_right_derivative() -> None:
    s = np.array([0.0, 1e-4, 0.5, 4.0])
    for corner in (1e-3, 0.2, 3.0):
        value, slope = log_roll_off(corner, s)
        assert value[0] == 0
        numeric = (
            log_roll_off(corner * np.exp(1e-6), s)[0] - log_roll_off(corner * np.exp(-1e-6), s)[0]
        ) / 2e-6
        assert slope == pytest.approx(numeric, abs=1e-8)


def test_periodogram_of_white_noise_is_its_density_and_leaks_nothing_of_turbulence() -> None:
    rng = np.random.default_rng(1)
    white = 3 * rng.standard_normal(20_000)
    data = loop_periodogram(white, None, frame_rate_hz=RATE, stretches=[(0, white.size)])
    density = 2 * 9 / RATE
    assert np.mean(data.power(1.0)) == pytest.approx(density, rel=0.02)
    # a random walk a thousand times larger at low frequencies leaves the noise as it is
    walk = np.cumsum(rng.standard_normal(white.size)) * 2
    leaking = loop_periodogram(white + walk, None, frame_rate_hz=RATE, stretches=[(0, white.size)])
    walk_density = 2 * 4 / RATE / (4 * np.sin(np.pi * data.frequency_hz / RATE) ** 2)
    high = data.frequency_hz > 300
    excess = np.mean(leaking.power(1.0)[high] / (density + walk_density[high]))
    assert excess == pytest.approx(1, rel=0.04)


@given(gain=st.floats(0.1, 3), cut=st.integers(2000, 6000))
@settings(max_examples=10, deadline=None)
def test_periodogram_is_quadratic_in_the_gain(gain: float, cut: int) -> None:
    rng = np.random.default_rng(cut)
    y, c = rng.standard_normal((2, 8000))
    pieces = [(0, cut), (cut + 100, 8000)]
    parts = loop_periodogram(y, c, frame_rate_hz=RATE, stretches=pieces)
    whole = loop_periodogram(y + gain * c, None, frame_rate_hz=RATE, stretches=pieces)
    assert parts.power(gain) == pytest.approx(whole.power(1.0), rel=1e-9, abs=1e-12)


def test_a_gap_shortens_the_segments_and_keeps_most_frames() -> None:
    rng = np.random.default_rng(0)
    y = rng.standard_normal(30_000)
    y[9990:10_010] = 1e6  # what a gap holds is never used
    data = loop_periodogram(y, None, frame_rate_hz=RATE, stretches=[(0, 9990), (10_010, 30_000)])
    assert np.mean(data.power(1.0)) == pytest.approx(2 / RATE, rel=0.03)
    assert 0.8 * 15_000 < np.sum(data.count) < 15_000


def likelihood() -> tuple[Likelihood, np.ndarray]:
    y, c = loop_of(lines=((40, 0.01, 30),), frames=4096)
    data = loop_periodogram(y[:, 0], c[:, 0], frame_rate_hz=RATE, stretches=[(0, len(y))])
    w = 2 * np.pi / RATE
    theta = np.array(
        [
            np.log(0.7),
            np.log(30),
            np.log(20 * w),
            np.log(1.1 * w),
            np.log(0.5),
            np.log(200.0**2),
            np.log(39 * w),
            np.log(0.02 / 0.98),
            np.log(15.0**2),
        ]
    )
    return Likelihood(data), theta


def test_gradient_and_information_of_the_likelihood() -> None:
    like, theta = likelihood()
    value, gradient, information = like.derivatives(theta)
    assert value == pytest.approx(like.contrast(theta), rel=1e-12)
    numeric = approx_fprime(theta, like.contrast, 1e-6)
    assert gradient == pytest.approx(numeric, rel=2e-3, abs=1e-3 * np.max(np.abs(numeric)))
    # the rows of the gain are exact second derivatives
    for h in (1e-5,):
        step = np.zeros(theta.size)
        step[GAIN] = h
        row = (like.derivatives(theta + step)[1] - like.derivatives(theta - step)[1]) / (2 * h)
        assert information[GAIN] == pytest.approx(row, rel=1e-4, abs=1e-4 * np.max(np.abs(row)))
    # the others are those of the model where the data are the model
    pure = Likelihood(
        dataclasses.replace(
            like.data,
            measured=like.model(theta),
            crossed=np.zeros_like(like.data.crossed),
            corrected=np.zeros_like(like.data.corrected),
        )
    )
    _, flat, expected = pure.derivatives(theta)
    assert flat == pytest.approx(0, abs=1e-8)
    rows = np.array(
        [
            (pure.derivatives(theta + h)[1] - pure.derivatives(theta - h)[1]) / 2e-5
            for h in 1e-5 * np.eye(theta.size)[1:]
        ]
    )
    assert expected[1:, 1:] == pytest.approx(rows[:, 1:], rel=1e-3, abs=1e-3 * np.max(rows))


def test_scan_finds_a_line_and_nothing_in_noise() -> None:
    rng = np.random.default_rng(3)
    n = 20_000
    noise = rng.standard_normal(n)
    flat = np.full(9999, 2 / RATE)
    for amplitude, count in ((0.0, 0), (0.3, 1)):
        y = noise + amplitude * np.sin(2 * np.pi * 77.7 * np.arange(n) / RATE)
        data = loop_periodogram(y, None, frame_rate_hz=RATE, stretches=[(0, n)])
        found = find_candidates(
            data, data.power(1.0), flat[: data.frequency_hz.size], least=14.0, most=5
        )
        assert len(found) == count
        if count:
            assert found[0].frequency_hz == pytest.approx(77.7, abs=0.1)


def test_closed_loop_gives_lines_noise_and_sensor_gain() -> None:
    y, c = loop_of(lines=((17.0, 0.006, 40), (63.0, 0.004, 12)), frames=40_000)
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
    assert found.turbulence.rms_nm == pytest.approx(300, abs=5 * found.turbulence_fit.rms_error_nm)
    assert found.turbulence_fit.rms_nm == pytest.approx(found.turbulence.rms_nm, rel=1e-9)
    # the model stands for the spectrum of the phase
    truth = slow().psd(found.frequency_hz) + 2 * (6 / 0.6) ** 2 / RATE
    away = found.frequency_hz > 150
    assert np.median(found.fitted_nm2_hz[away] / truth[away]) == pytest.approx(1, rel=0.1)


def test_standard_errors_are_honest() -> None:
    deviations: dict[str, list[float]] = {"f": [], "z": [], "rms": [], "noise": [], "gain": []}
    for seed in range(12):
        y, c = loop_of(lines=((45.0, 0.02, 25),), seed=seed, frames=12_000)
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


@given(scale=st.sampled_from([1e-3, 0.02, 50.0]))
@settings(max_examples=3, deadline=None)
def test_units_do_not_matter(scale: float) -> None:
    y, c = loop_of(lines=((40, 0.01, 30),), frames=8192)
    one = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    other = lbt.identification.identify_axis(scale * y[:, 0], scale * c[:, 0], frame_rate_hz=RATE)
    assert other.sensor_gain == pytest.approx(one.sensor_gain, rel=1e-3)
    assert other.noise_nm == pytest.approx(scale * one.noise_nm, rel=1e-3)
    for a, b in zip(one.lines, other.lines, strict=True):
        assert b.frequency_hz == pytest.approx(a.frequency_hz, rel=1e-4)
        assert b.rms_nm == pytest.approx(scale * a.rms_nm, rel=1e-3)


def test_the_model_designs_a_filter_as_good_as_the_truth() -> None:
    lines = ((17.0, 0.006, 40), (63.0, 0.004, 12))
    y, c = loop_of(lines=lines, frames=40_000)
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
    y, c = loop_of(gain=0.002, frames=8192, noise=20.0)
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
    told = lbt.identification.identify_axis(10 * y, frame_rate_hz=RATE, announced=[(90.0, 0.05)])
    wrong = lbt.identification.identify_axis(10 * y, frame_rate_hz=RATE, announced=[(140.0, 0.05)])
    assert not plain.lines
    assert not wrong.lines
    (line,) = told.lines
    assert line.announced
    assert line.frequency_hz == pytest.approx(90, abs=0.1)


def test_a_start_leads_to_the_same_place() -> None:
    y, c = loop_of(lines=((40, 0.01, 30),))
    once = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    again = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE, start=once)
    assert again.sensor_gain == pytest.approx(once.sensor_gain, rel=1e-3)
    assert [line.frequency_hz for line in again.lines] == pytest.approx(
        [line.frequency_hz for line in once.lines], abs=0.005
    )


def test_what_is_left_out_is_not_white() -> None:
    y, c = loop_of(lines=((40, 0.01, 30),))
    found = lbt.identification.identify_axis(
        y[:, 0], c[:, 0], frame_rate_hz=RATE, sensor_gain=0.6, most_lines=0
    )
    assert not found.lines
    assert not found.whiteness.white
    assert found.whiteness.p_value < 1e-6


def test_two_close_lines_are_told_apart() -> None:
    y, c = loop_of(lines=((60.0, 0.002, 40), (61.2, 0.002, 25)), frames=40_000)
    found = lbt.identification.identify_axis(y[:, 0], c[:, 0], frame_rate_hz=RATE)
    assert [line.frequency_hz for line in found.lines] == pytest.approx([60.0, 61.2], abs=0.1)


def test_spectrum_of_known_averages() -> None:
    f = np.arange(1, 1600) * 0.25
    line = lbt.Vibration(frequency_hz=52, damping=0.02, rms_nm=30).ar_model(RATE)
    density = line.psd(f) + slow().psd(f) + 0.05
    chance = np.random.default_rng(0).gamma(20.0, 1 / 20.0, f.size)
    for averages in (20.0, None):
        found = lbt.identification.identify_spectrum(
            f, density * chance, frame_rate_hz=RATE, averages=averages
        )
        (peak,) = found.lines
        assert peak.frequency_hz == pytest.approx(52, abs=5 * peak.frequency_error_hz)
        assert peak.rms_nm == pytest.approx(30, abs=5 * peak.rms_error_nm)
        assert found.data.count[0] == pytest.approx(20, rel=0.25)


def joint(
    gains: tuple[float, float], loop_gains: tuple[float, float]
) -> lbt.identification.IdentifiedModel:
    parts = [
        loop_of(sensor_gain=g, gain=k, seed=i, frames=20_000, noise=10.0)
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
    assert one.axes[1].sensor_gain_note == "that of the other axis"
    assert one.axes[0].sensor_gain == one.axes[1].sensor_gain


def test_identify_needs_what_it_needs() -> None:
    y = np.random.default_rng(0).standard_normal((6000, 1))
    without = lbt.identification.loop_record(y, y, frame_rate_hz=RATE, unit="nm")
    with pytest.raises(ProblemError, match="with_delay"):
        lbt.identify(without)
    with pytest.raises(ProblemError, match="one number, or 1"):
        lbt.identify(
            lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm"), sensor_gain=[1.0, 2.0]
        )
    with pytest.raises(ProblemError, match="expected an IdentifiedModel"):
        lbt.report.figures.identification_figure("model")


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"measurement": np.zeros((20, 2))}, DimensionError, "must be a series"),
        ({"measurement": np.full(2000, np.nan)}, NonFiniteError, "measurement"),
        ({"correction": np.zeros(10)}, DimensionError, "correction must have shape"),
        ({"frame_rate_hz": 0}, ProblemError, "frame_rate_hz"),
        ({"stretches": [(0, 5000)]}, ProblemError, "stretches must lie"),
        ({"stretches": [(0, 300)]}, ProblemError, "at least 512 frames"),
        ({"stretches": []}, ProblemError, "at least 512 frames"),
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
        lbt.identification.identify_spectrum(f, density, frame_rate_hz=RATE)
