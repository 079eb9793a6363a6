"""Sensor gains that move: what is proved for the example designs, and a filter that follows.

Prints the tables of docs/moving_gain.md: ``python benchmarks/moving_gain.py`` (two minutes).
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import lbt_synth as lbt

EXAMPLES = Path(__file__).parents[1] / "examples"
DESIGNS = (  # file, method, and a line that is written into the section of the method
    ("lbt.yaml", "integrator", ""),
    ("lbt.yaml", "kalman", ""),
    ("lbt.yaml", "hinf", ""),
    ("lbt_robust.yaml", "robust", ""),
    ("lbt_robust.yaml", "robust", "moving_gain: true"),
    ("lbt_slow_mirror.yaml", "lqg", ""),
)
LOW, HIGH, SECONDS, SETTLE = 0.35, 0.8, 60, 2000


def interval(moving: lbt.loop.MovingGain, kind: str) -> str:
    """Return an interval, or a dash."""
    low, high = (getattr(moving, f"{kind}_{end}") for end in ("low", "high"))
    return "-" if low is None or np.isnan(low) else f"{low:.3f} to {high:.3f}"


def gap(moving: lbt.loop.MovingGain) -> str:
    """Return how much wider than the proved interval the destabilised one is, as a ratio."""
    if moving.broken_low is None or moving.broken_high is None:
        return "-"
    broken = moving.broken_high / moving.broken_low
    return f"{100 * (broken / (moving.fast_high / moving.fast_low) - 1):.0f} %"


def print_intervals() -> None:
    """Print the intervals of the example designs."""
    print("| design | constant | by 1 per second | any speed | destabilised in | gap |", end="")
    print(" residual [nm] | time [s] |\n|---|---:|---:|---:|---:|---:|---:|---:|")
    for file, method, line in DESIGNS:
        text = (EXAMPLES / file).read_text()
        if line:
            text = text.replace("    modulus_margin:", f"    {line}\n    modulus_margin:")
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / file
            place.write_text(text)
            config = lbt.load_config(place)
        design = config.design(method)
        loop = lbt.close_loop(config.hardware, design)
        residual = lbt.residual_budget(loop, config.truth).rms_nm
        start = time.process_time()
        moving = lbt.loop.moving_gain(loop)
        seconds = time.process_time() - start
        name = f"`{method}` of `{file}`" + f", `{line}`" * bool(line)
        frames = f" ({moving.broken_frames} frames)" if moving.broken_frames else ""
        cells = [interval(moving, kind) for kind in ("constant", "slow", "fast", "broken")]
        cells += [gap(moving), f"{residual:.1f}", f"{seconds:.2f}"]
        cells[3] += frames
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def print_following() -> None:
    """Print the residuals of fixed filters and of one that follows a gain that rises."""
    config = lbt.load_config(EXAMPLES / "lbt.yaml")
    plant, rate = config.plant, config.hardware.frame_rate_hz
    frames = int(SECONDS * rate)
    course = np.concatenate([np.full(SETTLE, LOW), np.linspace(LOW, HIGH, frames)])
    grid = np.geomspace(LOW, HIGH, 5)
    follower = lbt.design.scheduled_filter(plant, gains=grid, gain_error=0.3)
    runs = {f"fixed, for a gain of {g:g}": follower.controller_at(g) for g in (0.35, 0.53, 0.8)}
    runs["fixed, for a gain of 1"] = config.design("kalman").controller
    for error in (0.0, 0.1, -0.1, 0.3, -0.3):
        known = np.clip(course / (1 + error), LOW, HIGH)
        name = "follows the gain" if error == 0 else f"follows, real gain {100 * error:+.0f} %"
        runs[name] = follower.start(known)
    own = lbt.Truth(
        turbulence=plant.turbulence[0],
        vibrations=plant.vibrations,
        noise_nm=config.truth.noise_nm,
    )
    print(
        "\n| filter | first 10 s | last 10 s | whole minute | the same in its model: first |",
        end="",
    )
    print(" last | whole |\n|---|---:|---:|---:|---:|---:|---:|")
    for name, controller in runs.items():
        cells = []
        for truth in (config.truth, own):
            with np.errstate(over="ignore"):
                run = lbt.simulate(
                    controller,
                    truth,
                    hardware=config.hardware,
                    frames=frames,
                    settle_frames=SETTLE,
                    sensor_gains=course,
                )
                part = int(10 * rate)
                for piece in (slice(part), slice(-part, None), slice(None)):
                    rms_nm = replace(run, residual_nm=run.residual_nm[:, piece]).rms_nm[0]
                    cells.append(f"{rms_nm:.1f}" if rms_nm < 1e5 else "unstable")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    print_intervals()
    print_following()
