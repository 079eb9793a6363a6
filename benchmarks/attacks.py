"""Oracles that share nothing with the package, on random loops and systems of several channels.

    python benchmarks/attacks.py [40]

Each loop has a random sensor and mirror, delays of 1 to 3 frames with fractions, turbulence, 1 to
3 resonances and noise; its controller is the Kalman filter of its model.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace

import numpy as np

import lbt_synth as lbt

FRAMES = 300
TRIALS, FINDINGS = Counter[str](), Counter[str]()


def check(what: str, holds: bool, seed: int) -> None:
    """Count a trial, and name the loop of a finding."""
    TRIALS[what] += 1
    if not holds:
        FINDINGS[what] += 1
        print(f"  loop {seed}: {what}", flush=True)


def draw(rng: np.random.Generator) -> tuple[lbt.models.TipTiltPlant, lbt.Truth]:
    """Return a random plant and its truth."""

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    modes, rate = int(rng.integers(1, 3)), log(100, 3000)
    mixed = [np.eye(modes) + 0.2 * rng.integers(2) * rng.standard_normal((modes, modes))] * 2
    air = lbt.models.ARModel(
        coefficients=[1 - log(1e-3, 0.1)], driving_rms_nm=log(1, 100), frame_rate_hz=rate
    )
    lines = []
    for _ in range(rng.integers(1, 4)):
        direction = rng.standard_normal(modes)
        lines.append(
            lbt.Vibration(
                frequency_hz=log(1, 0.4 * rate),
                damping=log(1e-4, 0.1),
                rms_nm=log(1, 500),
                direction=tuple(direction / np.linalg.norm(direction)),
            )
        )
    noise = log(0.1, 100)
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=rate,
        delay_frames=float(rng.choice([1, 2, 3, 1.3, 2.7])),
        turbulence=air,
        vibrations=lines,
        noise_nm=noise,
        sensor_matrix=mixed[0],
        influence_matrix=mixed[1],
        modes=modes,
    )
    return plant, lbt.Truth(turbulence=air, vibrations=tuple(lines), noise_nm=noise)


def frame_by_frame(path: lbt.LoopHardware, own: lbt.Controller, series: np.ndarray) -> np.ndarray:
    """Return the residual of phase and noise (frames, n + q), by the loop's own definition."""
    K, taps, n = own.to_statespace(), path.mirror_taps, path.modes
    state, seen, commands, out = np.zeros(len(K.A)), np.zeros(n), [], []
    for frame in series:
        y = path.sensor @ seen + frame[n:]
        commands.insert(0, K.C @ state + K.D @ y)
        state = K.A @ state + K.B @ y
        moved = sum(tap * u for tap, u in zip(taps, commands, strict=False))
        seen = frame[:n] - path.influence @ moved
        out.append(seen)
    return np.array(out)


def attack(seed: int) -> None:
    """Try everything on one loop."""
    rng = np.random.default_rng([99, seed])
    plant, truth = draw(rng)
    path, design = plant.hardware, lbt.kalman(plant)
    loop = lbt.close_loop(path, design)
    n, q = path.modes, path.n_measurements
    for j in range(n + q):
        series = np.zeros((FRAMES, n + q))
        series[0, j] = 1.0
        state, own = loop.system.B[:, j], [loop.system.D[:n, j]]
        for _ in range(FRAMES - 1):
            own.append(loop.system.C[:n] @ state)
            state = loop.system.A @ state
        mine = frame_by_frame(path, design.controller, series)
        size = max(1.0, float(np.abs(mine).max()))
        check("loop = frames of its definition", np.allclose(own, mine, atol=1e-7 * size), seed)

    def is_stable(gains: np.ndarray) -> bool:
        """Return whether the loop is stable at sensor gains, one a measurement."""
        there = replace(path, sensor_matrix=gains[:, None] * path.sensor)
        return lbt.close_loop(there, design).is_stable

    least = lbt.residual_budget(loop, truth, frame_means=True).rms_nm
    for gain in rng.uniform(0.02, 0.5, 3):
        other = lbt.close_loop(path, lbt.integrator(path, gain=float(gain)))
        if other.is_stable and path.delay_frames % 1 == 0:
            more = lbt.residual_budget(other, truth, frame_means=True).rms_nm >= least * (1 - 1e-7)
            check("no integrator beats the Kalman filter", more, seed)
    margins = lbt.loop_margins(loop)
    for _ in range(5):
        part = rng.uniform(-0.499, 0.499, q) * margins.disk
        if np.all(np.abs(part) < 1):
            held = is_stable((1 + part) / (1 - part))
            check("stable within the disk margin of each axis", held, seed)
    for factor, stable in ((0.999, True), (1.01, False)):
        if margins.gain_high < 1e3:
            found = is_stable(np.full(q, factor * margins.gain_high))
            check("gain margin", found == stable, seed)


if __name__ == "__main__":
    for number in range(int(sys.argv[1]) if len(sys.argv) > 1 else 40):
        attack(number)
    for name, count in TRIALS.items():
        print(f"{name}: {count} trials, {FINDINGS[name]} findings")
