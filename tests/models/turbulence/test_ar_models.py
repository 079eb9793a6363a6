"""AR models of the turbulence: Le Roux poles, and fits of order two."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.integrate import quad, trapezoid
from scipy.special import gamma, jv
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.turbulence.ar_models import radial_orders, zernike_variances

SITE = {"seeing_arcsec": 0.8, "wind_speed_m_s": 20, "diameter_m": 8.22}
RATE = 800.0


def test_models_of_the_lbt(air):
    model = lbt.models.ar1_turbulence(air, frame_rate_hz=800)
    assert model.rms_nm == pytest.approx(air.tilt_rms_nm, rel=1e-12)
    assert model.coefficients == pytest.approx([0.98860], abs=5e-6)  # the pole of Le Roux et al.
    model = lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=15.5)
    assert model.coefficients == pytest.approx([1.997477, -0.997555], abs=2e-5)


def test_ar2_fit_returns_the_model_that_made_the_spectrum(monkeypatch, air):
    made = lbt.models.ARModel(coefficients=[1.99, -0.992], driving_rms_nm=0.8, frame_rate_hz=800)
    monkeypatch.setattr(type(air), "psd", lambda _self, f: made.psd(f))
    monkeypatch.setattr(type(air), "tilt_rms_nm", made.rms_nm)
    found = lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=1.0)
    assert found.coefficients == pytest.approx(made.coefficients, abs=1e-5)
    assert found.driving_rms_nm == pytest.approx(0.8, rel=1e-3)


def test_ar2_fit_is_not_a_line_between_two_nodes():
    air = lbt.Atmosphere(**(SITE | {"wind_speed_m_s": 16.5}), outer_scale_m=30)
    model = lbt.models.ar2_turbulence(air, frame_rate_hz=500, noise_nm=1.0)
    assert model.rms_nm == pytest.approx(air.tilt_rms_nm, rel=1e-6)
    frequency = (np.arange(20_000) + 0.5) / 80
    white = 2 / 500
    target = air.psd(frequency) + white

    def contrast(made: lbt.ARModel) -> float:
        spectrum = made.psd(frequency) + white
        return float(np.mean(np.log(spectrum) + target / spectrum))

    others = [
        lbt.Vibration(frequency_hz=f, damping=damping, rms_nm=air.tilt_rms_nm).ar_model(500)
        for f in np.geomspace(0.5, 3, 9)
        for damping in (0.02, 0.04, 0.06, 0.1, 0.4)
    ]
    assert contrast(model) < min(map(contrast, others))


def test_noise_that_hides_the_turbulence_is_named():
    """A line without damping would explain it as well: nothing is left to fit."""
    air = lbt.Atmosphere(**SITE, outer_scale_m=22)
    for noise_nm in (1e5, 1e12):
        with pytest.raises(lbt.errors.NumericalError, match="the noise hides the turbulence"):
            lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=noise_nm)
    loud = lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=1e4)
    assert loud.rms_nm == pytest.approx(air.tilt_rms_nm, rel=1e-5)


def kolmogorov(air: lbt.Atmosphere, n: int) -> float:
    """Closed form, Noll (1976) eq. 25 with all digits of its constant [nm^2]."""
    power, order = 14 / 3, n + 1
    bessel = gamma(power) * gamma(order + (1 - power) / 2)
    bessel /= 2**power * gamma((1 + power) / 2) ** 2 * gamma(order + (1 + power) / 2)
    ratio = air.diameter_m / air.fried_parameter_m
    radians = 8 * np.pi * (n + 1) * 0.0228956 * (np.pi * ratio) ** (5 / 3) * bessel
    return float(radians * (air.seeing_wavelength_um * 1e3 / (2 * np.pi)) ** 2)


def test_variances_are_nolls_closed_form():
    air = lbt.Atmosphere(outer_scale_m=None, **SITE)
    found = zernike_variances(air, 36)
    expected = [kolmogorov(air, n) for n in range(1, 37)]
    assert np.allclose(found, expected, rtol=1e-6)
    assert air.tilt_rms_nm**2 == pytest.approx(found[0], rel=2e-6)
    # Noll's table IV: a tilt has 0.448 (D/r0)^(5/3) rad^2, a defocus 0.0232
    unit = (air.diameter_m / air.fried_parameter_m) ** (5 / 3) * (500 / (2 * np.pi)) ** 2
    assert np.allclose(found[:2] / unit, [0.448, 0.0232], rtol=3e-3)


def test_variances_with_an_outer_scale():
    air = lbt.Atmosphere(outer_scale_m=22, **SITE)
    found = zernike_variances(air, 36)
    assert found[0] == pytest.approx(air.tilt_rms_nm**2, rel=1e-7)
    scale = kolmogorov(air, 5) / (6 * kolmogorov_integral(air, 5, None))
    for n in (1, 5):
        expected = scale * (n + 1) * kolmogorov_integral(air, n, 22.0)
        assert found[n - 1] == pytest.approx(expected, rel=1e-5)
    assert np.all(np.diff(found) < 0)


def kolmogorov_integral(air, n, outer):
    inner = 0 if outer is None else outer**-2

    def density(x):
        f = x / (np.pi * air.diameter_m)
        return f * (f**2 + inner) ** (-11 / 6) * (jv(n + 1, x) / x) ** 2

    return (
        sum(quad(density, a, a + 5, epsabs=0, epsrel=1e-9)[0] for a in range(1, 300, 5))
        + quad(density, 1e-6, 1, epsrel=1e-9)[0]
    )


def test_nolls_order():
    radial = radial_orders(20)
    # Noll's table I, j = 2 to 21
    assert radial.tolist() == [1] * 2 + [2] * 3 + [3] * 4 + [4] * 5 + [5] * 6
    assert [radial_orders(modes)[-1] for modes in (1, 2, 3, 9, 10, 5151)] == [1, 1, 2, 3, 4, 101]
    with pytest.raises(lbt.errors.ProblemError, match="modes must be at least 1"):
        radial_orders(0)


def test_modes_of_a_telescope():
    air = lbt.Atmosphere(outer_scale_m=22, **SITE)
    modes = lbt.models.modal_turbulence(air, modes=30, frame_rate_hz=800)
    tilt = lbt.models.ar1_turbulence(air, frame_rate_hz=800)
    assert modes.coefficients[0, 0] == tilt.coefficients[0]
    assert modes.rms_nm[1] == pytest.approx(tilt.rms_nm, rel=1e-7)
    radial = radial_orders(30)
    assert np.allclose(
        np.log(modes.coefficients[:, 0]) / np.log(tilt.coefficients[0]), (radial + 1) / 2
    )
    # the spectra hold the variances
    f = np.linspace(0, 400, 200_001)
    assert np.allclose(trapezoid(modes.psd(f), f, axis=1), modes.rms_nm**2, rtol=1e-3)
    with pytest.raises(lbt.errors.ProblemError, match="expected an Atmosphere"):
        lbt.models.modal_turbulence(800, modes=3, frame_rate_hz=800)
    with pytest.raises(lbt.errors.ProblemError, match="frame_rate_hz"):
        lbt.models.modal_turbulence(air, modes=3, frame_rate_hz=-1)


def test_arrays_are_the_single_models():
    models = [
        lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=3.0, frame_rate_hz=RATE),
        lbt.models.ARModel(coefficients=[1.9, -0.92], driving_rms_nm=1.0, frame_rate_hz=RATE),
    ]
    air = lbt.models.ARModel.stack(models)
    assert (air.count, air.order) == (2, 2)
    assert np.allclose(air.rms_nm, [m.rms_nm for m in models], rtol=1e-13)
    f = np.geomspace(0.1, 400, 7)
    assert np.allclose(air.psd(f), [m.psd(f) for m in models], rtol=1e-12)
    assert air.take(1).coefficients.tolist() == [1.9, -0.92]


def test_bad_arrays_are_refused():
    air = lbt.models.ARModel(coefficients=[[0.9], [0.8]], driving_rms_nm=[1, 1], frame_rate_hz=800)
    slow, stack = replace(air.take(0), frame_rate_hz=500), lbt.models.ARModel.stack
    parts = {"frame_rate_hz": 800, "turbulence": [air], "noise_nm": 1.0, "modes": 1}
    changed = partial(replace, air)
    rows = [
        (partial(changed, coefficients=[[0.9], [1.0]]), ProblemError, "process 1 of modulus 1"),
        (partial(changed, coefficients=np.zeros((0, 1))), DimensionError, "at least one number"),
        (partial(changed, driving_rms_nm=[1]), DimensionError, r"\(2, 1\) and \(1,\)"),
        (partial(changed, driving_rms_nm=[1, 0]), ProblemError, "above 0"),
        (partial(changed, frame_rate_hz=0), ProblemError, "frame_rate_hz"),
        (partial(stack, []), ProblemError, "one ARModel a mode"),
        (partial(stack, [air.take(0), slow]), ProblemError, "same frame rate"),
        (partial(lbt.tip_tilt_plant, **parts), DimensionError, "one per mode"),
    ]
    require_refusals(rows)
    plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=air, noise_nm=1.0)
    assert [model.coefficients.item() for model in plant.turbulence] == [0.9, 0.8]
    truth = lbt.Truth(turbulence=air)
    assert [modes for _, modes in truth.turbulence_groups(2)] == [[0], [1]]
