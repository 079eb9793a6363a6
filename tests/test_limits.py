"""Limits of performance: against closed forms, Riccati equations, and every stable design."""

from __future__ import annotations

import json
from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.plants import LBT_YAML, lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.cli.main import main
from lbt_synth.linear.quadrature import refine_panels
from lbt_synth.loop.least_residuals import band_limit as band_module
from lbt_synth.loop.least_residuals.prediction import InnerFactor
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual
from lbt_synth.studies.limits import model_limit

RATE = 800.0
CONFIG = str(LBT_YAML)


class Anonymous:
    """A spectrum that hides what it is."""

    def __init__(self, psd):
        self.psd = psd


def path(delay=2.0, modes=1, **extra):
    return lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=modes, **extra)


def ar(*coefficients, driving=1.0):
    return lbt.models.ARModel(
        coefficients=list(coefficients), driving_rms_nm=driving, frame_rate_hz=RATE
    )


def variance(hardware, **truth):
    return float(lbt.loop.least_residual(hardware, lbt.Truth(**truth)).variance_nm2.sum())


def budget(design, truth, hardware=None):
    hardware = design.hardware if hardware is None else hardware
    loop = lbt.close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
    return lbt.residual_budget(loop, truth)


# -------------------------------------------------------------------- closed forms
@pytest.mark.parametrize("delay", [1, 2, 3, 6, 20])
@pytest.mark.parametrize("a", [-0.9, 0.0, 0.5, 0.999])
def test_ar1_without_noise(delay, a):
    expected = 4 * sum(a ** (2 * k) for k in range(delay))
    assert variance(path(delay), turbulence=ar(a, driving=2.0)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("noise", [1e-6, 1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("delay", [1, 2, 4])
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


def test_golden_ratio_of_the_random_walk():
    """Equal steps and noise: an error of one step ahead of the golden ratio."""
    found = variance(path(1), turbulence=ar(1 - 1e-9), noise_nm=1.0)
    assert found == pytest.approx((1 + np.sqrt(5)) / 2, rel=1e-8)


@pytest.mark.parametrize("delay", [1, 2.7, 5])
def test_white_disturbance_cannot_be_corrected(delay):
    assert variance(path(delay), turbulence=ar(0.0, driving=3.0), noise_nm=2) == pytest.approx(9)


def test_nothing_to_correct():
    assert variance(path(), turbulence=None, noise_nm=5.0) == 0.0


def test_a_band_limited_process_without_noise_is_known_for_ever():
    table = lbt.models.TabulatedSpectrum(frequency_hz=[1, 50], density_nm2_hz=[3, 3])
    assert variance(path(), turbulence=table) == 0.0
    assert variance(path(), turbulence=table, noise_nm=1.0) > 0.1


def test_a_noisy_ideal_low_pass_process():
    """Phi is 1 + r below half of Nyquist and r above: all cosine integrals are known."""
    r, edge = 0.3, 200.0
    psd = Anonymous(lambda f: np.where(f < edge, 1 / 400.0, 0.0))
    psd.breakpoints_hz = np.array([edge])
    lift = np.log1p(1 / r)
    sigma2 = r * np.exp(lift / 2)
    f1 = lift * np.sin(np.pi / 2) / np.pi
    found = variance(path(2), turbulence=psd, noise_nm=np.sqrt(r))
    assert found == pytest.approx(sigma2 * (1 + f1**2) - r, rel=1e-9)


@pytest.mark.parametrize("delay", [1.7, 2.51, 2.7, 3.9, 2.999, 6.6])
@pytest.mark.parametrize("noise", [0.0, 0.4])
def test_fractions_against_the_wiener_filter_on_a_grid(delay, noise):
    """``E = int S - |[conj(Theta) S / conj(F)]_+|^2`` by FFT, the all-pass factor kept whole."""
    model = ar(1.5, -0.8)
    n = 4096
    theta = 2 * np.pi * np.arange(n) / n
    f = np.where(theta <= np.pi, theta, 2 * np.pi - theta) / np.pi * RATE / 2
    S = model.psd(f) * RATE / 2
    cepstrum = np.fft.ifft(np.log(S + noise**2)).real
    fold = np.zeros(n)
    fold[0], fold[1 : n // 2] = cepstrum[0] / 2, cepstrum[1 : n // 2]
    fold[n // 2] = cepstrum[n // 2] / 2
    F = np.exp(np.fft.fft(fold))  # in powers of z^-1 = exp(-j theta)
    whole = int(np.floor(delay))
    part = delay - whole
    back = np.exp(-1j * theta)
    inner = back**whole * ((1 - part) + part * back) / (part + (1 - part) * back)
    g = np.fft.ifft(inner.conj() * S / F.conj())  # k-th coefficient of z^-k at place k
    expected = S.mean() - np.sum(np.abs(g[: n // 2]) ** 2)
    assert variance(path(delay), turbulence=model, noise_nm=noise) == pytest.approx(
        expected, rel=1e-6
    )


def test_fractions_meet_the_whole_delays():
    model = {"turbulence": ar(1.5, -0.8), "noise_nm": 0.4}
    whole = [variance(path(d), **model) for d in (2, 3)]
    for delay in (2.1, 2.5):
        assert variance(path(delay), **model) == pytest.approx(whole[0], rel=1e-12)
    assert variance(path(2.5 + 1e-9), **model) == pytest.approx(whole[0], rel=1e-7)
    assert variance(path(3 - 1e-9), **model) == pytest.approx(whole[1], rel=1e-7)
    rising = [variance(path(d), **model) for d in np.linspace(2.5, 3, 21)]
    assert np.all(np.diff(rising) > 0)


@pytest.mark.parametrize("delay", [2.75, 6.8])
def test_both_ways_to_the_value_at_the_zero(delay, monkeypatch):
    from lbt_synth.loop.least_residuals import prediction

    truth = {"turbulence": ar(1.5, -0.8), "noise_nm": 0.4}
    values = []
    for few in (1e-300, 1.0):
        monkeypatch.setattr(prediction, "_FEW_DIGITS", few)
        assert InnerFactor.of(path(delay)).by_series is (few == 1.0)
        values.append(variance(path(delay), **truth))
    assert values[0] == pytest.approx(values[1], rel=1e-8)


# ------------------------------------------------------------- Riccati and designs
@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize("seed", range(6))
def test_kalman_filters_reach_the_limit(delay, seed):
    rng = np.random.default_rng(seed)
    roots = rng.uniform(0.1, 0.999, 3) * np.exp(1j * rng.uniform(0, np.pi, 3))
    a = -np.poly(np.concatenate([roots, roots.conj()])).real[1:]
    lines = [
        lbt.Vibration(
            frequency_hz=rng.uniform(5, 390),
            damping=10 ** rng.uniform(-5, -1),
            rms_nm=10 ** rng.uniform(0, 3),
            direction=(1,),
        )
        for _ in range(2)
    ]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=ar(*a, driving=10 ** rng.uniform(-1, 2)),
        vibrations=lines,
        noise_nm=10 ** rng.uniform(-2, 2),
        delay_frames=delay,
        modes=1,
    )
    limit = least_model_residual(plant)
    assert lbt.kalman(plant).rms == pytest.approx(limit.rms_nm, rel=1e-8)
    assert limit.change < 1e-6


@pytest.mark.parametrize("delay", [1.3, 2.5, 2.7])
def test_kalman_filters_of_fractional_delays_stay_above(delay):
    plant = lbt_axis_plant(delay_frames=delay)
    design = lbt.kalman(plant)
    truth = lbt.Truth(turbulence=plant.turbulence[0], vibrations=plant.vibrations, noise_nm=15.5)
    limit = lbt.loop.least_residual(plant.hardware, truth).rms_nm
    assert limit < budget(design, truth).rms_nm < 1.08 * limit
    found, above = model_limit(design)
    assert found == pytest.approx(limit)
    assert np.isnan(above)  # its estimation error is not its residual


def test_kalman_of_the_example(config):
    design = lbt.kalman(config.plant)
    limit_nm, above = model_limit(design)
    assert limit_nm == pytest.approx(192.619, abs=1e-3)
    assert abs(above) < 1e-8
    as_truth = lbt.Truth(
        turbulence=config.plant.turbulence[0],
        vibrations=config.plant.vibrations,
        noise_nm=config.noise_nm,
    )
    assert lbt.loop.least_residual(config.hardware, as_truth).rms_nm == pytest.approx(limit_nm)


def test_limit_of_the_example_and_a_filter_that_comes_close(config):
    """A Kalman filter with a long AR model of the true spectrum, against 10.84 nm."""
    limit = lbt.loop.least_residual(config.hardware, config.truth).rms_nm
    assert limit == pytest.approx(10.8414, abs=1e-4)
    still = replace(config.truth, vibrations=())
    f = (np.arange(1 << 17) + 0.5) / (1 << 17) * RATE / 2
    lags = np.arange(17)
    # a little white noise makes the long model smooth
    cosines = np.stack([np.cos(2 * np.pi * f / RATE * lag) for lag in lags])
    covariance = cosines @ (still.turbulence.psd(f) + 0.2**2 / 400) * (RATE / 2 / f.size)
    from scipy.linalg import solve_toeplitz

    a = solve_toeplitz(covariance[:-1], covariance[1:])
    driving = np.sqrt(covariance[0] - a @ covariance[1:])
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=ar(*a, driving=driving), noise_nm=config.noise_nm
    )
    assert limit < budget(lbt.kalman(plant), still).rms_nm < 1.05 * limit


@given(
    gain=st.floats(0.02, 0.9),
    delay=st.sampled_from([1, 1.4, 2, 2.8, 3]),
    noise=st.sampled_from([0.0, 0.01, 1.0, 100.0]),
    seed=st.integers(0, 99),
)
def test_no_design_passes_the_limit(gain, delay, noise, seed):
    rng = np.random.default_rng(seed)
    line = lbt.Vibration(frequency_hz=rng.uniform(2, 380), damping=0.01, rms_nm=5.0, direction=(1,))
    truth = lbt.Truth(
        turbulence=ar(rng.uniform(-0.9, 0.99)),
        vibrations=(line,),
        noise_nm=noise,
        sensor_gain=rng.uniform(0.5, 1.0),
    )
    hardware = path(delay)
    limit = lbt.loop.least_residual(hardware, truth).rms_nm
    by_hand = lbt.integrator(hardware, gain=gain * lbt.design.integrator_gain_limit(delay))
    assert budget(by_hand, truth).rms_nm >= limit * (1 - 1e-9)
    poles = np.diag(rng.uniform(-0.9, 0.9, 3))
    parameter = lbt.Controller(
        A=poles,
        B=rng.standard_normal((3, 1)),
        C=rng.standard_normal((1, 3)),
        D=rng.standard_normal((1, 1)),
        dt_s=1 / RATE,
    )
    loop = lbt.close_loop(
        hardware, lbt.loop.youla_controller(hardware, parameter), sensor_gain=truth.sensor_gain
    )
    assume(loop.is_stable)
    assert lbt.residual_budget(loop, truth).rms_nm >= limit * (1 - 1e-9)


# ------------------------------------------------------------------- invariances
@given(noise=st.floats(0.01, 100), factor=st.floats(1.01, 10), gain=st.floats(0.2, 3))
def test_noise_scale_and_sensor_gain(noise, factor, gain):
    model = {"turbulence": ar(1.5, -0.8)}
    base = variance(path(), **model, noise_nm=noise)
    assert variance(path(), **model, noise_nm=noise * factor) > base
    assert variance(path(3), **model, noise_nm=noise) > base
    scaled = variance(path(), turbulence=ar(1.5, -0.8, driving=factor), noise_nm=noise * factor)
    assert scaled == pytest.approx(factor**2 * base, rel=1e-9)
    weak = variance(path(), **model, noise_nm=noise * gain, sensor_gain=gain)
    assert weak == pytest.approx(base, rel=1e-9)
    believed = variance(path(sensor_matrix=[[gain]]), **model, noise_nm=noise * gain)
    assert believed == pytest.approx(base, rel=1e-9)


@given(angle=st.floats(0, np.pi))
def test_directions_can_be_turned(angle):
    def turned(alpha):
        lines = [
            lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=50, direction=d)
            for f, d in (
                (20, (np.cos(alpha), np.sin(alpha))),
                (31, (-np.cos(alpha), -np.sin(alpha))),
                (47, (-np.sin(alpha), np.cos(alpha))),
            )
        ]
        truth = lbt.Truth(turbulence=ar(0.99), vibrations=lines, noise_nm=2.0)
        return lbt.loop.least_residual(path(modes=2), truth)

    limit = turned(angle)
    assert np.sort(limit.variance_nm2) == pytest.approx(np.sort(turned(0.0).variance_nm2))
    assert np.allclose(limit.directions @ limit.directions.T, np.eye(2))


def test_more_measurements_than_modes():
    """Two equal sensors of one mode halve the noise; a mixed sensor can be undone."""
    model = {"turbulence": ar(0.99)}
    double = path(sensor_matrix=[[1.0], [1.0]])
    assert variance(double, **model, noise_nm=2.0) == pytest.approx(
        variance(path(), **model, noise_nm=np.sqrt(2))
    )
    mixed = path(modes=2, sensor_matrix=[[2.0, 1.0], [1.0, 2.0]])  # noise of 1 and 1/3
    assert variance(mixed, **model, noise_nm=3.0) == pytest.approx(
        variance(path(), **model, noise_nm=3.0) + variance(path(), **model, noise_nm=1.0)
    )


def test_a_sinusoid_of_known_frequency_costs_nothing():
    line = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=797, direction=(1,))
    with_line = variance(path(), turbulence=ar(0.99), noise_nm=3.0, vibrations=(line,))
    assert with_line == variance(path(), turbulence=ar(0.99), noise_nm=3.0)
    narrow = [
        variance(
            path(),
            turbulence=ar(0.99),
            noise_nm=3.0,
            vibrations=(lbt.Vibration(frequency_hz=20, damping=k, rms_nm=797, direction=(1,)),),
        )
        for k in (1e-2, 1e-6, 1e-10)
    ]
    assert narrow[0] > narrow[1] > narrow[2] > with_line
    assert narrow[2] == pytest.approx(with_line, rel=1e-2)


def test_kolmogorov_turbulence(air):
    endless = replace(air, outer_scale_m=None)
    hardware = path(modes=2)
    one, other = (
        lbt.loop.least_residual(hardware, lbt.Truth(turbulence=a, noise_nm=15.5)).rms_nm
        for a in (air, endless)
    )
    assert one < other < 1.2 * one


# -------------------------------------------------------------------------- band
def test_band_of_the_example(config):
    line = config.truth.vibrations[0]
    limit = lbt.loop.least_worst_residual(
        config.hardware, config.truth, band_hz=(16.5, 23.5), rms_nm=line.rms_nm
    )
    assert limit.rms_nm == pytest.approx(15.1088, abs=1e-4)
    assert limit.rms_nm <= limit.achieved_nm < limit.rms_nm * (1 + 1e-8)
    assert limit.weight.sum() == pytest.approx(1)
    assert limit.weight.min() >= 0
    assert 16.5 < limit.frequency_hz.min() < limit.frequency_hz.max() < 23.5


def test_the_density_found_is_the_hardest(config):
    """Its Wiener limit, as a table of its own, is the band limit; the flat one is below."""
    hardware, still = config.hardware, replace(config.truth, vibrations=())
    limit = lbt.loop.least_worst_residual(hardware, still, band_hz=(10.0, 40.0), rms_nm=5.0)
    edges = np.linspace(10, 40, 61)
    share = np.histogram(limit.frequency_hz, edges, weights=limit.weight)[0]
    assert not np.allclose(share, 1 / 60, rtol=0.01)

    def of_density(power):
        def psd(f):
            place = np.clip(np.searchsorted(edges, f, side="right") - 1, 0, 59)
            inside = (f > 10) & (f < 40)
            return still.turbulence.psd(f) + np.where(inside, power[place] * 5**2 / 0.5, 0)

        spectrum = Anonymous(psd)
        spectrum.breakpoints_hz = edges
        one = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
        own = lbt.loop.least_residual(one, replace(still, turbulence=spectrum)).variance_nm2[0]
        return np.sqrt(own + limit.variance_nm2[1])

    hardest, flat = of_density(share), of_density(np.full(60, 1 / 60))
    assert flat < hardest < limit.rms_nm * (1 + 1e-9)
    assert hardest == pytest.approx(limit.rms_nm, rel=1e-3)


@pytest.mark.parametrize("delay", [1, 2, 2.7, 3])
def test_designs_stay_above_the_band_limit(delay):
    plant = lbt_axis_plant(delay_frames=delay, damping=0.05)
    still = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    limit = lbt.loop.least_worst_residual(
        plant.hardware, still, band_hz=(17, 23), rms_nm=500, direction=(1,)
    )
    assert limit.achieved_nm < limit.rms_nm * (1 + 1e-7)
    for design in (lbt.kalman(plant), lbt.hinf(plant, gamma_ratio=1.1, route="riccati")):
        worst = max(
            budget(
                design,
                replace(
                    still,
                    vibrations=(
                        lbt.models.SinusoidalVibration(frequency_hz=f, rms_nm=500, direction=(1,)),
                    ),
                ),
            ).rms_nm
            for f in (17, 18.5, 20, 21.5, 23)
        )
        assert worst > limit.rms_nm


def test_narrow_bands_tend_to_the_known_frequency():
    still = lbt.Truth(turbulence=ar(0.99), noise_nm=3.0)
    known = lbt.loop.least_residual(path(), still).rms_nm
    found = [
        lbt.loop.least_worst_residual(
            path(), still, band_hz=(20, 20 + width), rms_nm=100, direction=(1,)
        ).rms_nm
        for width in (10, 1, 1e-2, 1e-5)
    ]
    assert found[0] > found[1] > found[2] > found[3] > known
    assert found[3] == pytest.approx(known, rel=1e-4)


def test_band_without_noise():
    still = lbt.Truth(turbulence=ar(0.99))
    limit = lbt.loop.least_worst_residual(
        path(), still, band_hz=(15, 25), rms_nm=100, direction=(1,)
    )
    assert lbt.loop.least_residual(path(), still).rms_nm < limit.rms_nm <= limit.achieved_nm
    silent = lbt.loop.least_worst_residual(
        path(), lbt.Truth(turbulence=None), band_hz=(15, 25), rms_nm=100, direction=(1,)
    )
    assert silent.rms_nm == 0.0


# ------------------------------------------------------------------------- study
def test_study(config):
    designs = {
        "kalman": lbt.kalman(config.plant),
        "hinf": lbt.hinf(config.plant, gamma_ratio=1.2, route="riccati"),
    }
    study = lbt.studies.limits(
        designs, config.hardware, config.truth, config.imaging, errors_hz=[-3.5, 0, 3.5]
    )
    assert study.band_hz == (16.5, 23.5)
    assert study.residual_nm.shape == (2, study.shift_hz.size)
    for row, curve in zip(study.rows, study.residual_nm, strict=True):
        assert row.stable
        assert curve[study.shift_hz == 0] == pytest.approx(row.residual_nm)
        assert row.worst_nm == pytest.approx(curve.max())
        assert row.worst_nm == pytest.approx(
            study.band.rms_nm * (1 + row.above_band_limit_percent / 100)
        )
    (axis,) = lbt.report.figures.limits_figure(study).axes
    assert axis.get_xlabel() == "frequency of the true vibration [Hz]"
    assert axis.get_ylabel() == "residual [nm rms]"
    assert len({str(line.get_linestyle()) for line in axis.get_lines()[:2]}) == 2


def test_study_of_an_unstable_design(config):
    designs = {"low": lbt.hinf(config.plant, gamma_ratio=1.05, route="riccati")}
    truth = replace(config.truth, sensor_gain=0.3)
    study = lbt.studies.limits(designs, config.hardware, truth, config.imaging, errors_hz=[-1, 1])
    (row,) = study.rows
    assert not row.stable
    assert np.isnan([row.residual_nm, row.strehl, row.worst_nm, row.above_limit_percent]).all()
    lbt.report.figures.limits_figure(study)


# ------------------------------------------------------------------------ errors
def test_bad_loops():
    calm = {"turbulence": ar(0.9), "noise_nm": 1.0}
    with pytest.raises(
        lbt.errors.ProblemError, match="the sensor must see every mode.*got rank 1 for 2"
    ):
        variance(path(sensor_matrix=[[1.0, 1.0]]), **calm)
    with pytest.raises(
        lbt.errors.ProblemError, match="the mirror must reach every mode.*got rank 1"
    ):
        variance(path(influence_matrix=[[1.0], [1.0]]), **calm)
    slanted = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=5, direction=(1, 1))
    upright = lbt.Vibration(frequency_hz=30, damping=0.01, rms_nm=5, direction=(1, 0))
    with pytest.raises(lbt.errors.ProblemError, match="modes that decouple.*Turn the directions"):
        variance(path(modes=2), **calm, vibrations=(slanted, upright))
    with pytest.raises(lbt.errors.ProblemError, match="along principal axes of the sensor's noise"):
        variance(path(sensor_matrix=np.diag([1.0, 2.0])), **calm, vibrations=(slanted,))
    with pytest.raises(lbt.errors.DimensionError, match="must have 1 components"):
        variance(path(), **calm, vibrations=(upright,))
    slow = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=1, frame_rate_hz=500)
    with pytest.raises(lbt.errors.ProblemError, match="sampled at the loop's 800 Hz; got 500"):
        variance(path(), turbulence=slow)


def test_bad_spectra():
    for psd in (lambda f: -np.ones(f.shape), lambda f: f * np.nan, lambda f: np.ones(3)):
        with pytest.raises(lbt.errors.ProblemError, match=r"Anonymous.psd does not"):
            variance(path(), turbulence=Anonymous(psd), noise_nm=1.0)
    with pytest.raises(lbt.errors.ProblemError, match="set noise_nm to 0"):
        variance(path(), turbulence=ar(0.9, driving=1e10), noise_nm=1e-155)


def test_integrals_that_do_not_settle():
    with pytest.raises(lbt.errors.NumericalError, match="did not settle"):
        refine_panels(lambda x: (1 / x)[:, None], np.array([0.0, 1.0]))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"band_hz": (20,)}, "must be two frequencies"),
        ({"band_hz": 20}, "must be two frequencies"),
        ({"band_hz": (25, 20)}, "must increase"),
        ({"band_hz": (20, 20)}, "For a known frequency"),
        ({"band_hz": (20, 400)}, "below the Nyquist frequency 400"),
        ({"band_hz": (0, 20)}, "above 0"),
        ({"band_hz": (10, float("nan"))}, "finite"),
        ({"rms_nm": -1}, "rms_nm must be above 0"),
        ({"direction": (1, 0)}, "must have 1 components"),
        ({"direction": (0,)}, "not zero"),
    ],
)
def test_bad_bands(arguments, text):
    good = {"band_hz": (15, 25), "rms_nm": 10, "direction": (1,)}
    still = lbt.Truth(turbulence=ar(0.9), noise_nm=1.0)
    with pytest.raises(lbt.errors.ProblemError, match=text):
        lbt.loop.least_worst_residual(path(), still, **(good | arguments))


