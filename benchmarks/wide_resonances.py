"""Loops under wide resonances: is the sensor gain found?

    python benchmarks/wide_resonances.py [--records 24] [--first 0] [--seconds 30]

Loops of two axes at 500 or 1000 Hz with a delay of 2 frames, an integrator of gain 0.2 to 0.6,
sensor gain 0.4 to 1, noise 2 to 25 nm, frozen flow, 1 to 5 lines as in wrong_commands.py and two
resonances of damping 0.05 to 0.2.
"""

from __future__ import annotations

import time

import numpy as np
from harness import frozen_flow, log_uniform, record_options, run_integrator
from wrong_commands import draw_lines

import lbt_synth as lbt


def draw(seed: int, seconds: float) -> tuple[lbt.identification.LoopRecord, lbt.Truth]:
    """Draw a loop, and record it."""
    rng = np.random.default_rng([seed, 771])
    rate = float(rng.choice([500.0, 1000.0]))
    noise = log_uniform(rng, 2, 25)
    sensor, gain = float(rng.uniform(0.4, 1.0)), float(rng.uniform(0.2, 0.6))
    lines = list(draw_lines(rng, int(rng.integers(1, 6)), (0.002, 0.01)))
    lines += draw_lines(rng, 2, (0.05, 0.2))
    path = lbt.LoopHardware(frame_rate_hz=rate)
    truth = lbt.Truth(
        turbulence=frozen_flow(rng), vibrations=tuple(lines), noise_nm=noise, sensor_gain=sensor
    )
    frames = int(seconds * rate)
    record, _ = run_integrator(path, truth, gain, frames, seed=seed, settle_frames=500)
    return record, truth


def main() -> None:
    """Print a line per record, and the summary."""
    given = record_options(__doc__, records=24, seconds=30.0)
    deviations = []
    for seed in range(given.first, given.first + given.records):
        record, truth = draw(seed, given.seconds)
        start = time.process_time()
        try:
            model = lbt.identify(record)
        except lbt.errors.LbtSynthError as error:
            print(f"{seed:3d}  refused: {error}", flush=True)
            continue
        seconds = time.process_time() - start
        gain, error = model.sensor_gains[0], model.axes[0].sensor_gain_error
        off = np.nan if error is None else (gain - truth.sensor_gain) / error
        deviations.append(off)
        print(
            f"{seed:3d}  gain {truth.sensor_gain:.3f}  found {gain:.3f}  off by {off:5.1f} errors"
            f"  {seconds:5.1f} s",
            flush=True,
        )
    z = np.array(deviations)
    inside = 100 * np.array([np.nanmean(abs(z) < 1), np.nanmean(abs(z) < 2)])
    print(f"deviations over their errors: rms {np.sqrt(np.nanmean(z**2)):.2f}, largest", end=" ")
    print(f"{np.nanmax(abs(z)):.1f}, within one {inside[0]:.0f} %, within two {inside[1]:.0f} %")


if __name__ == "__main__":
    main()
