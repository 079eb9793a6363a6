"""Time of ``lbt-synth design`` over the number of lines on each axis: ``python many_lines.py``.

A telescope of 6.5 m at 1 kHz and 2.5 frames; all frequencies are different, and so are the axes.
"""

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

COUNTS = (10, 20, 40, 100)
HEAD = """version: 1
telescope: {diameter_m: 6.5}
atmosphere: {seeing_arcsec: 0.8, outer_scale_m: 25.0, wind_speed_m_s: 12.0}
sensor: {noise_nm: 10.0}
loop: {frame_rate_hz: 1000.0, delay_frames: 2.5}
imaging: {wavelength_um: 2.2, other_modes_strehl: 0.85}
model:
  turbulence: {kind: ar1}
  vibrations:
"""


def configuration(count: int) -> str:
    """Return a configuration with so many lines on each axis."""
    rng, lines = np.random.default_rng(1), []
    for axis in ("tip", "tilt"):
        for frequency_hz in np.sort(rng.uniform(8, 400, count)):
            damping, rms_nm = 10 ** rng.uniform(-2.7, -1.3), 10 ** rng.uniform(0.5, 1.8)
            lines.append(
                f"    - {{axis: {axis}, frequency_hz: {frequency_hz:.3f}, damping: {damping:.4f}, "
                f"rms_nm: {rms_nm:.2f}}}"
            )
    return HEAD + "\n".join(lines) + "\n"


def main() -> None:
    """Print the processor time of each design, and how it grows."""
    before = 0.0
    print("| lines per axis | processor time [s] | growth exponent |\n|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        for i, count in enumerate(COUNTS):
            config = Path(folder, f"{count}.yaml")
            config.write_text(configuration(count), encoding="utf-8")
            start = resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [sys.executable, "-m", "lbt_synth", "design", config, "--method", "kalman"]
            output = config.with_suffix(".fits")
            subprocess.run([*command, "-o", output], check=True, capture_output=True)
            end = resource.getrusage(resource.RUSAGE_CHILDREN)
            taken = end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime
            growth = np.log(taken / before) / np.log(count / COUNTS[i - 1]) if before else np.nan
            print(f"| {count} | {taken:.1f} | {'' if np.isnan(growth) else f'{growth:.1f}'} |")
            before = taken


if __name__ == "__main__":
    main()