def test_a_search_that_does_not_settle(monkeypatch):
    monkeypatch.setattr(band_module, "_ROUNDS", 1)
    monkeypatch.setattr(band_module, "_LARGEST_GAP", 1e-6)
    with pytest.raises(lbt.errors.NumericalError, match="a gap of .* is left") as caught:
        lbt.loop.least_worst_residual(
            path(3),
            lbt.Truth(turbulence=ar(0.9), noise_nm=1.0),
            band_hz=(1, 399),
            rms_nm=50,
            direction=(1,),
        )
    assert caught.value.residual > 0


def test_bad_studies(config):
    good = (config.hardware, config.truth, config.imaging)
    with pytest.raises(lbt.errors.ProblemError, match="at least one design"):
        lbt.studies.limits({}, *good)
    designs = {"kalman": lbt.kalman(config.plant)}
    with pytest.raises(lbt.errors.ProblemError, match="at least one error"):
        lbt.studies.limits(designs, *good, errors_hz=[])
    with pytest.raises(lbt.errors.ProblemError, match="must be above 0"):
        lbt.studies.limits(designs, *good, errors_hz=[25.0])
    still = lbt.studies.limits(designs, *good)
    assert still.band is None
    with pytest.raises(lbt.errors.ProblemError, match="a vibration that moves"):
        lbt.report.figures.limits_figure(still)


