"""Periodograms and their likelihood: parameters, smearing, gradient and information."""

import dataclasses
from functools import cache, partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import simpson
from scipy.signal import fftconvolve
from support.recorded_loops import RATE, integrator_loop, open_record

import lbt_synth as lbt
from lbt_synth.identification.fit import whittle
from lbt_synth.identification.fit.fitting import Search, fit
from lbt_synth.identification.fit.periodogram import TAPER, LoopPeriodogram, loop_periodogram
from lbt_synth.identification.fit.spectrum_model import (
    BACKGROUND,
    GAIN,
    Background,
    Component,
    SpectrumModel,
)

W = 2 * np.pi / RATE
LINE = lbt.Vibration(frequency_hz=40, damping=0.01, rms_nm=50, direction=(0.8, -0.6))


@cache
def correlations() -> tuple[np.ndarray, np.ndarray]:
    """Return lags and the autocorrelation of the taper, by its definition, at them."""
    samples = 240_000
    edge = np.minimum(x := (np.arange(samples) + 0.5) / samples, 1 - x)
    taper = np.where(edge < TAPER / 2, 0.5 - 0.5 * np.cos(2 * np.pi * edge / TAPER), 1.0)
    products = fftconvolve(taper, taper)[samples - 1 :: samples // 1200]
    return np.linspace(0, 1, 1201), np.append(products, 0.0) / products[0]


@pytest.mark.parametrize(("width", "distance"), [(0.02, 0.4), (0.3, 1.3), (2.0, 0.0), (8.0, 5.0)])
def test_smearing_is_the_integral_that_defines_it(width: float, distance: float) -> None:
    t, r = correlations()
    kernel = r * np.exp(-2 * np.pi * width * t) * np.cos(2 * np.pi * distance * t)
    smeared = 2 * simpson(kernel, x=t)
    line = width / np.pi / (width**2 + distance**2)
    log_ratio = whittle.log_smearing(width, np.array([distance]))[0][0]
    assert log_ratio == pytest.approx(np.log(smeared / line), abs=1e-4)


@given(width=st.floats(1e-3, 25), distance=st.floats(0.02, whittle.SKIRT))
@settings(max_examples=10, deadline=None)
def test_derivatives_of_the_smearing(width: float, distance: float) -> None:
    d, h = np.array([-distance, distance]), 1e-6
    _, by_width, by_distance = whittle.log_smearing(width, d)
    wider, narrower = (whittle.log_smearing(width * np.exp(step), d)[0] for step in (h, -h))
    assert by_width == pytest.approx((wider - narrower) / (2 * h), abs=1e-4)
    numeric = whittle.log_smearing(width, d + h)[0] - whittle.log_smearing(width, d - h)[0]
    assert by_distance == pytest.approx(numeric / (2 * h), rel=1e-4, abs=1e-4)
    assert by_distance[0] == pytest.approx(-by_distance[1])


def periodogram_of(series: np.ndarray) -> LoopPeriodogram:
    return loop_periodogram(series, None, frame_rate_hz=RATE, stretches=[(0, series.size)])


def test_periodogram_of_white_noise_is_its_density_and_leaks_nothing_of_turbulence() -> None:
    rng = np.random.default_rng(1)
    white = 3 * rng.standard_normal(20_000)
    data, level = periodogram_of(white), 2 * 9 / RATE
    assert np.mean(data.power(1.0)) == pytest.approx(level, rel=0.02)
    # a random walk a thousand times larger at low frequencies leaves the noise as it is
    leaking = periodogram_of(white + np.cumsum(rng.standard_normal(white.size)) * 2)
    walk_density = 2 * 4 / RATE / (4 * np.sin(np.pi * data.frequency_hz / RATE) ** 2)
    excess = leaking.power(1.0) / (level + walk_density)
    assert np.mean(excess[data.frequency_hz > 300]) == pytest.approx(1, rel=0.04)


def test_a_gap_shortens_the_segments_and_keeps_most_frames() -> None:
    y = np.random.default_rng(0).standard_normal(30_000)
    y[9990:10_010] = 1e6  # what a gap holds is never used
    data = loop_periodogram(y, None, frame_rate_hz=RATE, stretches=[(0, 9990), (10_010, 30_000)])
    assert np.mean(data.power(1.0)) == pytest.approx(2 / RATE, rel=0.03)
    assert 0.8 * 15_000 < np.sum(data.count) < 15_000


def test_what_lies_between_two_axes_at_any_gains() -> None:
    rng = np.random.default_rng(3)
    y, c = np.cumsum(rng.standard_normal((2, 3000, 2)), axis=1)
    make = partial(loop_periodogram, frame_rate_hz=500.0, stretches=[(0, 1400), (1410, 3000)])
    gains, data = np.array([0.7, 1.3]), make(y, c)
    for i in range(2):
        assert data.row(i).power(0.6) == pytest.approx(make(y[:, i], c[:, i]).power(0.6))
    z, matrix = y + gains * c, data.matrix(gains)
    one, other, both = (make(series, None).measured for series in (*z.T, z.sum(axis=1)))
    between = (both - one - other) / 2
    expected = np.array([[one, between], [between, other]])
    assert matrix == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.max(both))


