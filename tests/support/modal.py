"""Turbulence and vibrations of many modes."""

from __future__ import annotations

import numpy as np

import lbt_synth as lbt

RATE = 800.0
LINE = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1,))
HUM = lbt.Vibration(frequency_hz=55, damping=0.02, rms_nm=40.0, direction=(1,))


def some_air(n: int, order: int = 1, seed: int = 0) -> lbt.models.ModalTurbulence:
    rng = np.random.default_rng(seed)
    if order == 1:
        coefficients = rng.uniform(0.9, 0.995, (n, 1))
    else:
        decay, turn = rng.uniform(0.9, 0.99, n), rng.uniform(0.005, 0.1, n)
        coefficients = np.stack([2 * decay * np.cos(turn), -(decay**2)], axis=1)
    return lbt.models.ModalTurbulence(
        coefficients=coefficients, driving_rms_nm=10 ** rng.uniform(0, 2, n), frame_rate_hz=RATE
    )


def single_plant(air, mode, lines, noise, gain, **path):
    return lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=air.model(mode),
        vibrations=list(lines) or None,
        noise_nm=float(noise),
        sensor_gain=float(gain),
        modes=1,
        **path,
    )


def integrator_loop(gains, *, sensor_gain=1.0, **path):
    """Loop of all modes around an integrator for each."""
    return lbt.design.modal.modal_loop(
        lbt.design.modal.MixedController(gains=gains),
        hardware=lbt.LoopHardware(**({"frame_rate_hz": RATE} | path)),
        sensor_gain=sensor_gain,
    )
