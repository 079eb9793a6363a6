"""The least residual against closed forms, Riccati equations and every stable design."""

import mpmath
import numpy as np
import pytest
from scipy.linalg import toeplitz
from support.limits import RATE, Anonymous, ar, path, variance
from support.lqg import shell
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.design.result import model_limits
from lbt_synth.errors import CoupledModesError, DimensionError, ProblemError
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.loop.least_residual import least_residual


def test_processes_whose_variance_is_known():
    for delay, a in ((1, 0.5), (2, -0.9), (6, 0.999), (20, 0.5)):
        expected = 4 * sum(a ** (2 * k) for k in range(delay))
        left = variance(path(delay), turbulence=ar(a, driving=2.0), noise_nm=1e-6)
        assert left == pytest.approx(expected, rel=1e-9)
    for delay in (1, 2.4, 5):  # what is white cannot be corrected
        white = ar(0.0, driving=3.0)
        assert variance(path(delay), turbulence=white, noise_nm=2) == pytest.approx(9)
    table = lbt.models.TabulatedSpectrum(frequency_hz=[1, 50], density_nm2_hz=[3, 3])
    assert variance(path(), turbulence=table, noise_nm=1.0) > 0.1
    assert variance(path(), turbulence=None, noise_nm=5.0) == 0.0


@pytest.mark.parametrize(
    ("facts", "noise_nm", "sensor_gain", "expected_nm"),
    [
        ({}, 0.12, 0.3, [0.4]),  # a sensor gain is a scale of the noise, known or believed
        ({"sensor_matrix": [[0.3]]}, 0.12, 1.0, [0.4]),
        ({}, 0.8, 2.0, [0.4]),
        ({"sensor_matrix": [[2.0]]}, 0.8, 1.0, [0.4]),
        ({"sensor_matrix": [[1.0], [1.0]]}, 2.0, 1.0, [np.sqrt(2)]),  # two sensors halve it
        ({"modes": 2, "sensor_matrix": [[2.0, 1.0], [1.0, 2.0]]}, 3.0, 1.0, [3.0, 1.0]),  # undone
    ],
)
def test_sensors_that_tell_the_same_have_the_same_limit(facts, noise_nm, sensor_gain, expected_nm):
    model = {"turbulence": ar(1.5, -0.8)}
    limit = variance(path(**facts), **model, noise_nm=noise_nm, sensor_gain=sensor_gain)
    expected = sum(variance(path(), **model, noise_nm=alone) for alone in expected_nm)
    assert limit == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("noise", "delay"), [(1e-6, 1), (1e-3, 2), (1.0, 4), (1e6, 2)])
def test_ar1_with_noise_to_the_last_digits(noise, delay):
    """The scalar Riccati equation solved in 60 digits; the limit may be far below the noise."""
    a = 0.99
    with mpmath.workdps(60):
        aa, q, r = mpmath.mpf(a), mpmath.mpf(1), mpmath.mpf(noise) ** 2
        b = r * (1 - aa**2) - q  # p^2 + b p - q r = 0, p the error of one step ahead
        p = (-b + mpmath.sqrt(b**2 + 4 * q * r)) / 2
        for _ in range(delay - 1):
            p = aa**2 * p + q
        expected = float(p)
    found = variance(path(delay), turbulence=ar(a), noise_nm=noise)
    assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("delay", "noise"), [(1.3, 0.4), (2.45, 0.4), (6.1, 0.4)])
def test_fractions_against_the_best_filter_of_many_taps(delay, noise):
    """Normal equations of 300 taps behind the path ``z^-d ((1 - part) + part z^-1)``."""
    model, n, taps = ar(1.5, -0.8), 4096, 300
    theta = 2 * np.pi * np.arange(n) / n
    S = model.psd(np.minimum(theta, 2 * np.pi - theta) / np.pi * RATE / 2) * RATE / 2
    part, back = delay % 1, np.exp(-1j * theta)
    late = back ** int(delay) * ((1 - part) + part * back)
    gram = toeplitz(np.fft.fft(np.abs(late) ** 2 * (S + noise**2)).real[:taps] / n)
    crossed = np.fft.ifft(late.conj() * S).real[:taps]
    expected = S.mean() - crossed @ np.linalg.solve(gram, crossed)
    found = variance(path(delay), turbulence=model, noise_nm=noise)
    assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("delay", "seed"), [(1, 0), (2, 1), (3, 2), (3, 5)])
