"""What an accelerometer buys: one line at 20 Hz, a star whose noise is five times that of the LBT.

Run ``python benchmarks/several_sensors_value.py``. It prints, over the seeing, the exact residual
of tip with the Kalman filter of the wavefront alone and with an accelerometer whose noise is a
tenth of what the line moves, and the same of a simulation.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

import lbt_synth as lbt
from lbt_synth.loop.fusion.simulation import simulate_fused

CONFIG = """\
version: 1
telescope: {{diameter_m: 8.22, obstruction: 0.11}}
atmosphere: {{seeing_arcsec: {seeing}, outer_scale_m: 22, wind_speed_m_s: {wind}}}
loop: {{frame_rate_hz: 800, delay_frames: 2}}
sensor: {{noise_nm: 77.5}}
sensors:
  mirror:
    {{kind: accelerometer, rate_hz: 800, delay_frames: 1, channels: [m1], noise_m_s2: 8.9e-4}}
model:
  turbulence: {{kind: ar2}}
  vibrations:
    - {{axis: tip, frequency_hz: 20, damping: 0.01, rms_nm: 563.6,
       accelerometers: {{m1: {{motion_nm_per_nm: 1.0}}}}}}
truth: {{vibrations: model}}
"""
AIR = ((0.4, 5), (0.6, 10), (0.8, 20))  # seeing [arcsec], wind [m/s]
FRAMES, CASES = 20_000, 4


def main() -> int:
    """Print the table."""
    print("| air | own sensor [nm] | of it the line ", end="")
    print("| with accelerometer | of it the line | ratio | in a run |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for seeing, wind in AIR:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "loop.yaml"
            path.write_text(CONFIG.format(seeing=seeing, wind=wind))
            config = lbt.load_config(path)
        fused = config.design("kalman")
        plain = lbt.kalman(config.plant)
        own = lbt.residual_budget(lbt.close_loop(config.hardware, plain), config.truth)
        both = lbt.residual_budget(fused.loop(), config.truth)
        run = simulate_fused(
            fused.controllers,
            fused.problem.suite,
            config.truth,
            hardware=config.hardware,
            frames=FRAMES,
            cases=CASES,
        )
        simulated = float(np.sqrt(np.mean(run.residual_nm[:, :, 0] ** 2)))
        left = [np.sqrt(budget.total_nm2[0, 0]) for budget in (own, both)]
        print(
            f"| {seeing} arcsec, {wind} m/s | {left[0]:.1f} | {own.vibration_nm:.1f} "
            f"| {left[1]:.1f} | {both.vibration_nm:.1f} | {left[1] / left[0]:.2f} "
            f"| {simulated:.1f} |"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
