"""The likelihood: how the taper smears lines, gradient and information, of one axis and of two."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import simpson
from scipy.optimize import approx_fprime
from scipy.signal import fftconvolve
from support.recorded_loops import RATE, integrator_loop, open_record

import lbt_synth as lbt
from lbt_synth.identification.fit.fitting import Search, fit
from lbt_synth.identification.fit.periodogram import TAPER, LoopPeriodogram, loop_periodogram
from lbt_synth.identification.fit.spectrum_model import (
    BACKGROUND,
    GAIN,
    Background,
    Component,
    SpectrumModel,
)
from lbt_synth.identification.fit.whittle import (
    SKIRT,
    Priors,
    contrast,
    density,
    derivatives,
    log_smearing,
    observe_information,
    scoring_minimum,
    spectral_matrix,
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
    log_ratio = log_smearing(width, np.array([distance]))[0][0]
    assert log_ratio == pytest.approx(np.log(smeared / line), abs=1e-4)


@given(width=st.floats(1e-3, 25), distance=st.floats(0.02, SKIRT))
@settings(max_examples=10, deadline=None)
def test_derivatives_of_the_smearing(width: float, distance: float) -> None:
    d, h = np.array([-distance, distance]), 1e-6
    _, by_width, by_distance = log_smearing(width, d)
    numeric = log_smearing(width * np.exp(h), d)[0] - log_smearing(width * np.exp(-h), d)[0]
    assert by_width == pytest.approx(numeric / (2 * h), abs=1e-4)
    numeric = log_smearing(width, d + h)[0] - log_smearing(width, d - h)[0]
    assert by_distance == pytest.approx(numeric / (2 * h), rel=1e-4, abs=1e-4)
    assert by_distance[0] == pytest.approx(-by_distance[1])


def test_periodogram_of_a_sinusoid_is_the_taper() -> None:
    n, rate, rms, width, frequency = 48_000, 800.0, 100.0, 1e-8, 123.4567
    y = rms * np.sqrt(2) * np.cos(2 * np.pi * frequency * np.arange(n) / rate + 0.3)
    data = loop_periodogram(y, None, frame_rate_hz=rate, stretches=[(0, n)])
    d = (data.frequency_hz - frequency) * data.duration_s
    for low, high in ((0, 1.5), (1.5, 4), (4, 10), (10, 20), (20, 40)):
        inside = (np.abs(d) >= low) & (np.abs(d) < high)
        line = width / np.pi / (width**2 + d[inside] ** 2)
        model = line * np.exp(log_smearing(width, d[inside])[0]) * rms**2 * data.duration_s
        assert np.mean(data.power(1.0)[inside]) == pytest.approx(np.mean(model), rel=0.06)


def test_skirts_are_those_of_the_line_beyond_the_reach() -> None:
    for width in (0.02, 0.3, 2.0, 12.0):
        log_ratio = log_smearing(width, SKIRT + np.arange(8))[0]
        assert np.mean(log_ratio) == pytest.approx(0, abs=0.02)


def component(kind: str, hertz: float, log_odds: float, rms: float, **changes: object) -> Component:
    logs = (float(np.log(hertz * W)), log_odds, 2 * float(np.log(rms)))
    return dataclasses.replace(Component(kind, *logs), **changes)


def line(frequency: float, ratio: float, rms: float, **changes: object) -> Component:
    return component("line", frequency, float(np.log(ratio / (1 - ratio))), rms, **changes)


def case(*, drift: bool = False, bump: bool = False) -> tuple[LoopPeriodogram, SpectrumModel]:
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


def differences(function, theta: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Return the central differences of a function by each parameter."""
    steps = step * np.eye(theta.size)
    return np.array([(function(theta + h) - function(theta - h)) / (2 * step) for h in steps])


