"""Long studies, run by ``make study``."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

import lbt_synth as lbt
from lbt_synth.riccati import kalman_riccati


def random_plant(rng: np.random.Generator) -> lbt.TipTiltPlant:
    """One axis with 1 to 6 vibrations, AR1 or AR2 turbulence, noise over six decades."""
    rate = 800.0
    if rng.random() < 0.5:
        coefficients = [rng.uniform(0.9, 0.9999)]
    else:
        slow = 2 * np.pi * rng.uniform(0.2, 5) / rate
        damping = rng.uniform(0.05, 0.9)
        decay = np.exp(-damping * slow)
        coefficients = [2 * decay * np.cos(slow * np.sqrt(1 - damping**2)), -(decay**2)]
    unit = lbt.ARModel(coefficients=coefficients, driving_rms_nm=1.0, frame_rate_hz=rate)
    turbulence = lbt.ARModel(
        coefficients=coefficients, driving_rms_nm=600 / unit.rms_nm, frame_rate_hz=rate
    )
    vibrations = [
        lbt.Vibration(
            frequency_hz=rng.uniform(5, 150),
            damping=10 ** rng.uniform(-4, -1),
            rms_nm=10 ** rng.uniform(0, 3),
            direction=(1,),
        )
        for _ in range(rng.integers(1, 7))
    ]
    return lbt.tip_tilt_plant(
        frame_rate_hz=rate, delay_frames=int(rng.integers(1, 4)), turbulence=turbulence,
        vibrations=vibrations, noise_nm=10 ** rng.uniform(-3, 3), modes=1,
    )  # fmt: skip


@pytest.mark.study
def test_random_plants_of_this_field(capsys):
    """Each Kalman and H-infinity design is certified; scipy's failures are counted beside."""
    rng = np.random.default_rng(0)
    worst, refused, count = 0.0, 0, 1000
    for _ in range(count):
        plant = random_plant(rng)
        worst = max(worst, kalman_riccati(plant).residual)
        assert lbt.kalman(plant).certificate.passed
        assert lbt.hinf(plant, gamma_ratio=1.2, method="riccati").certificate.passed
        try:
            scipy.linalg.solve_discrete_are(plant.A.T, plant.C.T, plant.Q, plant.R)
        except (np.linalg.LinAlgError, ValueError):
            refused += 1
    with capsys.disabled():
        print(f"\n{count} plants: worst relative residual {worst:.2g}; scipy refused {refused}")
    assert worst < 1e-12
