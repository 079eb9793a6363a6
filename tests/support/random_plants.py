"""Random plants of one axis."""

from __future__ import annotations

import numpy as np

import lbt_synth as lbt


def random_plant(rng: np.random.Generator) -> lbt.models.TipTiltPlant:
    """One axis with 1 to 6 vibrations, AR1 or AR2 turbulence, noise over six decades."""
    rate = 800.0
    if rng.random() < 0.5:
        coefficients = [rng.uniform(0.9, 0.9999)]
    else:
        slow = 2 * np.pi * rng.uniform(0.2, 5) / rate
        damping = rng.uniform(0.05, 0.9)
        decay = np.exp(-damping * slow)
        coefficients = [2 * decay * np.cos(slow * np.sqrt(1 - damping**2)), -(decay**2)]
    unit = lbt.models.ARModel(coefficients=coefficients, driving_rms_nm=1.0, frame_rate_hz=rate)
    turbulence = lbt.models.ARModel(
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
        frame_rate_hz=rate,
        delay_frames=int(rng.integers(1, 4)),
        turbulence=turbulence,
        vibrations=vibrations,
        noise_nm=10 ** rng.uniform(-3, 3),
        modes=1,
    )