@pytest.mark.parametrize("drift", [False, True])
def test_gradient_and_information_of_the_likelihood(drift: bool) -> None:
    data, spectrum = case(drift=drift, bump=True)
    theta = spectrum.pack()

    def gradient(theta: np.ndarray, data: LoopPeriodogram = data) -> np.ndarray:
        return derivatives(data, spectrum.unpack(theta))[1]

    value, slope, information = derivatives(data, spectrum)
    assert value == pytest.approx(contrast(data, spectrum), rel=1e-12)
    numeric = approx_fprime(theta, lambda x: contrast(data, spectrum.unpack(x)), 1e-6)
    assert slope == pytest.approx(numeric, rel=2e-3, abs=1e-3 * np.max(np.abs(numeric)))
    # the rows of the gain are exact second derivatives
    row = differences(gradient, theta)[GAIN]
    assert information[GAIN] == pytest.approx(row, rel=1e-4, abs=1e-4 * np.max(np.abs(row)))
    # the others are those of the model where the data are the model
    zero = np.zeros_like(data.crossed)
    known = {"measured": density(data, spectrum), "crossed": zero, "corrected": zero}
    pure = dataclasses.replace(data, **known)
    _, flat, expected = derivatives(pure, spectrum)
    assert flat == pytest.approx(0, abs=1e-8)
    rows = differences(lambda x: gradient(x, pure), theta)[1:, 1:]
    assert expected[1:, 1:] == pytest.approx(rows, rel=1e-3, abs=1e-3 * np.max(rows))


@pytest.mark.parametrize(("drift", "taper"), [(False, False), (True, True)])
def test_second_derivatives_of_the_likelihood(drift: bool, taper: bool) -> None:
    """At a minimum; the slope of the table that smears lines has corners: differences see them."""
    data, start = case(drift=drift)
    if not taper:
        data = dataclasses.replace(data, duration_s=None)
    search = Search(data=data)
    model = fit(search, start, accuracy=1e-8)
    merged, priors = search.merge(model.spectrum), search.priors(model.spectrum)

    def gradient(theta: np.ndarray) -> np.ndarray:
        return derivatives(merged, model.spectrum.unpack(theta))[1]

    rows = differences(gradient, model.spectrum.pack(), 1e-4)
    free = np.ix_(priors.free, priors.free)  # but for the damping of a drift
    expected = rows[free] + np.diag(1 / priors.width[priors.free] ** 2)
    information = observe_information(merged, model, priors).information[free]
    scale = np.sqrt(np.abs(np.diag(information)))
    scales = np.outer(scale, scale)
    accuracy = 2e-2 if taper else 1e-3
    assert information / scales == pytest.approx(expected / scales, abs=accuracy)
    assert information == pytest.approx(information.T, rel=1e-12)


@pytest.fixture(scope="module")
def both() -> LoopPeriodogram:
    """Return the periodogram of two axes in a loop."""
    record = open_record(((LINE, 0),), frames=4096)
    y = record.measurements
    corrections = np.random.default_rng(5).standard_normal(y.shape) + 0.1 * y[:, ::-1]
    return loop_periodogram(y, corrections, frame_rate_hz=RATE, stretches=[(0, record.frames)])


@pytest.fixture
def coupled() -> SpectrumModel:
    """Return two axes with a line, a drift and turbulence of their own, and one line along both."""
    backgrounds = tuple(
        Background(np.log(gain), np.log(40), colour, np.log(30 * W))
        for gain, colour in ((0.7, 0.1), (1.3, 0.0))
    )
    slow = component("turbulence", 1.1, np.log(0.5), 280.0)
    drift = component("drift", 20, np.log(300.0), 50.0, axis=1)
    shared = line(41, 0.02, 35, axis=None, log_ratio=2 * np.log(25 / 35), sign=-1.0)
    components = (slow, line(70, 0.05, 20), dataclasses.replace(slow, axis=1), drift, shared)
    return SpectrumModel(backgrounds, components)


def test_the_likelihood_of_two_axes_is_that_of_the_matrices(both, coupled) -> None:
    S = np.moveaxis(spectral_matrix(both, coupled), -1, 0)
    data = np.moveaxis(both.matrix(coupled.gains), -1, 0)
    trace = np.trace(np.linalg.solve(S, data), axis1=1, axis2=2)
    value = np.sum(both.count * (np.linalg.slogdet(S)[1] + trace))
    assert contrast(both, coupled) == pytest.approx(value, rel=1e-12)
    assert derivatives(both, coupled)[0] == pytest.approx(value, rel=1e-12)


