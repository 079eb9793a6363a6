"""Fit the weights that the paper does not give to the H-infinity column of Table III.

The truth (frozen-flow turbulence, a sinusoid of 80 mas rms, sensor gain) is the
one that reproduces the Kalman column; free are the weights of
vibration and turbulence relative to the noise, and gamma, one set for all
fifteen rows. Run with ``python examples/fit_table_iii.py`` (some minutes).
"""

import sys

import numpy as np
from scipy.optimize import minimize

import lbt_synth as lbt
from lbt_synth.linear.riccati.filtering import gamma_riccati
from lbt_synth.studies.paper import (
    IMAGING,
    KALMAN_DAMPING,
    PAPER_TRUTH,
    TABLE_III,
    TRUTH_SENSOR_GAIN,
    turbulence_model,
)

NOISE_NM = PAPER_TRUTH.noise_nm
TARGET = np.array([row.hinf for row in TABLE_III])
FREQUENCIES_HZ = np.array([row.model_hz for row in TABLE_III])


def axis_plant(
    frequency_hz: float, damping: float, weights: tuple[float, float]
) -> lbt.models.TipTiltPlant:
    """One axis; ``weights`` are the driving noises of vibration and turbulence over the noise."""
    pole = turbulence_model().coefficients
    unit = lbt.Vibration(frequency_hz=frequency_hz, damping=damping, rms_nm=1.0, direction=(1,))
    rms_nm = weights[0] * NOISE_NM / unit.ar_model(800).driving_rms_nm
    return lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=lbt.models.ARModel(
            coefficients=pole, driving_rms_nm=weights[1] * NOISE_NM, frame_rate_hz=800
        ),
        vibrations=[
            lbt.Vibration(frequency_hz=frequency_hz, damping=damping, rms_nm=rms_nm, direction=(1,))
        ],
        noise_nm=NOISE_NM,
        modes=1,
    )


def column(parameters: np.ndarray) -> np.ndarray:
    """Strehl ratios [%] of the fifteen rows; nan where there is no stable filter."""
    vibration, turbulence, gamma = np.exp(parameters)
    out = np.full(len(TARGET), np.nan)
    for i, frequency in enumerate(FREQUENCIES_HZ):
        plant = axis_plant(frequency, KALMAN_DAMPING, (vibration, turbulence))
        solution = gamma_riccati(plant, gamma * NOISE_NM)
        if solution is None:
            return out
        loop = lbt.close_loop(
            plant.hardware,
            plant.controller(solution.gain_predictor),
            sensor_gain=TRUTH_SENSOR_GAIN,
        )
        if not loop.is_stable:
            return out
        shaken = lbt.Truth(
            turbulence=PAPER_TRUTH.turbulence,
            noise_nm=NOISE_NM,
            sensor_gain=TRUTH_SENSOR_GAIN,
            vibrations=(
                lbt.models.SinusoidalVibration(
                    frequency_hz=20, rms_nm=PAPER_TRUTH.vibrations[0].rms_nm, direction=(1,)
                ),
            ),
        )
        budget = lbt.residual_budget(loop, shaken, frame_means=True)
        tilt = budget.turbulence_nm2[0, 0] + budget.noise_nm2[0, 0]  # the axis without vibration
        lines = np.array([[budget.line_amplitudes_nm[0, 0], 0]])
        out[i] = 100 * lbt.strehl(np.diag([tilt, tilt]), IMAGING, line_amplitudes_nm=lines)
    return out


def loss(parameters: np.ndarray) -> float:
    """Root mean square distance from the paper's column [%]; 100 where infeasible."""
    values = column(parameters)
    return 100.0 if np.isnan(values).any() else float(np.sqrt(np.mean((values - TARGET) ** 2)))


if __name__ == "__main__":
    rng = np.random.default_rng(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
    centre = np.log([0.15, 1.3, 6.0])
    best = None
    for start in range(int(sys.argv[2]) if len(sys.argv) > 2 else 12):
        guess = centre + (0 if start == 0 else 1) * rng.normal(0, [0.6, 0.6, 0.3])
        for bump in np.arange(0, 1.2, 0.1):  # first feasible gamma
            if loss(guess + np.array([0, 0, bump])) < 100:
                guess = guess + np.array([0, 0, bump])
                break
        fit = minimize(loss, guess, method="Nelder-Mead", options={"maxiter": 500, "xatol": 1e-4})
        if best is None or fit.fun < best.fun:
            best = fit
        print(f"{start:3d}  {fit.fun:7.3f}  {np.exp(fit.x)}", flush=True)
    print("best", best.fun, np.exp(best.x))
    print(np.round(column(best.x), 1))
