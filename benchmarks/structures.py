"""The method ``predictor`` on telescope structures, beside what is plain to write.

    python benchmarks/structures.py [--first 100] [--records 40] [--jobs 1] [--json]

Each structure of tests/support/structures.py has 6 to 20 modes and 3 to 12 accelerometers. Designs
of the first 20 s, with accelerometers and without, are judged by the variance of the phase that
they leave on the next 20 s, beside rivals of the same 20 s: least squares of 32 and of 64 past
values; ridge regression of 32 past values and 24 readings of each channel, with the best of four
penalties in hindsight; and the best integrator of each axis in hindsight.
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
KINDS = ("alone", "channels")
TAPS = (0.0, 1.0)  # of the mirror: a delay of two frames


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
    record = seen.record(0, half)
    made = lbt.design_from_record(record, sensor_gain=1.0, accelerations=accelerations)
    took, design = time.process_time() - begin, made.design
    loop = design.close(made.model.hardware)

    def variance(readings: np.ndarray) -> float:
        return float(np.sum(left_nm2(seen, z - replay(loop, z, ((0, len(z)),), readings))))

    paths = [replace(design.hardware, delay_frames=delay) for delay in (1.9, 2.0, 2.1)]
    stable = [  # with all sensors, then with the fall-back
        all(close_loop(path, controller).is_stable for path in paths)
        for controller in design.controllers.values()
    ]
    claim = design.claims.get("residual_nm", made.held_out[made.name].replayed_nm)
    return {
        "variance": variance(readings),
        "claim": float(claim / np.sqrt(variance(readings))),
        "stable": stable[0],
        "fallback": stable[-1],
        "dead": max([variance(readings * alive) for alive in 1 - np.eye(len(readings.T))] or [0]),
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
    try:
        return {"rivals": rivals} | {on: judged(seen, channels=on == "channels") for on in KINDS}
    except lbt.LbtSynthError as error:
        return {"error": f"structure {seed}: {error}"}


def table(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return and print ratios of variances, claims, stability and times."""
    failed = [row["error"] for row in rows if "error" in row]
    rows = [row for row in rows if "error" not in row]
    figures: dict[str, Any] = {"structures": len(rows), "failed": failed}
    for name in KINDS:
        made = [row[name] for row in rows]
        for rival in rows[0]["rivals"]:
            ratios = [row[name]["variance"] / row["rivals"][rival] for row in rows]
            ratio = {"median": np.median(ratios), "worst": max(ratios)}
            figures[f"{name} / {rival}"] = {key: round(float(x), 3) for key, x in ratio.items()}
        figures |= {
            f"{name}: claims within 10 %": sum(abs(one["claim"] - 1) < 0.1 for one in made),
            f"{name}: stable, delay off by 0.1 frames": sum(one["stable"] for one in made),
            f"{name}: so is the fall-back": sum(one["fallback"] for one in made),
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
