"""Fit Table III's H-infinity column with other fixed parameters, or compare turbulence models.

Run with ``python benchmarks/paper.py`` (some minutes) or ``python benchmarks/paper.py turbulence``
from the repository.
"""

import sys
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

import lbt_synth as lbt

sys.path.insert(0, "examples")
import fit_table_iii as fit

START = np.log([0.2508, 2.374, 7.324])


def refit(start: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights and gamma from a start that is moved until it is feasible."""
    for bump in np.arange(0, 2.0, 0.1):
        trial = start + np.array([0, 0, bump])
        if fit.loss(trial) < 100:
            break
    found = minimize(fit.loss, trial, method="Nelder-Mead", options={"maxiter": 500, "xatol": 1e-4})
    return found.x, float(found.fun)


def show(name: str, parameters: np.ndarray, rms: float) -> None:
    """One line: what was held, the weights found, the distance from the column."""
    vibration, turbulence, gamma = np.exp(parameters)
    print(
        f"{name:24s} vibration {vibration:.3f}  turbulence {turbulence:.3f}  "
        f"gamma {gamma:.3f}  rms {rms:.2f} points",
        flush=True,
    )


def turbulence_models() -> None:
    """Print what filters of two models leave of frozen flow without any vibration."""
    config = lbt.load_config("examples/lbt.yaml")
    air, noise_nm, path = config.atmosphere, config.noise_nm, config.hardware
    calm = replace(config.truth, vibrations=())
    models = {
        "Kalman, AR1": lbt.models.ar1_turbulence(air, frame_rate_hz=800),
        "Kalman, AR2": lbt.models.ar2_turbulence(air, frame_rate_hz=800, noise_nm=noise_nm),
    }
    designs = {"integrator": lbt.integrator(path, truth=calm)} | {
        name: lbt.kalman(lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=model, noise_nm=noise_nm))
        for name, model in models.items()
    }
    for name, design in designs.items():
        loop = lbt.close_loop(path, design.controller)
        budget = lbt.residual_budget(loop, calm, frame_means=True)
        print(
            f"{name:12s} residual {budget.rms_nm:5.1f} nm (turbulence {budget.turbulence_nm:.1f}, "
            f"noise {budget.noise_nm:.1f}), Strehl {100 * lbt.strehl(budget, config.imaging):.1f} %"
        )


def refits() -> None:
    """Print the weights that other fixed parameters ask for."""
    show("as in the library", START, fit.loss(START))
    fit.KALMAN_DAMPING = 0.003
    show("damping 0.003", *refit(START))
    fit.KALMAN_DAMPING = 0.0051
    for gain in (0.34, 0.40):
        fit.TRUTH_SENSOR_GAIN = gain
        show(f"sensor gain {gain}", *refit(START))
    fit.TRUTH_SENSOR_GAIN = 0.358
    free = fit.loss
    for turbulence in (1.5, 3.0):
        held = np.log(turbulence)
        fit.loss = lambda p, held=held: free(np.array([p[0], held, p[2]]))
        found, rms = refit(np.array([START[0], held, START[2]]))
        show(f"turbulence weight {turbulence}", np.array([found[0], held, found[2]]), rms)
    # a bound so large that the filter is the Kalman filter of the same weights
    held = np.log(1e12)
    fit.loss = lambda p: free(np.array([p[0], p[1], held]))
    found, rms = refit(np.array([START[0], START[1], held]))
    show("no bound (Kalman)", np.array([found[0], found[1], held]), rms)


if __name__ == "__main__":
    turbulence_models() if sys.argv[1:] == ["turbulence"] else refits()
