"""AR1 models of Zernike modes."""

import numpy as np
import pytest
from scipy.integrate import trapezoid

import lbt_synth as lbt
from lbt_synth.models.turbulence.zernike import noll_orders

SITE = {"seeing_arcsec": 0.8, "wind_speed_m_s": 20, "diameter_m": 8.22}

RATE = 800.0


def test_modes_of_a_telescope():
    air = lbt.Atmosphere(outer_scale_m=22, **SITE)
    modes = lbt.models.modal_turbulence(air, modes=30, frame_rate_hz=800)
    tilt = lbt.models.ar1_turbulence(air, frame_rate_hz=800)
    assert modes.coefficients[0, 0] == tilt.coefficients[0]
    assert modes.rms_nm[1] == pytest.approx(tilt.rms_nm, rel=1e-7)
    radial, _ = noll_orders(30)
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
    air = lbt.models.ModalTurbulence.of(models)
    assert (air.n_modes, air.order) == (2, 2)
    assert np.allclose(air.rms_nm, [m.rms_nm for m in models], rtol=1e-13)
    f = np.geomspace(0.1, 400, 7)
    assert np.allclose(air.psd(f), [m.psd(f) for m in models], rtol=1e-12)
    assert air.model(1).coefficients.tolist() == [1.9, -0.92]


def test_bad_arrays_are_refused():
    ok = {"coefficients": [[0.9], [0.8]], "driving_rms_nm": [1, 1], "frame_rate_hz": 800}
    for change, error, words in (
        ({"coefficients": [[0.9], [1.0]]}, lbt.errors.ProblemError, "modulus 1 in mode 1"),
        ({"coefficients": np.zeros((0, 1))}, lbt.errors.DimensionError, "at least one of each"),
        ({"driving_rms_nm": [1]}, lbt.errors.DimensionError, r"shape \(2,\)"),
        ({"driving_rms_nm": [1, 0]}, lbt.errors.ProblemError, "above 0"),
        ({"frame_rate_hz": 0}, lbt.errors.ProblemError, "frame_rate_hz"),
    ):
        with pytest.raises(error, match=words):
            lbt.models.ModalTurbulence(**(ok | change))
    air = lbt.models.ModalTurbulence(**ok)
    with pytest.raises(lbt.errors.ProblemError, match="at most 1; got 2"):
        air.model(2)
    with pytest.raises(lbt.errors.ProblemError, match="one ARModel a mode"):
        lbt.models.ModalTurbulence.of([])
    slow = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=1.0, frame_rate_hz=500)
    with pytest.raises(lbt.errors.ProblemError, match="same frame rate"):
        lbt.models.ModalTurbulence.of([air.model(0), slow])
