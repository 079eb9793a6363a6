"""How well the standard errors of paired differences cover the truth.

    python benchmarks/league_errors.py [--records 300] [--seconds 15]

Random loops of one axis with turbulence, up to four lines and noise. A Kalman filter with the exact
model is compared with one whose lines are off, and with the best integrator, on one series each.
The true difference is that of the exact residuals. The table has the share of records on which the
measured difference is within one and within two standard errors of it.
"""

from __future__ import annotations

import argparse

import numpy as np

import lbt_synth as lbt
from lbt_synth.design import model_integrator
from lbt_synth.identification.prediction.paired_residuals import chunk_squares
from lbt_synth.models.resonance_spectrum import coefficients

RATE = 800.0


def draw_plant(rng, shift_hz: float = 0.0) -> lbt.models.TipTiltPlant:
    corner, rms = np.exp(rng.uniform(np.log(0.3), np.log(3))), rng.uniform(200, 600)
    a1, a2, drive = coefficients(2 * np.pi * corner / RATE, 0.7)
    lines = [
        lbt.Vibration(
            frequency_hz=rng.uniform(8, 90) + shift_hz,
            damping=float(np.exp(rng.uniform(np.log(0.002), np.log(0.03)))),
            rms_nm=rng.uniform(10, 100),
            direction=(1.0,),
        )
        for _ in range(int(rng.integers(1, 5)))
    ]
    return lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=lbt.models.ARModel(
            coefficients=[a1, a2], driving_rms_nm=rms * np.sqrt(drive), frame_rate_hz=RATE
        ),
        vibrations=lines,
        noise_nm=float(np.exp(rng.uniform(np.log(3), np.log(25)))),
        modes=1,
    )


def deviations(seed: int, frames: int) -> dict[str, float]:
    """Return how many standard errors two measured differences are from the truth."""
    plant = draw_plant(np.random.default_rng([3, seed]))
    wrong = draw_plant(np.random.default_rng([3, seed]), shift_hz=0.5)
    truth = lbt.Truth(
        turbulence=plant.turbulence[0],
        vibrations=plant.vibrations,
        noise_nm=float(np.sqrt(plant.R[0, 0])),
    )
    designs = {
        "exact": lbt.kalman(plant),
        "lines 0.5 Hz off": lbt.kalman(wrong),
        "integrator": model_integrator(plant),
    }
    chunks, exact = {}, {}
    for name, design in designs.items():
        run = lbt.simulate(
            design.controller, truth, hardware=plant.hardware, frames=frames, seed=seed,
            settle_frames=8000,
        )  # fmt: skip
        chunks[name] = chunk_squares(run.measurements[0], RATE)
        loop = lbt.close_loop(plant.hardware, design.controller)
        exact[name] = lbt.residual_budget(loop, truth).rms_nm ** 2
    pair = lbt.identification.PairedResiduals(squares_nm2=chunks)
    found = {}
    for name in ("lines 0.5 Hz off", "integrator"):
        difference, error = pair.above(name, "exact")
        found[name] = (difference - exact[name] + exact["exact"]) / error
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--records", type=int, default=300)
    parser.add_argument("--seconds", type=float, default=15)
    given = parser.parse_args()
    every = [deviations(seed, round(given.seconds * RATE)) for seed in range(given.records)]
    for name in every[0]:
        size = np.abs([each[name] for each in every])
        print(
            f"exact against {name:18s} within 1 error {100 * np.mean(size < 1):.0f} %, "
            f"within 2 {100 * np.mean(size < 2):.0f} %; rms {np.sqrt(np.mean(size**2)):.2f}"
        )


if __name__ == "__main__":
    main()
