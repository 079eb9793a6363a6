"""The Riccati equation of the Kalman predictor, against SLICOT and scipy."""

from __future__ import annotations

import numpy as np
import scipy.linalg
import slycot

import lbt_synth as lbt
from lbt_synth.linear.riccati.filtering import kalman_riccati


def test_an_ordinary_plant_that_scipy_refuses():
    """AR2 turbulence and a lightly damped vibration."""
    turbulence = lbt.models.ARModel(
        coefficients=[1.997477, -0.997555], driving_rms_nm=0.37, frame_rate_hz=800
    )
    line = lbt.Vibration(frequency_hz=20, damping=1e-4, rms_nm=800, direction=(1,))
    refused = 0
    for noise in np.geomspace(1e-2, 1e3, 12):
        plant = lbt.tip_tilt_plant(
            frame_rate_hz=800, turbulence=turbulence, vibrations=[line], noise_nm=noise, modes=1
        )
        solution = kalman_riccati(plant)
        assert solution.residual < 1e-12
        try:
            scipy.linalg.solve_discrete_are(plant.A.T, plant.C.T, plant.Q, plant.R)
        except (np.linalg.LinAlgError, ValueError):
            refused += 1
    assert refused > 0


def test_kalman_riccati_against_slycot(axis_plant):
    p = axis_plant
    X = slycot.sb02od(4, 1, p.A.T, p.C.T, p.Q, p.R, "D")[0]
    assert np.allclose(kalman_riccati(p).P, X, rtol=1e-6, atol=1e-6 * np.abs(X).max())
