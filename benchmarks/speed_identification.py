"""Processor time of identification, and how it grows with frames and lines.

    python benchmarks/speed_identification.py [--auto]

Two axes at 1 kHz, each with lines of 5 to 100 nm rms, 5 to 150 Hz and damping 0.002 to 0.01, and
wide resonances of 20 to 80 nm, 15 to 200 Hz and damping 0.1 to 0.4, in frozen flow. Each time is
the median of three records. The last column says how many densities of a spectrum the fits
evaluated, and how much of the time that took. ``--auto`` designs from records, too: from one of
these, and from hard ones of 20 s at 1054 Hz under an integrator that hardly acts, with twelve
lines, three wide resonances and a drift of first order.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace
from unittest import mock

import numpy as np
from harness import Row, log_uniform, random_line, run_integrator, with_growth

import lbt_synth as lbt
from lbt_synth.identification.fit import whittle

RATE = 1000.0
SEEDS = (2, 3, 4)
SECONDS = (15, 60, 240, 600)
LINES = (1, 2, 4, 8)


def record(
    seed: int, *, seconds: int = 60, lines: int = 5, wide: int = 2
) -> lbt.identification.LoopRecord:
    """Draw a loop and run it."""
    rng = np.random.default_rng([seed, 77])
    found = []
    for direction in ((1.0, 0.0), (0.0, 1.0)):
        for place, damping, rms, count in (
            ((5, 150), (0.002, 0.01), (5, 100), lines),
            ((15, 200), (0.1, 0.4), (20, 80), wide),
        ):
            found += [
                random_line(rng, direction, hz=place, damping=damping, rms_nm=rms)
                for _ in range(count)
            ]
    air = lbt.Atmosphere(
        seeing_arcsec=float(rng.uniform(0.5, 1.5)),
        outer_scale_m=22,
        wind_speed_m_s=float(rng.uniform(5, 25)),
        diameter_m=8.22,
    )
    truth = lbt.Truth(
        turbulence=air,
        vibrations=tuple(found),
        noise_nm=log_uniform(rng, 2, 30),
        sensor_gain=float(rng.uniform(0.4, 1)),
    )
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=2)
    gain = float(rng.uniform(0.2, 0.5))
    return run_integrator(path, truth, gain, seconds * int(RATE), seed=seed)[0]


def hard_record(seed: int) -> tuple[lbt.identification.LoopRecord, lbt.Truth]:
    """Return a record that leaves its sensor gain nearly open, and its truth."""
    rng = np.random.default_rng([seed, 991])
    lines = [
        random_line(rng, direction, hz=place, damping=damping, rms_nm=rms)
        for direction, count, place, damping, rms in (
            ((1.0, 0.0), 6, (8, 160), (0.002, 0.01), (5, 60)),
            ((0.0, 1.0), 6, (8, 160), (0.002, 0.01), (5, 60)),
            ((1.0, 0.0), 1, (20, 200), (0.1, 0.4), (20, 80)),
            ((0.0, 1.0), 1, (20, 200), (0.1, 0.4), (20, 80)),
            ((0.6, 0.8), 1, (20, 200), (0.1, 0.4), (20, 80)),
        )
        for _ in range(count)
    ]
    rate = 1054.0
    air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=12, diameter_m=8.22)
    drift = lbt.models.ARModel(coefficients=[0.9998], driving_rms_nm=3.0, frame_rate_hz=rate)
    truth = lbt.Truth(
        turbulence=lbt.models.SumSpectrum(parts=[air, drift]),
        vibrations=tuple(lines),
        noise_nm=10.0,
        sensor_gain=0.7,
    )
    path = lbt.LoopHardware(frame_rate_hz=rate, delay_frames=2)
    record, _ = run_integrator(path, truth, 0.08, int(20 * rate), seed=seed)
    return record, truth


def design_hard(seed: int) -> None:
    """Design from a hard record, and print the time and what the design leaves of the truth."""
    given, truth = hard_record(seed)
    begin = time.process_time()
    made = lbt.design_from_record(given)
    seconds = time.process_time() - begin
    path = lbt.LoopHardware(
        frame_rate_hz=given.frame_rate_hz, delay_frames=2, sensor_matrix=0.7 * np.eye(2)
    )
    # the noise of the truth is that of the measurements, whose gain the path has here
    same = replace(truth, sensor_gain=1.0)
    left = []
    for controller in (made.design.controller, lbt.kalman(made.model.plant()).controller):
        loop = lbt.close_loop(path, controller)
        left.append(lbt.residual_budget(loop, same).rms_nm if loop.is_stable else float("inf"))
    gains = " and ".join(
        f"{axis.sensor_gain:.3f} +- {axis.sensor_gain_error:.3f}" for axis in made.model.axes
    )
    print(
        f"auto, hard record {seed}: {seconds:.1f} s, {made.name}, gain {gains} (0.7), leaves "
        f"{left[0]:.1f} nm, the Kalman filter of its model alone {left[1]:.1f} nm"
    )


def identify(**options: int) -> Row:
    """Return the median time of records of a kind, and what the densities took of it."""
    times, inside, evaluations = [], 0.0, 0
    density = whittle.densities

    def timed(*arguments: object) -> object:
        nonlocal inside, evaluations
        begin = time.process_time()
        out = density(*arguments)  # type: ignore[arg-type]
        inside += time.process_time() - begin
        evaluations += 1
        return out

    for seed in SEEDS:
        given = record(seed, **options)
        begin = time.process_time()
        with mock.patch.object(whittle, "densities", timed):
            lbt.identify(given)
        times.append(time.process_time() - begin)
    return {
        "ours_s": statistics.median(times),
        "evaluations": evaluations // len(SEEDS),
        "share": inside / sum(times),
    }


def by_seconds() -> dict[int, Row]:
    """Return the rows of records of several lengths."""
    return with_growth({seconds: identify(seconds=seconds) for seconds in SECONDS})


def by_lines() -> dict[int, Row]:
    """Return the rows of records of several numbers of lines, without wide resonances."""
    return with_growth({lines: identify(lines=lines, wide=0) for lines in LINES})


IDENTIFICATION = (
    ("identification of two axes, 5 lines and 2 wide resonances each", "seconds", by_seconds),
    ("the same of a minute, without wide resonances", "lines", by_lines),
)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--auto", action="store_true")
    given = parser.parse_args()
    lbt.identify(record(0, seconds=10, lines=1, wide=0))  # imports
    for title, first, case in IDENTIFICATION:
        print(title)
        for size, row in case().items():
            growth = f", grows with power {row['growth']:.2f}" if "growth" in row else ""
            print(
                f"  {size:4d} {first}: {row['ours_s']:.2f} s, {row['evaluations']} densities take "
                f"{100 * row['share']:.0f} %{growth}"
            )
    if given.auto:
        begin = time.process_time()
        lbt.design_from_record(record(SEEDS[0]))
        print(f"auto: {time.process_time() - begin:.2f} s")
        for seed in SEEDS:
            design_hard(seed)


if __name__ == "__main__":
    main()