def test_periodogram_of_a_sinusoid_is_the_taper() -> None:
    n, rate, rms, width, frequency = 48_000, 800.0, 100.0, 1e-8, 123.4567
    y = rms * np.sqrt(2) * np.cos(2 * np.pi * frequency * np.arange(n) / rate + 0.3)
    data = loop_periodogram(y, None, frame_rate_hz=rate, stretches=[(0, n)])
    d = (data.frequency_hz - frequency) * data.duration_s
    for low, high in ((0, 1.5), (1.5, 4), (4, 10), (10, 20), (20, 40)):
        inside = (np.abs(d) >= low) & (np.abs(d) < high)
        line = width / np.pi / (width**2 + d[inside] ** 2)
        model = line * np.exp(whittle.log_smearing(width, d[inside])[0]) * rms**2 * data.duration_s
        assert np.mean(data.power(1.0)[inside]) == pytest.approx(np.mean(model), rel=0.06)


def test_skirts_are_those_of_the_line_beyond_the_reach() -> None:
    for width in (0.02, 0.3, 2.0, 12.0):
        log_ratio = whittle.log_smearing(width, whittle.SKIRT + np.arange(8))[0]
        assert np.mean(log_ratio) == pytest.approx(0, abs=0.02)


def component(kind: str, hertz: float, log_odds: float, rms: float, **changes: object) -> Component:
    logs = (float(np.log(hertz * W)), log_odds, 2 * float(np.log(rms)))
    return dataclasses.replace(Component(kind, *logs), **changes)


def line(frequency: float, ratio: float, rms: float, **changes: object) -> Component:
    return component("line", frequency, float(np.log(ratio / (1 - ratio))), rms, **changes)


@cache
def one_axis(*, drift: bool = False, bump: bool = False) -> tuple[LoopPeriodogram, SpectrumModel]:
    """Return the periodogram of one axis in a loop, and a spectrum near to it."""
    y, c = integrator_loop(lines=((40, 0.01, 30),), frames=4096)
    data = loop_periodogram(y[:, 0], c[:, 0], frame_rate_hz=RATE, stretches=[(0, len(y))])
    components = [component("turbulence", 1.1, np.log(0.5), 200.0), line(39, 0.02, 15.0)]
    if bump:
        components.append(line(90, 0.2, 20.0, sections=3))
    if drift:
        components.append(component("drift", 20, np.log(300.0), 50.0))
        components.append(component("slow", 3, 0.3, 50.0))
    background = Background(np.log(0.7), np.log(30), 0.3, np.log(20 * W))
    return data, SpectrumModel((background,), tuple(components))


@cache
def two_axes() -> tuple[LoopPeriodogram, SpectrumModel]:
    """Return the same of two: each has a line, a drift or turbulence, and one line lies between."""
    record = open_record(((LINE, 0),), frames=4096)
    y = record.measurements
    corrections = np.random.default_rng(5).standard_normal(y.shape) + 0.1 * y[:, ::-1]
    data = loop_periodogram(y, corrections, frame_rate_hz=RATE, stretches=[(0, record.frames)])
    backgrounds = tuple(
        Background(np.log(gain), np.log(40), colour, np.log(30 * W))
        for gain, colour in ((0.7, 0.1), (1.3, 0.0))
    )
    slow = component("turbulence", 1.1, np.log(0.5), 280.0)
    drift = component("drift", 20, np.log(300.0), 50.0, axis=1)
    shared = line(41, 0.02, 35, axis=None, log_ratio=2 * np.log(25 / 35), sign=-1.0, name=7)
    components = (slow, line(70, 0.05, 20), dataclasses.replace(slow, axis=1), drift, shared)
    return data, SpectrumModel(backgrounds, components)