# ------------------------------------------------------------------- command line
def run(capsys, *arguments):
    status = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_limits_command(tmp_path, capsys, config):
    gain = lbt.save_gain(tmp_path / "kalman.fits", lbt.kalman(config.plant))
    table, figure = tmp_path / "l.csv", tmp_path / "l.png"
    status, out, _ = run(capsys, "limits", CONFIG, gain, "-o", table, "-o", figure, "--json")
    assert status == 0
    data = json.loads(out)
    assert data["limit_nm"] == pytest.approx(10.8414, abs=1e-4)
    assert data["band_limit_nm"] == pytest.approx(15.1088, abs=1e-4)
    assert data["band_hz"] == [16.5, 23.5]
    rows = {row["design"]: row for row in data["rows"]}
    assert list(rows) == ["integrator", "kalman", "hinf", "kalman (file)"]
    assert rows["kalman"]["residual_nm"] == pytest.approx(rows["kalman (file)"]["residual_nm"])
    assert all(row["above_limit_percent"] > 0 for row in rows.values())
    assert len(table.read_text().splitlines()) == 5
    assert figure.exists()
    status, out, _ = run(capsys, "limits", CONFIG)
    assert status == 0
    assert "above the band limit [%]" in out
    assert "231.59" in out


def test_limits_command_without_vibrations_and_with_coupled_modes(tmp_path, capsys):
    text = LBT_YAML.read_text()
    line = "    - {kind: sinusoid, axis: tip, frequency_hz: 20.0, rms_mas: 80.0}\n"
    still = tmp_path / "still.yaml"
    still.write_text(text.replace("  vibrations:\n" + line, ""))
    status, out, _ = run(capsys, "limits", still)
    assert status == 0
    assert "worst" not in out
    status, _, error = run(capsys, "limits", still, "-o", tmp_path / "x.png")
    assert status == 2
    assert "a vibration that moves" in error
    coupled = tmp_path / "coupled.yaml"
    more = (
        "    - {kind: resonance, direction_deg: 30, frequency_hz: 20, rms_mas: 80, damping: 0.01}\n"
        "    - {kind: resonance, axis: tip, frequency_hz: 31, rms_mas: 20, damping: 0.01}\n"
    )
    coupled.write_text(text.replace(line, more))
    status, out, _ = run(capsys, "limits", coupled, "--json")
    assert status == 0
    assert json.loads(out)["limit_nm"] is None
    status, out, _ = run(capsys, "limits", coupled)
    assert "cannot be computed" in out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("limits", CONFIG, "-o", "l.txt"), "must end in .csv"),
        (("limits", CONFIG, "none.fits"), "cannot read none.fits"),
        (("limits", "none.yaml"), "cannot read none.yaml"),
        (("limits", CONFIG, "-o", "none/l.csv"), "no directory none"),
    ],
)
def test_limits_command_refuses(tmp_path, monkeypatch, capsys, arguments, text):
    monkeypatch.chdir(tmp_path)
    status, out, error = run(capsys, *arguments)
    assert status == 2
    assert out == ""
    assert text in error
    assert error.count("\n") == 1


