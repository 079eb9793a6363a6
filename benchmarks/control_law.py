"""The control law of random loops, whose commands are changed in a known way.

python benchmarks/control_law.py [loops]
"""

from __future__ import annotations

import sys
import time
from collections import Counter, defaultdict

import numpy as np

import lbt_synth as lbt
from lbt_synth.identification import fit_control_law
from lbt_synth.models.resonance_spectrum import coefficients

COS, SIN = np.cos(np.radians(30)), np.sin(np.radians(30))
ROTATION = np.array([[COS, -SIN], [SIN, COS]])
GOOD = ("integrator", 0, "diagonal", (1, 1))
EXPECTED = {
    "as given": GOOD,
    "opposite sign": ("integrator", 0, "diagonal", (-1, -1)),
    "swapped axes": ("integrator", 0, "swapped", (1, 1)),
    "rotated by 30 degrees": ("integrator", 0, "general", (0, 0)),
    "1000 times too large": GOOD,
    "half": GOOD,
    "2 frames early": ("integrator", -2, "diagonal", (1, 1)),
    "1 frame early": ("integrator", -1, "diagonal", (1, 1)),
    "1 frame late": ("integrator", 1, "diagonal", (1, 1)),
    "2 frames late": ("integrator", 2, "diagonal", (1, 1)),
    "increments": ("proportional", 0, "diagonal", (1, 1)),
    "another night": ("none",),
    "clipped, 10 % of the frames": GOOD,
    "rounded to 1/3 of the increments": GOOD,
}


def random_loop(seed):
    """Return the measurements of a loop, its commands, and those of another night."""
    rng = np.random.default_rng(seed)
    rate = float(rng.choice([500, 1000, 2000]))
    path = lbt.LoopHardware(frame_rate_hz=rate, delay_frames=float(rng.choice([1, 1.5, 2, 2.4, 3])))
    a1, a2, drive = coefficients(2 * np.pi * rng.uniform(0.3, 3) / rate, rng.uniform(0.3, 0.9))
    air = lbt.models.ARModel(
        coefficients=[a1, a2],
        driving_rms_nm=rng.uniform(100, 800) * np.sqrt(drive),
        frame_rate_hz=rate,
    )
    lines = []
    for _ in range(rng.integers(0, 6)):
        angle = rng.uniform(0, np.pi)
        lines.append(
            lbt.Vibration(
                frequency_hz=rng.uniform(8, 0.4 * rate),
                damping=10 ** rng.uniform(-3.5, -1),
                rms_nm=10 ** rng.uniform(0.5, 2.5),
                direction=(np.cos(angle), np.sin(angle)),
            )
        )
    truth = lbt.Truth(
        turbulence=air,
        vibrations=tuple(lines),
        noise_nm=10 ** rng.uniform(-0.5, 1.8),
        sensor_gain=rng.uniform(0.3, 1.2),
    )
    gain, frames = rng.uniform(0.05, 0.5), int(rng.choice([4000, 10_000, 30_000]))
    while not lbt.close_loop(
        path, lbt.integrator(path, gain=gain).controller, sensor_gain=truth.sensor_gain
    ).is_stable:
        gain /= 2
    controller = lbt.integrator(path, gain=gain).controller
    nights = [
        lbt.simulate(controller, truth, hardware=path, frames=frames, seed=each)
        for each in (seed, seed + 10_000)
    ]
    return nights[0].measurements[0], nights[0].commands[0], nights[1].commands[0]


def changed_commands(u, other):
    """Return commands by what was done to them."""
    limit = np.percentile(np.abs(u), 90)
    step = np.std(np.diff(u, axis=0)) / 3
    return {
        "as given": u,
        "opposite sign": -u,
        "swapped axes": u[:, ::-1],
        "rotated by 30 degrees": u @ ROTATION.T,
        "1000 times too large": 1000 * u,
        "half": u / 2,
        "2 frames early": np.roll(u, -2, axis=0),
        "1 frame early": np.roll(u, -1, axis=0),
        "1 frame late": np.roll(u, 1, axis=0),
        "2 frames late": np.roll(u, 2, axis=0),
        "increments": np.diff(u, axis=0, prepend=u[:1]),
        "another night": other,
        "clipped, 10 % of the frames": np.clip(u, -limit, limit),
        "rounded to 1/3 of the increments": step * np.round(u / step),
    }


def main(loops: int) -> None:
    right: Counter[str] = Counter()
    times = defaultdict(list)
    for seed in range(loops):
        y, u, other = random_loop(seed)
        for name, commands in changed_commands(u, other).items():
            start = time.perf_counter()
            law = fit_control_law(y, commands)
            times[name].append(time.perf_counter() - start)
            found = (law.kind, law.lag_frames, law.axes_kind, law.signs)
            right[name] += found[: len(EXPECTED[name])] == EXPECTED[name]
    print("| commands | law as expected | time, median [s] |\n|---|---|---|")
    for name in EXPECTED:
        print(f"| {name} | {right[name]} of {loops} | {np.median(times[name]):.3f} |")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
