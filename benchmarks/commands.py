"""Whole commands, as a user waits for them, each in a process of its own.

The processor time of a command includes that of its workers. The peer of a design is the import
that it cannot do without.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from harness import Row, growth

import lbt_synth as lbt

ROOT = Path(__file__).resolve().parents[1]
CLI = ("-m", "lbt_synth")
FILTERS = "-c", "import numpy, scipy.linalg, astropy.io.fits"
SOLVER = "-c", "import cvxpy"
IDENTIFY = {seconds: f"identify, two axes, {seconds} s at 1 kHz" for seconds in (60, 600)}
STUDY = "study, 1,000,000 samples, two gain files, two workers"
REPEATS = 3  # of what takes a second, of which the quickest counts


def processor_s(*arguments: str, repeats: int = 1) -> float:
    """Return the least processor time of an interpreter with arguments; raise if it fails."""
    times = []
    for _ in range(repeats):
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(
            [sys.executable, *arguments], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise RuntimeError(f"{' '.join(arguments)} failed")
        times.append(used.ru_utime + used.ru_stime)
    return min(times)


def record(folder: Path, seconds: int) -> str:
    """Write a record at 1 kHz with five lines and two wide resonances per axis."""
    rate, lines = 1000.0, []
    for axis, direction in enumerate(((1.0, 0.0), (0.0, 1.0))):
        narrow = [(11.0, 25.0), (23.0, 60.0), (47.0, 30.0), (61.0, 15.0), (83.0, 20.0)]
        shapes = [(f + 1.7 * axis, 0.004, rms) for f, rms in narrow]
        shapes += [(33.0 + axis, 0.08, 50.0), (110.0 + axis, 0.05, 30.0)]
        lines += [
            lbt.Vibration(frequency_hz=f, damping=damping, rms_nm=rms, direction=direction)
            for f, damping, rms in shapes
        ]
    path = lbt.LoopHardware(frame_rate_hz=rate)
    air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
    truth = lbt.Truth(turbulence=air, vibrations=tuple(lines), noise_nm=15.5, sensor_gain=0.8)
    ran = lbt.integrator(path, gain=0.4)
    run = lbt.simulate(ran.controller, truth, hardware=path, frames=int(rate) * seconds, seed=1)
    seen = lbt.files.telemetry_from_simulation(run, path, sensor_gain=0.8)
    return str(lbt.files.save_telemetry(folder / f"record_{seconds}.fits", seen))


def gain_files(folder: Path) -> list[str]:
    """Write the gain files of three designs of the example."""
    files = [folder / f"{name}.fits" for name in ("kalman", "hinf", "integrator")]
    config = lbt.load_config(ROOT / "examples" / "lbt.yaml")
    designs = (
        lbt.kalman(config.plant),
        lbt.hinf(config.plant, gamma_ratio=1.2),
        lbt.integrator(config.hardware, gain=0.5),
    )
    for target, design in zip(files, designs, strict=True):
        lbt.save_gain(target, design)
    return [str(target) for target in files]


def study(folder: Path, gains: list[str]) -> tuple[str, ...]:
    """Write a study of two gain files, and return its command."""
    kalman, hinf, _ = gains
    text = (ROOT / "examples" / "study.yaml").read_text()
    head, tail = text.split("controllers:")
    parameters = tail[tail.index("parameters:") :]
    head = head.replace("samples: 4096 ", "samples: 1000000 ")
    head = head.replace("config: lbt.yaml", f"config: {ROOT / 'examples' / 'lbt.yaml'}")
    files = f"controllers:\n  kalman: {{file: {kalman}}}\n  hinf: {{file: {hinf}}}\n\n"
    target = folder / "study.yaml"
    target.write_text(head + files + parameters)
    return ("study", str(target), "-o", str(folder / "study"), "--jobs", "2")


def whole_commands() -> dict[str, Row]:
    """Time the commands, with one BLAS thread."""
    example, robust = "examples/lbt.yaml", "examples/lbt_robust.yaml"
    rows: dict[str, Row] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        out = ("-o", str(folder / "out.fits"))
        for what, method, peer, bar in (
            ("design, Kalman", "kalman", FILTERS, 1 / 1.6),
            ("design, H-infinity by LMI", "hinf", SOLVER, 1 / 1.4),
        ):
            command = (*CLI, "design", example, "--method", method, *out)
            ours, theirs = (processor_s(*words, repeats=REPEATS) for words in (command, peer))
            rows[what] = {"ours_s": ours, "peer_s": theirs, "ratio": theirs / ours, "bar": bar}
        gains = gain_files(folder)
        grid = ("--errors-hz", "-3", "3", "100", "--sensor-gains", "0.5", "1.5", "60")
        identified = ("-o", str(folder / "identified.yaml"))
        for what, bar_s, words in (
            ("design, robust", 6, ("design", robust, "--method", "robust", *out)),
            ("tradeoff", 8, ("tradeoff", example, "-o", str(folder / "front.csv"))),
            ("report of three designs", 4, ("report", example, *gains, "-o", f"{name}/page.html")),
            (
                "robustness map, 100 x 60 points x 3 designs",
                4,
                ("robustness", example, *gains, "-o", f"{name}/map.csv", *grid),
            ),
            (IDENTIFY[60], 2, ("identify", record(folder, 60), *identified)),
            (IDENTIFY[600], 6, ("identify", record(folder, 600), *identified)),
            ("auto, the same 60 s", 6, ("auto", str(folder / "record_60.fits"), *out)),
            (STUDY, 35, study(folder, gains)),
        ):
            rows[what] = {"ours_s": processor_s(*CLI, *words), "bar_s": bar_s}
    times = [rows[what]["ours_s"] for what in IDENTIFY.values()]
    rows[IDENTIFY[600]]["growth"] = growth(list(IDENTIFY), times)
    return rows


COMMANDS = (("whole commands (the import they need)", "command", whole_commands),)