def test_show_and_simulate_tell_the_distance(tmp_path, capsys, config):
    gain = lbt.save_gain(tmp_path / "k.fits", lbt.kalman(config.plant))
    data = json.loads(run(capsys, "show", gain, "--json")[1])
    assert data["limit_nm"] == pytest.approx(192.619, abs=1e-3)
    assert abs(data["above_limit_percent"]) < 1e-4
    simulate = ("simulate", CONFIG, gain, "--frames", 200, "--cases", 1)
    data = json.loads(run(capsys, *simulate, "--json")[1])
    assert data["limit_nm"] == pytest.approx(10.8414, abs=1e-4)
    assert data["above_limit_percent"] == pytest.approx(231.589, abs=1e-2)
    assert "least residual of any linear controller" in run(capsys, *simulate)[1]


def test_show_without_a_limit(tmp_path, capsys):
    """Coupled modes have no limit here: a dash, not a failure."""
    lines = [
        lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=50, direction=d)
        for f, d in ((20, (1, 1)), (31, (1, 0)))
    ]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=ar(0.99, driving=10), vibrations=lines, noise_nm=5.0
    )
    gain = lbt.save_gain(tmp_path / "k.fits", lbt.kalman(plant))
    assert json.loads(run(capsys, "show", gain, "--json")[1])["limit_nm"] is None
    assert run(capsys, "show", gain)[0] == 0