def test_kalman_filters_reach_the_limit(delay, seed):
    rng = np.random.default_rng(seed)
    roots = rng.uniform(0.1, 0.999, 3) * np.exp(1j * rng.uniform(0, np.pi, 3))
    a = -np.poly(np.concatenate([roots, roots.conj()])).real[1:]
    numbers = zip(rng.uniform(5, 390, 2), rng.uniform(-5, -1, 2), rng.uniform(0, 3, 2), strict=True)
    lines = [
        lbt.Vibration(frequency_hz=f, damping=10**k, rms_nm=10**size, direction=(1,))
        for f, k, size in numbers
    ]
    facts = {"frame_rate_hz": RATE, "delay_frames": delay, "vibrations": lines, "modes": 1}
    air, noise_nm = ar(*a, driving=10 ** rng.uniform(-1, 2)), 10 ** rng.uniform(-2, 2)
    plant = lbt.tip_tilt_plant(**facts, turbulence=air, noise_nm=noise_nm)
    limit, design = least_residual(plant.hardware, plant), lbt.kalman(plant)
    means = np.sum(limit.variance_nm2 - limit.within_nm2)
    assert design.rms**2 == pytest.approx(means, rel=2e-8, abs=1e-12 * limit.rms_nm**2)
    left = lbt.residual_budget(lbt.close_loop(plant.hardware, design.controller), plant)
    assert left.rms_nm == pytest.approx(limit.rms_nm, rel=1e-8)


def moving_power(spectra, frame_rate_hz, *, of_means):
    """Return what moves within the frames of phases with such spectra, by a sum."""
    f = np.linspace(0, frame_rate_hz / 2, 400_001)[1:]
    share = np.sinc(f / frame_rate_hz) ** 2
    density = sum(spectrum.psd(f) for spectrum in spectra)
    return np.sum(density * (1 / share - 1 if of_means else 1 - share)) * (f[1] - f[0])


def test_limit_of_the_example(config, lbt_designs):
    hardware, (line, *_), design = config.hardware, config.truth.vibrations, lbt_designs["kalman"]
    means = least_residual(hardware, config.truth, frame_means=True).rms_nm
    assert means == pytest.approx(10.8414, abs=1e-4)
    limit = least_residual(hardware, config.truth)
    floor = line.rms_nm**2 * (1 - np.sinc(line.frequency_hz / RATE) ** 2)
    air = moving_power([config.truth.turbulence] * hardware.modes, RATE, of_means=False)
    assert limit.within_nm2.sum() == pytest.approx(floor + air, rel=1e-4)
    assert limit.rms_nm**2 == pytest.approx(means**2 + floor + air, rel=3e-2)
    residual_nm, limit_nm, above = model_limits(design).values()
    models = [line.ar_model(RATE) for line in config.plant.vibrations]
    power = moving_power([*config.plant.turbulence, *models], RATE, of_means=True)
    assert design.rms == pytest.approx(192.619, abs=1e-3)
    assert residual_nm**2 == pytest.approx(design.rms**2 + power, rel=1e-6)
    assert limit_nm == pytest.approx(residual_nm, rel=1e-9)
    assert abs(above) < 1e-6


def test_a_sinusoid_of_known_frequency_costs_what_moves_within_a_frame():
    line = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=797, direction=(1,))
    calm, floor = {"turbulence": ar(0.99), "noise_nm": 3.0}, 797**2 * (1 - np.sinc(20 / RATE) ** 2)
    still = variance(path(), **calm)
    assert variance(path(), **calm, vibrations=(line,)) == still
    for delay in (1, 1.5, 2, 2.49, 3):
        bare, shaken = (
            variance(path(delay), **calm, vibrations=lines, frame_means=False)
            for lines in ((), (line,))
        )
        assert shaken - bare == pytest.approx(floor, rel=1e-9)
    narrow = [
        lbt.Vibration(frequency_hz=20, damping=damping, rms_nm=797, direction=(1,))
        for damping in (1e-2, 1e-6, 1e-10)
    ]
    limits = [variance(path(), **calm, vibrations=(line,)) for line in narrow]
    assert limits[0] > limits[1] > limits[2] > still
    assert limits[2] == pytest.approx(still, rel=1e-2)


def coupled_plant(ratio=2.0, **options):
    """A line along a diagonal over turbulence of another size on either axis."""
    slow = [ar(1.98, -0.9805, driving=driving) for driving in (1.0, ratio)]
    line = lbt.Vibration(frequency_hz=30, damping=0.01, rms_nm=50, direction=(1, 1))
    facts = {"turbulence": slow, "vibrations": [line], "noise_nm": 10.0}
    return lbt.tip_tilt_plant(frame_rate_hz=RATE, **facts, **options)