def test_axes_without_shared_resonances_are_separate(both, coupled) -> None:
    apart = coupled.exchange(coupled.shared[0])
    rows = (contrast(both.row(i), apart.on(i)) for i in range(2))
    assert contrast(both, apart) == pytest.approx(sum(rows))
    matrix = spectral_matrix(both, coupled)
    for i in range(2):
        assert matrix[i, i] == pytest.approx(density(both, coupled.on(i)))
    assert np.all(matrix[0, 1] < 0)  # along (1, -r)


def test_slopes_of_two_axes_are_those_of_differences(both, coupled) -> None:
    numeric = differences(lambda x: contrast(both, coupled.unpack(x)), coupled.pack())
    numeric[[GAIN, BACKGROUND + GAIN]] = 0  # the gains of two axes are held
    slope = derivatives(both, coupled)[1]
    assert slope == pytest.approx(numeric, rel=1e-4, abs=1e-5 * np.max(np.abs(numeric)))


def test_information_is_the_second_derivative_where_the_data_are_the_model(both, coupled) -> None:
    matrix, theta = spectral_matrix(both, coupled), coupled.pack()
    zero, between = np.zeros_like(both.measured), np.zeros_like(both.between)
    between[0, 0] = matrix[0, 1]
    measured = np.array([matrix[0, 0], matrix[1, 1]])
    known = {"measured": measured, "crossed": zero, "corrected": zero, "between": between}
    pure = dataclasses.replace(both, **known)
    _, slope, information = derivatives(pure, coupled)
    assert slope == pytest.approx(0, abs=1e-7)
    exact = differences(lambda x: derivatives(pure, coupled.unpack(x))[1], theta)
    gains = [GAIN, BACKGROUND + GAIN]
    exact[gains] = exact[:, gains] = 0  # they are held
    assert information == pytest.approx(exact, abs=1e-5 * np.max(exact))


def test_a_component_that_would_leave_the_band_stays_at_its_end(both, coupled) -> None:
    """Noise that falls towards the Nyquist frequency draws a wide component beyond it."""
    wide = Component("line", np.log(3.1), 0.0, 2 * np.log(20.0))
    model = fit(Search(data=both, gain=1.0), coupled.exchange(1, wide))
    assert model.spectrum.components[1].frequency < np.pi


def rosenbrock(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Half the squared residuals of Rosenbrock's valley, and of Gauss and Newton's matrix."""
    rest = np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
    slope = np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])
    return 0.5 * float(rest @ rest), slope.T @ rest, slope.T @ slope


def free(count: int) -> Priors:
    return Priors(centre=np.zeros(count), width=np.full(count, np.inf))


def test_a_curved_valley_is_followed_to_its_end_and_a_fit_without_hope_is_given_up() -> None:
    for start in ([-1.2, 1.0], [3.0, -20.0]):
        found = scoring_minimum(rosenbrock, np.array(start), free(2), accuracy=1e-12)
        assert found is not None
        assert found[0] == pytest.approx([1, 1], abs=1e-4)

    def above(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        value, slope, matrix = rosenbrock(x)
        return value + 7.0, slope, matrix

    start = np.array([-1.2, 1.0])
    assert scoring_minimum(above, start, free(2), bound=6.9) is None
    assert scoring_minimum(above, start, free(2), bound=9.0) is not None


def test_parameters_without_information_leave_the_steps_finite() -> None:
    # a component of no power has denormal information, and a step along it overflows
    scale = np.array([2.0, 1e-311, 1e-300, 1e-16])

    def bowl(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        value = 0.5 * float(scale @ (x - 1) ** 2) - 1e-9 * float(np.sum(x))
        return value, scale * (x - 1) - 1e-9, np.diag(scale)

    found = scoring_minimum(bowl, np.array([5.0, 4.0, 3.0, 2.0]), free(4))
    assert found is not None
    assert np.all(np.isfinite(found[0]))
    assert found[0][0] == pytest.approx(1, abs=1e-3)


def test_a_minimum_beyond_a_bound_lies_on_it() -> None:
    """What else is free goes on: the valley's floor at x = 0.5 is y = 0.25."""
    priors = dataclasses.replace(free(2), bounds=(-9.0, np.array([0.5, 9.0])))
    found = scoring_minimum(rosenbrock, np.array([-1.2, 1.0]), priors, accuracy=1e-12)
    assert found is not None
    assert found[0] == pytest.approx([0.5, 0.25], abs=1e-6)