@pytest.mark.parametrize("delay", [1, 2, 3, 2.7])
def test_plants_in_the_full_form(delay):
    for plant in (lbt_axis_plant(delay_frames=delay), lbt_axis_plant(delay_frames=delay, modes=2)):
        limit = least_model_residual(plant.full())
        assert limit.rms_nm == pytest.approx(least_model_residual(plant).rms_nm, rel=1e-9)
    found, above = model_limit(lbt.kalman(plant.full()))
    assert found == pytest.approx(limit.rms_nm)
    assert np.isnan(above) if delay == 2.7 else abs(above) < 1e-6


def test_full_plants_that_do_not_decouple():
    lines = [
        lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=50, direction=d)
        for f, d in ((20, (1, 1)), (31, (1, 0)))
    ]
    parts = {"frame_rate_hz": RATE, "turbulence": ar(0.99, driving=10), "noise_nm": 5.0}
    full = lbt.tip_tilt_plant(**parts, vibrations=lines).full()
    with pytest.raises(lbt.errors.ProblemError, match="the disturbance across them"):
        least_model_residual(full)
    assert np.isnan(model_limit(lbt.kalman(full))).all()
    plain = lbt.tip_tilt_plant(**parts, vibrations=lines[1:]).full()
    entry = plain.D.copy()
    entry[:, 0] = 1.0
    with pytest.raises(lbt.errors.ProblemError, match="independent of the disturbance"):
        least_model_residual(replace(plain, D=entry))
    assert np.isnan(
        model_limit(
            lbt.kalman(lbt.EstimationProblem(A=0.9, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0))
        )
    ).all()


def test_a_band_may_be_very_narrow():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
    truth = lbt.Truth(turbulence=slow, noise_nm=10.0)
    known = lbt.loop.least_residual(path, truth).rms_nm
    narrow = lbt.loop.least_worst_residual(
        path, truth, band_hz=(20, 20 + 1e-9), rms_nm=100, direction=(1,)
    )
    assert known <= narrow.rms_nm < known * 1.01