def test_an_axis_shows_its_own_components_and_its_share_of_the_others() -> None:
    data, spectrum = two_axes()
    assert spectrum.unpack(spectrum.pack()) == spectrum
    named = spectrum.unpack(np.arange(2 * 4.0 + 5 * 4.0))
    assert named.axes == (Background(0, 1, 2, 3), Background(4, 5, 6, 7))
    line = named.components[1]
    assert (line.log_frequency, line.damping, line.log_power, line.log_ratio) == (12, 13, 14, 15)
    assert spectrum.shared == (4,)
    directions = np.array([[1, 0], [1, 0], [0, 1], [0, 1], [1, -25 / 35]])
    assert spectrum.directions == pytest.approx(directions)
    matrix = whittle.spectral_matrix(data, spectrum)
    for i, sizes in enumerate(([280.0, 20.0, 35.0], [280.0, 50.0, 25.0])):
        alone = spectrum.on(i)
        assert alone.axes == spectrum.axes[i : i + 1]
        assert [c.axis for c in alone.components] == [0] * 3
        assert [np.exp(c.log_power / 2) for c in alone.components] == pytest.approx(sizes)
        assert matrix[i, i] == pytest.approx(whittle.density(data, alone))
    assert np.all(matrix[0, 1] < 0)  # along (1, -r)
    apart = spectrum.exchange(4)
    rows = (whittle.contrast(data.row(i), apart.on(i)) for i in range(2))
    assert whittle.contrast(data, apart) == pytest.approx(sum(rows))


def test_the_likelihood_of_two_axes_is_that_of_the_matrices() -> None:
    data, spectrum = two_axes()
    S = np.moveaxis(whittle.spectral_matrix(data, spectrum), -1, 0)
    seen = np.moveaxis(data.matrix(spectrum.gains), -1, 0)
    trace = np.trace(np.linalg.solve(S, seen), axis1=1, axis2=2)
    value = np.sum(data.count * (np.linalg.slogdet(S)[1] + trace))
    assert whittle.contrast(data, spectrum) == pytest.approx(value, rel=1e-12)


