"""The method ``predictor`` on telescope structures, beside what is plain to write.

    python benchmarks/structures.py [--first 100] [--records 40] [--jobs 1] [--json]

Each seed of tests/support/structures.py draws a structure of 6 to 20 modes, seen by 3 to 12
accelerometers. ``lbt.design_from_record`` has the first half of 40 s, with the accelerometers and
without; what a design leaves of the phase on the second half counts. The rivals are fitted to the
same first half: least squares of 32 and of 64 past values, ridge regression of 32 past values and
24 readings of each channel with the best of four penalties in hindsight; and the best integrator of
each axis in hindsight. A claim is the residual on unseen frames that comes with the design.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from harness import lagged, least_squares, record_options, run_all, write_figures

import lbt_synth as lbt
from lbt_synth.identification.prediction.residual import replay
from lbt_synth.loop import close_loop

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from support.structures import Structure, structure

GAINS = np.linspace(0.05, 0.9, 35)  # of the integrators
PENALTIES = (1e-6, 1e-5, 1e-4, 1e-3)  # of the ridge, a share of the frames, unit variances
TAPS = (0.0, 1.0)  # of the mirror: a delay of two frames
DELAY_ERROR = 0.1  # frames
PREDICTOR = "least-squares predictor"


def left_nm2(seen: Structure, correction: np.ndarray) -> np.ndarray:
    """Return the variance of each axis that a correction leaves on the second half [nm^2]."""
    half = len(seen.phase) // 2
    return np.mean((seen.phase - correction)[half:] ** 2, axis=0)


def best_integrator(seen: Structure) -> float:
    """Return what the best integrators in hindsight leave [nm^2]."""
    path, z = lbt.LoopHardware(frame_rate_hz=seen.frame_rate_hz), seen.pseudo_open_loop
    rows = []
    for gain in GAINS:
        loop = close_loop(path, lbt.integrator(path, gain=gain).controller)
        if loop.is_stable:
            rows.append(left_nm2(seen, z - replay(loop, z, ((0, len(z)),))))
    return float(np.sum(np.min(rows, axis=0)))


def best_ridge(seen: Structure) -> float:
    """Return what ridge regression with channels leaves at its best penalty [nm^2]."""
    z, half = seen.pseudo_open_loop, len(seen.phase) // 2
    series = [np.vstack([np.zeros((2, x.shape[1])), x[:-2]]) for x in (z, seen.readings)]
    rows = np.hstack([lagged(series[0], 32), lagged(series[1], 24)])
    rows /= np.std(rows[:half], axis=0)
    squares, products = rows[64:half].T @ rows[64:half], rows[64:half].T @ z[64:half]
    eye = half * np.eye(len(squares))
    fits = [np.linalg.solve(squares + penalty * eye, products) for penalty in PENALTIES]
    return min(float(np.sum(left_nm2(seen, rows @ fit))) for fit in fits)


def judged(seen: Structure, *, channels: bool) -> dict[str, Any]:
    """Return what a design of the first half leaves, claims and stands."""
    half, z = len(seen.phase) // 2, seen.pseudo_open_loop
    readings = seen.readings if channels else np.zeros((len(z), 0))
    accelerations = readings[:half] if channels else None
    begin = time.process_time()
    made = lbt.design_from_record(
        seen.record(0, half), sensor_gain=1.0, accelerations=accelerations
    )
    took, design = time.process_time() - begin, made.design
    loop = design.close(made.model.hardware)

    def variance(readings: np.ndarray) -> float:
        return float(np.sum(left_nm2(seen, z - replay(loop, z, ((0, len(z)),), readings))))

    loops = [
        close_loop(replace(design.hardware, delay_frames=2 + error), controller)
        for controller in design.controllers.values()
        for error in (-DELAY_ERROR, 0.0, DELAY_ERROR)
    ]
    alive = 1 - np.eye(readings.shape[1] if design.other_sensors else 0)
    claim = design.claims.get("residual_nm", made.held_out[made.name].replayed_nm)
    return {
        "variance": variance(readings),
        "method": made.name,
        "claim": float(claim / np.sqrt(variance(readings))),
        "stable": all(loop.is_stable for loop in loops),
        "dead": max((variance(readings * row) for row in alive), default=variance(readings)),
        "seconds": took,
    }


def measured(seed: int) -> dict[str, Any]:
    """Return everything that counts of one structure."""
    seen = structure(seed)
    z, half = seen.pseudo_open_loop, len(seen.phase) // 2
    rivals = {}
    for count in (32, 64):
        correction = z - least_squares(z, TAPS, count, [(0, half)])
        rivals[f"least squares, {count} values"] = float(np.sum(left_nm2(seen, correction)))
    rivals |= {"best integrator": best_integrator(seen), "ridge with channels": best_ridge(seen)}
    ours = {name: judged(seen, channels=on) for name, on in (("alone", False), ("channels", True))}
    return {"seed": seed, **ours, "rivals": rivals}


def table(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return and print ratios of variances, claims, stability and times."""
    figures: dict[str, Any] = {"structures": len(rows)}
    for name in ("alone", "channels"):
        made = [row[name] for row in rows]
        for rival in rows[0]["rivals"]:
            ratios = [row[name]["variance"] / row["rivals"][rival] for row in rows]
            ratio = {"median": np.median(ratios), "worst": max(ratios)}
            figures[f"{name} / {rival}"] = {key: round(float(x), 3) for key, x in ratio.items()}
        figures |= {
            f"{name}: claims within 10 %": sum(abs(one["claim"] - 1) < 0.1 for one in made),
            f"{name}: stable, delay off by 0.1 frames": sum(one["stable"] for one in made),
            f"{name}: the predictor is chosen": sum(one["method"] == PREDICTOR for one in made),
            f"{name}: processor time, largest [s]": round(max(one["seconds"] for one in made), 1),
        }
    dead = [row["channels"]["dead"] / row["rivals"]["best integrator"] for row in rows]
    figures["worst dead channel / best integrator"] = round(max(dead), 3)
    for key, figure in figures.items():
        print(f"{key:55s} {figure}")
    return figures


if __name__ == "__main__":
    asked = record_options(__doc__, first=100, records=40)
    figures = table(run_all(measured, asked))
    if asked.json:
        write_figures("structures", figures)