@pytest.mark.parametrize("delay", [1.0, 3.0])
def test_coupled_modes_have_the_limit_of_the_best_filter(delay):
    plant, *others = (coupled_plant(ratio, delay_frames=delay) for ratio in (2.0, 1, 1.001))
    limit = least_residual(plant.hardware, plant)
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant).controller)
    along = limit.directions.T * limit.variance_nm2 @ limit.directions
    assert along == pytest.approx(lbt.residual_budget(loop, plant).total_nm2, rel=1e-7)
    # a little coupling changes little
    alone, nearly = (least_residual(other.hardware, other).rms_nm for other in others)
    assert alone < nearly == pytest.approx(alone, rel=1e-3)


@pytest.mark.parametrize(
    ("delay", "noise", "model"),
    [(1.5, 10.0, ar(0.9)), (2.01, 0.2, ar(1.5, -0.8)), (2.75, 0.2, ar(1.7, -0.75))],
)
def test_the_mean_over_a_hold_against_a_filter_of_many_samples(delay, noise, model):
    """Normal equations of the mean over a hold, on the means over 200 past frames with noise.

    The phase has ``1 / sinc^2`` of the density of the means, and nothing above half the rate. Of
    what lies between two samples the limit knows what 32 of them tell: three digits.
    """
    f, weight = gauss_panels(np.linspace(0, 0.5, 61), 12)  # cycles per frame
    density = model.psd(f * RATE) * RATE * weight

    def covariance(lags):
        return np.cos(2 * np.pi * f * np.asarray(lags)[..., None]) @ density

    gram = toeplitz(covariance(np.arange(200))) + noise**2 * np.eye(200)
    # the newest reading at u(k) is of exposure k - 1; the hold begins delay - 1 after exposure k
    crossed = covariance(delay + np.arange(200))
    means = covariance(0.0) - crossed @ np.linalg.solve(gram, crossed)
    within = np.sum(density * (1 / np.sinc(f) ** 2 - 1))
    found = variance(path(delay), turbulence=model, noise_nm=noise, frame_means=False)
    assert found == pytest.approx(means + within, rel=1e-3)


CALM = {"turbulence": ar(0.9), "noise_nm": 1.0}
SLANTED, UPRIGHT = (
    lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=5, direction=d) for d in ((1, 1), (1, 0))
)
OTHER_RATE = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=1, frame_rate_hz=500)
SECOND = lbt.models.WavefrontSensor(name="second", rate_hz=RATE, delay_frames=2, noise_nm=3.0)


def test_refusals():
    late, strong = coupled_plant(delay_frames=2.4), ar(0.9, driving=1e10)
    beside = path(suite=lbt.models.SensorSuite(sensors=(SECOND,)))

    def least(*lines, on=None, **changes):
        return lambda: variance(on or path(), **(CALM | changes), vibrations=lines)

    def on(**facts):
        return least(SLANTED, on=path(**facts))

    rank = "see every mode; got a matrix of rank 1 for 2"
    rows = [
        (on(sensor_matrix=[[1.0, 1.0]]), ProblemError, rank),
        (on(influence_matrix=[[1.0], [1.0]]), ProblemError, "reach every mode"),
        (on(sensor_matrix=np.diag([1.0, 2.0])), ProblemError, "principal axes of the"),
        (least(SLANTED, UPRIGHT, on=path(modes=2)), ProblemError, "that decouple.*Turn the dir"),
        (least(UPRIGHT), DimensionError, "must have 1 components"),
        (least(turbulence=OTHER_RATE), ProblemError, "the loop's 800 Hz; got 500"),
        (least(turbulence=strong, noise_nm=1e-155), ProblemError, "a size that sensors have"),
        (lambda: least_residual(late.hardware, late), CoupledModesError, "modes that decouple"),
        (least(on=beside), ProblemError, "loop's own sensor; got others"),
        (least(on=path(mirror=shell(100))), ProblemError, "got dynamics"),
        (least(on=path(2.6)), ProblemError, "at most a half beyond whole frames"),
    ]
    wrong = (lambda f: -np.ones(f.shape), lambda f: f * np.nan, lambda f: np.ones(3))
    words = "Anonymous.psd does not"
    rows += [(least(turbulence=Anonymous(psd)), ProblemError, words) for psd in wrong]
    require_refusals(rows)
