"""The league on simulated records that change: wind, seeing, lines, noise, sensor gain.

    python benchmarks/league.py [--records 12] [--jobs 2] [--seconds 30] -o league_benchmark/

Record k has the change number k modulo 7; 0 is none. Two axes, an integrator runs. The table is
that of ``lbt-synth league``; below it, for each entry, how far it is above the best on each record
(residual with noise, %), and the share of records on which it is within 1 %. It resumes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.models.resonance_spectrum import coefficients
from lbt_synth.storage.rows import row_table
from lbt_synth.studies.league.standings import relative_residual

CHANGES = ("none", "wind", "seeing", "drifting", "dying", "flux", "gain")
DELAY, GAIN = 2, 0.35


def resonance(rng, frames, rate, frequency_hz, damping, rms_nm):
    """A second-order process whose frequency and rms may change from frame to frame, (frames,)."""
    frequency = np.broadcast_to(frequency_hz, frames)
    level = np.broadcast_to(rms_nm, frames)
    if np.ptp(frequency) == 0:
        a1, a2, drive = coefficients(2 * np.pi * frequency[0] / rate, damping)
        more = 20 * round(rate / (2 * np.pi * frequency[0] * damping))
        white = rng.standard_normal(frames + more)
        unit = lfilter([np.sqrt(drive)], [1, -a1, -a2], white)[more:]
        return level * unit
    phase = 2 * np.pi * np.cumsum(frequency) / rate
    width = 2 * np.pi * np.mean(frequency) * damping / rate
    pole, more = np.exp(-width), 20 * round(1 / width)
    white = rng.standard_normal((2, frames + more)) * np.sqrt(1 - pole**2)
    cosine, sine = lfilter([1], [1, -pole], white, axis=1)[:, more:]
    return level * (cosine * np.cos(phase) + sine * np.sin(phase))


def simulate_record(seed: int, seconds: float) -> lbt.identification.LoopRecord:
    """Return a record of two axes with one kind of change."""
    rng = np.random.default_rng([17, seed])
    change = CHANGES[seed % len(CHANGES)]
    rate = float(rng.choice([500, 800, 1000]))
    frames = round(seconds * rate)
    ramp = np.linspace(0, 1, frames)
    gain = np.full(frames, rng.uniform(0.5, 1.0))
    noise = np.full(frames, np.exp(rng.uniform(np.log(3), np.log(25))))
    corner, rms = np.exp(rng.uniform(np.log(0.4), np.log(2))), rng.uniform(200, 600)
    if change == "flux":
        noise = noise * np.exp(rng.uniform(0.5, 1.0) * (2 * ramp - 1))
    if change == "gain":
        gain = gain * (1 + rng.uniform(-0.3, 0.3) * (ramp - 0.5))
    total = np.zeros((frames, 2))
    for axis in range(2):
        level = rms * 2.0 ** (rng.uniform(-1, 1) * (2 * ramp - 1)) if change == "seeing" else rms
        air = resonance(rng, frames, rate, corner, 0.7, level)
        if change == "wind":  # one flow fades into another, twice as fast
            faster = resonance(rng, frames, rate, 2 * corner, 0.7, level)
            air = np.cos(np.pi / 2 * ramp) * air + np.sin(np.pi / 2 * ramp) * faster
        total[:, axis] = lfilter([0.05], [1, -0.95], air)
        for _ in range(int(rng.integers(1, 5))):
            f, damping = (
                rng.uniform(6, 0.12 * rate),
                np.exp(rng.uniform(np.log(0.002), np.log(0.03))),
            )
            size = rng.uniform(10, 120)
            if change == "drifting":
                f = f * (1 + rng.uniform(-0.08, 0.08) * ramp)
            if change == "dying":
                size = size * (
                    1 / (1 + np.exp(rng.choice([-20, 20]) * (ramp - rng.uniform(0.3, 0.9))))
                )
            total[:, axis] += resonance(rng, frames, rate, f, damping, size)
    y, u = np.zeros((frames, 2)), np.zeros((frames, 2))
    w = noise[:, None] * rng.standard_normal((frames, 2))
    for k in range(frames):
        correction = u[k - DELAY] if k >= DELAY else 0
        y[k] = gain[k] * (total[k] - correction) + w[k]
        u[k] = (u[k - 1] if k else 0) + GAIN * y[k]
    return lbt.identification.loop_record(
        y, u, frame_rate_hz=rate, delay_frames=DELAY, unit="nm", source=change
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--records", type=int, default=12)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--entries", nargs="+")
    parser.add_argument("-o", "--output", default="league_benchmark")
    given = parser.parse_args()
    records = {
        f"{seed:02d}-{CHANGES[seed % len(CHANGES)]}": simulate_record(seed, given.seconds)
        for seed in range(given.records)
    }
    found = lbt.studies.run_league(
        records, Path(given.output), entries=given.entries, jobs=given.jobs
    )
    for name, why in found.failures.items():
        print(f"{name}: {why}")
    table = row_table("League", found.standings, without=("note",))
    for row in (table.headings, *table.rows):
        print(f"{row[0]:>4}  {row[1]:30s}", *(f"{cell:>18}" for cell in row[2:]))
    names = [each.name for each in found.records]
    print(f"\n{'above the best [%]':30s}", *(f"{name:>12}" for name in names), "within 1 %")
    for row in found.standings:
        if row.records:
            above = [
                100 * relative_residual(each.total, row.name)[0]
                if row.name in each.total.squares_nm2
                else np.nan
                for each in found.records
            ]
            near = 100 * np.mean([value <= 1 for value in above])
            print(f"{row.entry:30s}", *(f"{value:12.2f}" for value in above), f"{near:8.0f} %")
        if row.note:
            print(f"{row.entry:30s} {row.note}")


if __name__ == "__main__":
    main()
