"""Rates of studies, their overhead and memory; figures of docs/study.md.

python benchmarks/study_rates.py             # some ten minutes on two quiet processors
python benchmarks/study_rates.py --quick     # a tenth of the samples
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import lbt_synth as lbt

ENVIRONMENT = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
HEAD = f"version: 1\nconfig: {EXAMPLES / 'lbt.yaml'}\nseed: 1\n"
POINTS = """
parameters:
  truth.vibrations[0].frequency_hz: {uniform: [18, 22]}
  truth.sensor_gain: {uniform: [0.4, 1.1]}
  error.delay_frames: {uniform: [0, 0.3]}
"""
ONE = "controllers: {kalman: {file: kalman.fits}}" + POINTS
TOLD = (
    "controllers: {told: {design: kalman, for: sample}}"
    + """
parameters:
  atmosphere.seeing_arcsec: {uniform: [0.5, 1.2]}
  atmosphere.wind_speed_m_s: {uniform: [10, 30]}
  model.vibrations[0].frequency_hz: {uniform: [19, 21]}
  truth.vibrations[0].rms_mas: {uniform: [40, 100], also: ["model.vibrations[0].rms_mas"]}
  truth.sensor_gain: {uniform: [0.4, 1.1]}
"""
)
TWO = """controllers: {kalman: {file: kalman.fits}, hinf: {file: hinf.fits}}
parameters:
  atmosphere.seeing_arcsec: {uniform: [0.5, 1.2]}
  truth.vibrations[0].frequency_hz: {normal: {mean: 20, deviation: 0.5, low: 18, high: 22}}
  truth.vibrations[0].rms_mas: {uniform: [40, 100]}
  truth.sensor_gain: {uniform: [0.4, 1.1]}
  error.delay_frames: {uniform: [0, 0.3]}
  error.noise_factor: {uniform: [0.7, 1.5]}
"""


def proportional_memory(process: int) -> int:
    """Memory of a process and its descendants, shared pages counted once [bytes]."""
    total, waiting = 0, [process]
    while waiting:
        pid = waiting.pop()
        try:
            rollup = Path(f"/proc/{pid}/smaps_rollup").read_text()
            total += int(rollup.split("Pss:")[1].split()[0]) * 1024
            for task in Path(f"/proc/{pid}/task").iterdir():
                waiting += [int(child) for child in (task / "children").read_text().split()]
        except (OSError, IndexError):
            continue  # it has ended
    return total


def run(folder: Path, text: str, samples: int, jobs: int) -> tuple[float, float, int]:
    """Run a study at the command line: wall time, time of its batches [s], memory [bytes]."""
    file = folder / "study.yaml"
    file.write_text(f"{HEAD}samples: {samples}\n{text}")
    with tempfile.TemporaryDirectory(dir=folder) as out:
        command = [sys.executable, "-m", "lbt_synth.cli.main", "study", str(file), "-o", out]
        began, most = time.perf_counter(), 0
        command += ["--jobs", str(jobs), "--json"]
        said = Path(out) / "said.json"
        with (
            said.open("w") as stream,
            subprocess.Popen(command, stdout=stream, env=ENVIRONMENT) as it,
        ):
            while it.poll() is None:
                most = max(most, proportional_memory(it.pid))
                time.sleep(0.5)
        wall = time.perf_counter() - began
        if it.returncode:
            raise SystemExit(f"the study failed: {' '.join(command)}")
        return wall, json.loads(said.read_text())["computing_seconds"], most


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    share = 10 if parser.parse_args().quick else 1
    config = lbt.load_config(EXAMPLES / "lbt.yaml")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lbt.save_gain(folder / "kalman.fits", lbt.kalman(config.plant))
        lbt.save_gain(folder / "hinf.fits", lbt.hinf(config.plant, gamma_ratio=1.2))
        for title, text, samples, controllers in (
            ("frequency x sensor gain x delay of a gain file", ONE, 500_000 // share, 1),
            ("Kalman filters, designed and evaluated", TOLD, 100_000 // share, 1),
            ("two gain files, six parameters", TWO, 1_000_000 // share, 2),
        ):
            print(f"{title}: {samples} samples", flush=True)
            walls = {}
            for jobs in (1, 2):
                wall, computing, memory = run(folder, text, samples, jobs)
                walls[jobs] = wall
                print(
                    f"  {jobs} process{'es' if jobs > 1 else '  '}: {wall:6.1f} s in all, "
                    f"{samples * controllers * jobs / computing:7.0f} evaluations a second in "
                    f"batches, {samples * controllers / wall:7.0f} with start, results and page, "
                    f"{memory / 1e6:.0f} MB",
                    flush=True,
                )
            print(f"  1 process over 2: {walls[1] / walls[2]:.2f}", flush=True)


if __name__ == "__main__":
    main()
