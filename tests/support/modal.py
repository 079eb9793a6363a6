"""Turbulence and vibrations of many modes."""

import functools
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from support.plants import lbt_axis_plant

import lbt_synth as lbt

RATE = 800.0
LINE = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1,))
HUM = lbt.Vibration(frequency_hz=55, damping=0.02, rms_nm=40.0, direction=(1,))


@functools.cache
def tip_tilt_filter(delay_frames=2.0):
    """The Kalman filter of the LBT's numbers on both axes."""
    return lbt.kalman(lbt_axis_plant(modes=2, delay_frames=delay_frames))


def some_air(n, order=1, seed=0):
    rng = np.random.default_rng(seed)
    if order == 1:
        coefficients = rng.uniform(0.9, 0.995, (n, 1))
    else:
        decay, turn = rng.uniform(0.9, 0.99, n), rng.uniform(0.005, 0.1, n)
        coefficients = np.stack([2 * decay * np.cos(turn), -(decay**2)], axis=1)
    return lbt.models.ARModel(
        coefficients=coefficients, driving_rms_nm=10 ** rng.uniform(0, 2, n), frame_rate_hz=RATE
    )


def single_plant(air, mode, lines, noise, gain, **path):
    models = {"turbulence": air.take(mode), "vibrations": lines, "noise_nm": float(noise)}
    path |= {"frame_rate_hz": RATE, "modes": 1}
    return lbt.tip_tilt_plant(sensor_gain=float(gain), **models, **path)


def path_of(**options):
    """Return the loop of modes that have a unit sensor."""
    return lbt.LoopHardware(**({"frame_rate_hz": RATE} | options))


def integrator_residual(gain, path, truth):
    """Return what an integrator of one mode leaves in the image, nan if it is unstable."""
    law = lbt.Controller(A=1.0, B=gain, C=1.0, D=0.0, dt_s=path.dt_s)
    loop = lbt.close_loop(path, law, sensor_gain=truth.sensor_gain)
    return lbt.residual_budget(loop, truth).rms_nm if loop.is_stable else np.nan


def integrator_residuals(gains, air, *, noise_nm, hardware=None, vibrations=None, sensor_gain=1.0):
    """Return what an integrator for each mode leaves in the image, (n,), nan if unstable."""
    path, residuals = (hardware or path_of()).single_mode(), []
    conditions = (np.broadcast_to(values, len(gains)) for values in (noise_nm, sensor_gain))
    for mode, (gain, noise, sensor) in enumerate(zip(gains, *conditions, strict=True)):
        lines = [
            replace(line, rms_nm=line.rms_nm / np.sinc(line.frequency_hz * path.dt_s))
            for line in np.atleast_1d((vibrations or {}).get(mode, []))
        ]
        facts = {"vibrations": lines, "noise_nm": float(noise), "sensor_gain": float(sensor)}
        truth = lbt.Truth(turbulence=air.take(mode), **facts)
        residuals.append(integrator_residual(gain, path, truth))
    return np.array(residuals)


def joint_controller(parts, n):
    """Return controllers of some modes each as one linear controller of all."""
    parts = [(np.eye(n)[list(modes)], controller) for modes, controller in parts]
    return lbt.Controller(
        A=block_diag(*(k.A for _, k in parts)),
        B=np.vstack([k.B @ chosen for chosen, k in parts]),
        C=np.hstack([chosen.T @ k.C for chosen, k in parts]),
        D=sum(chosen.T @ k.D @ chosen for chosen, k in parts),
        dt_s=1 / RATE,
    )


def integrator_run(gains, total, noise, *, sensor_gain=1.0, hardware=None):
    """Return measurements and commands, (frames, n) each, of an integrator for each mode."""
    path = (hardware or path_of()).single_mode()
    runs = []
    for gain, phase, own, real in zip(
        gains, total, noise, np.broadcast_to(sensor_gain, len(total)), strict=True
    ):
        law = lbt.Controller(A=1.0, B=gain, C=1.0, D=0.0, dt_s=path.dt_s)
        facts = {"noise": own[:, None], "sensor_gain": real, "frame_means": True}
        runs.append(
            lbt.simulate(law, lbt.loop.Disturbance(phase_nm=phase[:, None], **facts), hardware=path)
        )
    return tuple(
        np.stack([series[0, :, 0] for series in kind], axis=1)
        for kind in zip(*((run.measurements, run.commands) for run in runs), strict=True)
    )