def differences(function, theta: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Return the central differences of a function by each parameter."""
    steps = step * np.eye(theta.size)
    return np.array([(function(theta + h) - function(theta - h)) / (2 * step) for h in steps])


def expected_data(data: LoopPeriodogram, spectrum: SpectrumModel) -> LoopPeriodogram:
    """Return the periodogram that is the model, of a loop without corrections."""
    matrix, zero = whittle.spectral_matrix(data, spectrum), np.zeros_like(data.crossed)
    measured = np.einsum("iif->if", matrix).reshape(zero.shape)
    between = data.between
    if between is not None:
        between = np.zeros_like(between)
        between[0, 0] = matrix[0, 1]
    known = {"measured": measured, "crossed": zero, "corrected": zero, "between": between}
    return dataclasses.replace(data, **known)


@pytest.mark.parametrize(
    "case",
    [partial(one_axis, bump=True), partial(one_axis, drift=True, bump=True), two_axes],
    ids=["one axis", "a drift", "two axes"],
)
def test_gradient_and_information_of_the_likelihood(case) -> None:
    """The row of the one gain is of exact second derivatives; those of two axes are held."""
    data, spectrum = case()
    theta = spectrum.pack()

    def gradient(theta: np.ndarray, data: LoopPeriodogram = data) -> np.ndarray:
        return whittle.derivatives(data, spectrum.unpack(theta))[1]

    value, slope, information = whittle.derivatives(data, spectrum)
    assert value == pytest.approx(whittle.contrast(data, spectrum), rel=1e-12)
    numeric = differences(lambda x: whittle.contrast(data, spectrum.unpack(x)), theta)
    if len(spectrum.axes) == 2:
        numeric[[GAIN, BACKGROUND + GAIN]] = 0
    assert slope == pytest.approx(numeric, rel=1e-4, abs=1e-5 * np.max(np.abs(numeric)))
    if len(spectrum.axes) == 1:
        row = differences(gradient, theta)[GAIN]
        assert information[GAIN] == pytest.approx(row, rel=1e-4, abs=1e-4 * np.max(np.abs(row)))
    # the others are those of the model where the data are the model
    pure = expected_data(data, spectrum)
    _, flat, expected = whittle.derivatives(pure, spectrum)
    assert flat == pytest.approx(0, abs=1e-7)
    rows = differences(partial(gradient, data=pure), theta)
    if len(spectrum.axes) == 2:
        gains = [GAIN, BACKGROUND + GAIN]
        rows[gains] = rows[:, gains] = 0
    assert expected == pytest.approx(rows, abs=1e-5 * np.max(rows))


@pytest.mark.parametrize(("drift", "taper"), [(False, False), (True, True)])
def test_second_derivatives_of_the_likelihood(drift: bool, taper: bool) -> None:
    """At a minimum; the slope of the table that smears lines has corners: differences see them."""
    data, start = one_axis(drift=drift)
    if not taper:
        data = dataclasses.replace(data, duration_s=None)
    search = Search(data=data)
    model = fit(search, start, accuracy=1e-8)
    merged, priors = search.merge(model.spectrum), search.priors(model.spectrum)

    def gradient(theta: np.ndarray) -> np.ndarray:
        return whittle.derivatives(merged, model.spectrum.unpack(theta))[1]

    rows = differences(gradient, model.spectrum.pack(), 1e-4)
    free = np.ix_(priors.free, priors.free)  # but for the damping of a drift
    expected = rows[free] + np.diag(1 / priors.width[priors.free] ** 2)
    information = whittle.observe_information(merged, model, priors).information[free]
    scale = np.sqrt(np.abs(np.diag(information)))
    scales = np.outer(scale, scale)
    accuracy = 2e-2 if taper else 1e-3
    assert information / scales == pytest.approx(expected / scales, abs=accuracy)
    assert information == pytest.approx(information.T, rel=1e-12)


def rosenbrock(x: np.ndarray, above: float = 0.0) -> tuple[float, np.ndarray, np.ndarray]:
    """Half the squared residuals of Rosenbrock's valley, and of Gauss and Newton's matrix."""
    rest = np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
    slope = np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])
    return above + 0.5 * float(rest @ rest), slope.T @ rest, slope.T @ slope


def free(count: int, **bounds: object) -> whittle.Priors:
    return whittle.Priors(centre=np.zeros(count), width=np.full(count, np.inf), **bounds)


@pytest.mark.parametrize(
    ("start", "bounds", "minimum"),
    [
        ([-1.2, 1.0], {}, [1, 1]),
        ([3.0, -20.0], {}, [1, 1]),
        # beyond a bound it lies on it, and what else is free goes on: y = x^2 in the valley
        ([-1.2, 1.0], {"bounds": (-9.0, np.array([0.5, 9.0]))}, [0.5, 0.25]),
    ],
)
def test_a_curved_valley_is_followed_to_its_end(start, bounds, minimum) -> None:
    found = whittle.scoring_minimum(rosenbrock, np.array(start), free(2, **bounds), accuracy=1e-15)
    assert found is not None
    assert found[0] == pytest.approx(minimum, abs=1e-6)


@pytest.mark.parametrize(("bound", "hopeless"), [(6.9, True), (9.0, False)])
def test_a_fit_without_hope_is_given_up(bound: float, hopeless: bool) -> None:
    valley, start = partial(rosenbrock, above=7.0), np.array([-1.2, 1.0])
    found = whittle.scoring_minimum(valley, start, free(2), bound=bound)
    assert (found is None) is hopeless


def test_parameters_without_information_leave_the_steps_finite() -> None:
    # a component of no power has denormal information, and a step along it overflows
    scale = np.array([2.0, 1e-311, 1e-300, 1e-16])

    def bowl(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        value = 0.5 * float(scale @ (x - 1) ** 2) - 1e-9 * float(np.sum(x))
        return value, scale * (x - 1) - 1e-9, np.diag(scale)

    found = whittle.scoring_minimum(bowl, np.array([5.0, 4.0, 3.0, 2.0]), free(4))
    assert found is not None
    assert np.all(np.isfinite(found[0]))
    assert found[0][0] == pytest.approx(1, abs=1e-3)
