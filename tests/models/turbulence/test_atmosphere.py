"""Von Karman turbulence and models of it, against published numbers and adaptive quadrature."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad, trapezoid
from scipy.special import gamma, jv
from support.ensembles import AIR, weather
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models import ARModel, ar1_turbulence, ar2_turbulence, modal_turbulence
from lbt_synth.models.turbulence.ar_models import radial_orders, zernike_variances
from lbt_synth.models.turbulence.atmosphere import _octave_of_splines

RATE = 800.0


def test_tilt_of_the_lbt(air):
    assert air.fried_parameter_m == pytest.approx(0.1258, abs=1e-4)
    assert air.tilt_rms_nm == pytest.approx(591.7, abs=0.5)
    assert replace(air, obstruction=0.11).tilt_rms_nm == pytest.approx(595.3, abs=0.5)
    f = np.geomspace(1e-5, 400, 100_001)
    assert trapezoid(air.psd(f), f) == pytest.approx(air.tilt_rms_nm**2, rel=2e-3)


def test_tilt_spectrum_between_the_points_of_its_table(air):
    """By adaptive quadrature over the other spatial frequency."""
    r0, D, V = air.fried_parameter_m, air.diameter_m, air.wind_speed_m_s
    scale = 0.0228956 * r0 ** (-5 / 3) * (500 / (2 * np.pi)) ** 2

    def spatial(fy, fx):
        f = np.hypot(fx, fy)
        tilt = 2 * (4 * jv(2, np.pi * D * f) / (2 * np.pi * D * f)) ** 2
        return scale * (f**2 + 22.0**-2) ** (-11 / 6) * tilt

    edges = np.concatenate([[0], np.geomspace(1e-3, 40, 60)]) / D
    # those between two points of the table, in units of V / D
    for f in np.array([0.011, 0.27, 0.8137, 1.9371, 4.4417, 9.97]) * V / D:
        panels = pairwise(edges)
        total = sum(quad(spatial, *ends, args=(f / V,), limit=200)[0] for ends in panels)
        assert air.psd(f) == pytest.approx(4 / V * total, rel=2e-5)


def test_flows_are_those_of_single_atmospheres():
    w, f = weather(4, seed=7), np.geomspace(1e-5, 399, 300)
    columns = {"seeing_arcsec": w["seeing"], "wind_speed_m_s": w["wind"]}
    columns["outer_scale_m"] = [22.0, 30.0] * 2
    flows = replace(AIR, **columns)
    for psd, *numbers in zip(flows.psd(f), *columns.values(), strict=True):
        single = replace(AIR, **dict(zip(columns, numbers, strict=True)))
        assert psd == pytest.approx(single.psd(f), rel=1e-11)
    assert flows.take(np.array([3])).psd(f)[0] == pytest.approx(flows.psd(f)[3], rel=1e-12)
    endless = replace(AIR, outer_scale_m=None)
    alone = [replace(endless, wind_speed_m_s=v).psd(3.0) for v in (10, 20)]
    both = replace(endless, wind_speed_m_s=[10.0, 20.0]).psd([3.0])
    assert both[:, 0] == pytest.approx(np.array(alone), rel=1e-12)


def test_flows_of_many_outer_scales():
    """More scales than have tables of their own: a polynomial over each octave."""
    scales, f = np.geomspace(16.5, 31.5, 20), np.geomspace(1e-4, 399, 100)
    psd = replace(AIR, outer_scale_m=scales).psd(f)
    for i in (0, 7, 19):
        single = replace(AIR, outer_scale_m=float(scales[i])).psd(f)
        assert psd[i] == pytest.approx(single, rel=1e-9)
    assert _octave_of_splines.cache_info().currsize >= 1


def test_ar2_fit_returns_the_model_that_made_the_spectrum(monkeypatch, air):
    made = ARModel(coefficients=[1.99, -0.992], driving_rms_nm=0.8, frame_rate_hz=RATE)
    monkeypatch.setattr(type(air), "psd", lambda _self, f: made.psd(f))
    monkeypatch.setattr(type(air), "tilt_rms_nm", made.rms_nm)
    fitted = ar2_turbulence(air, frame_rate_hz=RATE, noise_nm=1.0)
    assert fitted.coefficients == pytest.approx(made.coefficients, abs=1e-5)
    assert fitted.driving_rms_nm == pytest.approx(0.8, rel=1e-3)


def test_ar2_fit_is_not_a_line_between_two_nodes(air):
    air = replace(air, wind_speed_m_s=16.5, outer_scale_m=30)
    model = ar2_turbulence(air, frame_rate_hz=500, noise_nm=1.0)
    assert model.rms_nm == pytest.approx(air.tilt_rms_nm, rel=1e-6)
    frequency, white = (np.arange(20_000) + 0.5) / 80, 2 / 500
    target = air.psd(frequency) + white

    def contrast(made):
        spectrum = made.psd(frequency) + white
        return np.mean(np.log(spectrum) + target / spectrum)

    others = [
        lbt.Vibration(frequency_hz=f, damping=damping, rms_nm=air.tilt_rms_nm).ar_model(500)
        for f in np.geomspace(0.5, 3, 9)
        for damping in (0.02, 0.04, 0.06, 0.1, 0.4)
    ]
    assert contrast(model) < min(map(contrast, others))


def test_noise_that_hides_the_turbulence_is_named(air):
    """A line without damping would explain it as well: nothing is left to fit."""
    fit = partial(ar2_turbulence, air, frame_rate_hz=RATE)
    assert fit(noise_nm=15.5).coefficients == pytest.approx([1.997477, -0.997555], abs=2e-5)
    kind, words = lbt.errors.NumericalError, "the noise hides the turbulence"
    require_refusals((partial(fit, noise_nm=noise_nm), kind, words) for noise_nm in (1e5, 1e12))
    assert fit(noise_nm=1e4).rms_nm == pytest.approx(air.tilt_rms_nm, rel=1e-5)


def kolmogorov(air, n):
    """Closed form, Noll (1976) eq. 25 with all digits of its constant [nm^2]."""
    power, order = 14 / 3, n + 1
    bessel = gamma(power) * gamma(order + (1 - power) / 2)
    bessel /= 2**power * gamma((1 + power) / 2) ** 2 * gamma(order + (1 + power) / 2)
    ratio = air.diameter_m / air.fried_parameter_m
    radians = 8 * np.pi * (n + 1) * 0.0228956 * (np.pi * ratio) ** (5 / 3) * bessel
    return float(radians * (air.seeing_wavelength_um * 1e3 / (2 * np.pi)) ** 2)


def kolmogorov_integral(air, n):
    inner = 0 if air.outer_scale_m is None else air.outer_scale_m**-2

    def density(x):
        f = x / (np.pi * air.diameter_m)
        return f * (f**2 + inner) ** (-11 / 6) * (jv(n + 1, x) / x) ** 2

    edges = np.array([1e-6, *range(1, 300, 5), 301])
    return sum(quad(density, *ends, epsabs=0, epsrel=1e-9)[0] for ends in pairwise(edges))


def test_variances_are_nolls_closed_form_and_those_of_an_outer_scale(air):
    endless = replace(air, outer_scale_m=None)
    variances = zernike_variances(endless, 36)
    assert np.allclose(variances, [kolmogorov(endless, n) for n in range(1, 37)], rtol=1e-6)
    assert endless.tilt_rms_nm**2 == pytest.approx(variances[0], rel=2e-6)
    # Noll's table IV: a tilt has 0.448 (D/r0)^(5/3) rad^2, a defocus 0.0232
    unit = (air.diameter_m / air.fried_parameter_m) ** (5 / 3) * (500 / (2 * np.pi)) ** 2
    assert np.allclose(variances[:2] / unit, [0.448, 0.0232], rtol=3e-3)
    scale = variances[4] / (6 * kolmogorov_integral(endless, 5))
    variances = zernike_variances(air, 36)
    assert variances[0] == pytest.approx(air.tilt_rms_nm**2, rel=1e-7)
    expected = [scale * (n + 1) * kolmogorov_integral(air, n) for n in (1, 5)]
    assert variances[[0, 4]] == pytest.approx(expected, rel=1e-5)
    assert np.all(np.diff(variances) < 0)


def test_nolls_order():
    # Noll's table I, j = 2 to 21
    assert radial_orders(20).tolist() == [1] * 2 + [2] * 3 + [3] * 4 + [4] * 5 + [5] * 6
    assert [radial_orders(modes)[-1] for modes in (1, 2, 3, 9, 10, 5151)] == [1, 1, 2, 3, 4, 101]


def test_modes_of_a_telescope(air):
    modes = modal_turbulence(air, modes=30, frame_rate_hz=RATE)
    tilt = ar1_turbulence(air, frame_rate_hz=RATE)
    assert modes.coefficients[0, 0] == tilt.coefficients[0]
    assert modes.rms_nm[1] == pytest.approx(tilt.rms_nm, rel=1e-7)
    decays = np.log(modes.coefficients[:, 0]) / np.log(tilt.coefficients[0])
    assert np.allclose(decays, (radial_orders(30) + 1) / 2)
    f = np.linspace(0, 400, 200_001)  # the spectra hold the variances
    assert np.allclose(trapezoid(modes.psd(f), f, axis=1), modes.rms_nm**2, rtol=1e-3)


def test_arrays_are_the_single_models():
    models = [
        ARModel(coefficients=coefficients, driving_rms_nm=driving_nm, frame_rate_hz=RATE)
        for coefficients, driving_nm in (([0.99], 3.0), ([1.9, -0.92], 1.0))
    ]
    stack, f = ARModel.stack(models), np.geomspace(0.1, 400, 7)
    assert (stack.count, stack.order) == (2, 2)
    assert np.allclose(stack.rms_nm, [m.rms_nm for m in models], rtol=1e-13)
    assert np.allclose(stack.psd(f), [m.psd(f) for m in models], rtol=1e-12)
    assert stack.take(1).coefficients.tolist() == [1.9, -0.92]
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=stack, noise_nm=1.0)
    assert [model.coefficients.sum() for model in plant.turbulence] == pytest.approx([0.99, 0.98])
    truth = lbt.Truth(turbulence=stack)
    assert [modes for _, modes in truth.turbulence_groups(2)] == [[0], [1]]


def test_bad_arrays_are_refused(air):
    process = ARModel(coefficients=[[0.9], [0.8]], driving_rms_nm=[1, 1], frame_rate_hz=RATE)
    changed, stack = partial(replace, process), ARModel.stack
    slow = replace(process.take(0), frame_rate_hz=500)
    parts = {"frame_rate_hz": RATE, "turbulence": [process], "noise_nm": 1.0, "modes": 1}
    modes, flow = partial(modal_turbulence, modes=3), partial(replace, AIR)
    uneven = {"seeing_arcsec": [0.5, 0.6], "wind_speed_m_s": [1, 2, 3]}
    require_refusals(
        [
            (partial(changed, coefficients=[[0.9], [1.0]]), ProblemError, "process 1 of modulus 1"),
            (partial(changed, coefficients=np.zeros((0, 1))), DimensionError, "at least one numb"),
            (partial(changed, driving_rms_nm=[1]), DimensionError, r"\(2, 1\) and \(1,\)"),
            (partial(changed, driving_rms_nm=[1, 0]), ProblemError, "above 0"),
            (partial(changed, frame_rate_hz=0), ProblemError, "frame_rate_hz"),
            (partial(stack, []), ProblemError, "one ARModel a mode"),
            (partial(stack, [process.take(0), slow]), ProblemError, "same frame rate"),
            (partial(lbt.tip_tilt_plant, **parts), DimensionError, "one per mode"),
            (partial(radial_orders, 0), ProblemError, "modes must be at least 1"),
            (partial(modes, 800, frame_rate_hz=RATE), ProblemError, "expected an Atmosphere"),
            (partial(modes, air, frame_rate_hz=-1), ProblemError, "frame_rate_hz"),
            (partial(flow, seeing_arcsec=[0.5, 0.0]), ProblemError, "seeing_arcsec must be above"),
            (partial(flow, **uneven), DimensionError, "same length"),
            (partial(flow, wind_speed_m_s=[[1.0]]), DimensionError, "lists of the same length"),
            (partial(AIR.psd, [-1.0]), ProblemError, "at least 0; got -1"),
        ]
    )
