"""What an accelerometer buys: one line at 20 Hz, a star whose noise is five times that of the LBT.

Run ``python benchmarks/several_sensors_value.py``. It prints, over the seeing, the exact residual
of tip with the Kalman filter of the wavefront alone and with an accelerometer whose noise is a
tenth of what the line moves, and the same of a simulation; the least residual of any controller
where there is no line; and the ratio of acceleration and noise at which the residual is halved.
Then the same over the damping of the line.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

import lbt_synth as lbt

CONFIG = """\
version: 1
telescope: {{diameter_m: 8.22, obstruction: 0.11}}
{air}
loop: {{frame_rate_hz: 800, delay_frames: 2}}
sensor: {{noise_nm: 77.5}}
sensors:
  mirror:
    {{kind: accelerometer, rate_hz: 800, delay_frames: 1, channels: [m1], noise_m_s2: {noise}}}
model:
  turbulence: {turbulence}
  vibrations:
    - {{axis: tip, frequency_hz: 20, damping: {damping}, rms_nm: 563.6,
       accelerometers: {{m1: {{motion_nm_per_nm: 1.0}}}}}}
truth: {{vibrations: model{truth}}}
"""
ATMOSPHERE = "atmosphere: {{seeing_arcsec: {}, outer_scale_m: 22, wind_speed_m_s: {}}}"
AIR = {
    f"{seeing} arcsec, {wind} m/s": (ATMOSPHERE.format(seeing, wind), "{kind: ar2}", "")
    for seeing, wind in ((0.4, 5), (0.6, 10), (0.8, 20))
} | {"none": ("", "{kind: ar, coefficients: [0.99], driving_rms_nm: 0.001}", ", turbulence: none")}
ACCELERATION = 8.9e-3  # of the line [m/s^2 rms]
DAMPING, DAMPINGS = 0.01, (0.003, 0.01, 0.02, 0.03, 0.1)
FRAMES, CASES = 20_000, 4


def load(air: str, ratio: float, damping: float) -> lbt.config.Config:
    """Return the loop in some air, with an accelerometer of a signal-to-noise ratio."""
    atmosphere, turbulence, truth = AIR[air]
    parts = {"air": atmosphere, "turbulence": turbulence, "truth": truth}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "loop.yaml"
        path.write_text(CONFIG.format(noise=ACCELERATION / ratio, damping=damping, **parts))
        return lbt.load_config(path)


def tip_nm(config: lbt.config.Config, loop: lbt.loop.ClosedLoop) -> float:
    """Return what a loop leaves of tip."""
    return float(np.sqrt(lbt.residual_budget(loop, config.truth, frame_means=True).total_nm2[0, 0]))


def both_tip_nm(air: str, ratio: float, damping: float) -> float:
    """Return what the Kalman filter of both sensors leaves of tip."""
    config = load(air, ratio, damping)
    plant = config.plant
    controller = plant.controller(lbt.linear.kalman_riccati(plant).gain_predictor)
    return tip_nm(config, lbt.close_loop(config.hardware, controller))


def halving_excess(ratio: float, *, air: str, damping: float, half_nm: float) -> float:
    """Return by how much a filter of both sensors misses half of the residual of one."""
    return both_tip_nm(air, ratio, damping) - half_nm


def main() -> int:
    """Print the tables."""
    print_table("air", [(air, air, DAMPING) for air in AIR])
    print_table("damping", [(str(damping), "0.6 arcsec, 10 m/s", damping) for damping in DAMPINGS])
    return 0


def print_table(what: str, cases: list[tuple[str, str, float]]) -> None:
    """Print what both sensors leave in some cases: name, air, damping."""
    print(
        f"| {what} | own sensor [nm] | of it the line | with accelerometer | of it the line ",
        end="",
    )
    print("| of it the line | ratio | in a run | no line, least | halved at |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name, air, damping in cases:
        config = load(air, 10, damping)
        alone = config.plant.own_sensor_alone()
        design = config.design("kalman")
        loops = [lbt.close_loop(config.hardware, each) for each in (lbt.kalman(alone), design)]
        own, both = (tip_nm(config, loop) for loop in loops)
        lines = [
            lbt.residual_budget(loop, config.truth, frame_means=True).vibration_nm for loop in loops
        ]
        run = lbt.simulate(
            design,
            config.truth,
            hardware=config.hardware,
            frames=FRAMES,
            cases=CASES,
            settle_frames=1000,
            frame_means=True,
        )
        simulated = float(np.sqrt(np.mean(run.residual_nm[:, :, 0] ** 2)))
        calm = replace(config.truth, vibrations=(), motions=())
        least = np.sqrt(
            lbt.loop.least_residual(alone.hardware, calm, frame_means=True).variance_nm2[0]
        )
        excess = partial(halving_excess, air=air, damping=damping, half_nm=own / 2)
        halved = brentq(excess, 2, 100, xtol=0.01)
        print(
            f"| {name} | {own:.1f} | {lines[0]:.1f} | {both:.1f} | {lines[1]:.1f} "
            f"| {both / own:.2f} | {simulated:.1f} | {least:.1f} | {halved:.1f} |"
        )


if __name__ == "__main__":
    sys.exit(main())
