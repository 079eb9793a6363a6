"""Figures of telemetry files: sizes, and how exactly the AOT standard carries a controller.

Run with ``python benchmarks/telemetry.py`` from the repository; it needs the extra ``aot``.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import aotpy
import numpy as np

import lbt_synth as lbt
from lbt_synth.files.telemetry.time_filters import time_filters


def sizes(seen: lbt.files.Telemetry, folder: Path) -> None:
    print(f"{seen.frames} frames, {seen.modes} modes")
    for name, precision in (
        ("t.fits", "float64"),
        ("t.fits", "float32"),
        ("t.npz", "float64"),
        ("t.aot.fits", "float64"),
    ):
        start = time.perf_counter()
        path = lbt.files.save_telemetry(folder / name, seen, precision=precision)
        written = time.perf_counter() - start
        start = time.perf_counter()
        lbt.files.load_telemetry(path)
        read = time.perf_counter() - start
        kilobytes = path.stat().st_size / 1e3
        print(f"{name:11s} {precision}: {kilobytes:6.0f} kB, {written:.3f} s, {read:.3f} s")


def next_command_error(path: Path) -> float:
    """Each command from the AOT file's matrix and filters and the past, against the recorded."""
    loop = aotpy.AOSystem.read_from_file(path).loops[0]
    u = loop.commands.data
    y = loop.input_sensor.measurements.data.reshape(len(u), -1)
    inside = 1e-9 * y @ loop.control_matrix.data.reshape(u.shape[1], -1).T
    b, a = loop.time_filter_num.data, loop.time_filter_den.data
    top = a.shape[1] - 1
    rows = np.arange(top, len(u))
    total = sum(b[:, p] * inside[rows - top + p] for p in range(top + 1))
    total -= sum(a[:, p] * u[rows - top + p] for p in range(top))
    return float(np.max(np.abs(total / a[:, top] - u[rows])) / np.max(np.abs(u)))


def response_error(controller: lbt.Controller) -> float:
    """Largest error of the time filters, relative to the controller's response."""
    filters = time_filters(controller)
    system = controller.to_statespace()
    frequency = np.geomspace(1e-4, 0.499, 1000) / system.dt_s
    z = np.exp(2j * np.pi * frequency * system.dt_s)
    response = system.frequency_response(frequency)
    worst = 0.0
    for i, row in enumerate(filters.matrix):
        scalar = np.polyval(filters.numerators[i, ::-1], z)
        scalar /= np.polyval(filters.denominators[i, ::-1], z)
        size = np.linalg.norm(response[:, i], axis=1)
        worst = max(worst, np.max(np.abs(scalar[:, None] * row - response[:, i]).T / size))
    return worst


def main() -> None:
    config = lbt.load_config("examples/lbt.yaml")
    designs = {
        "integrator": lbt.integrator(config.hardware, gain=0.4),
        "kalman": lbt.kalman(config.plant),
        "hinf": lbt.hinf(config.plant, gamma_ratio=1.2, route="riccati"),
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for method, design in designs.items():
            run = lbt.simulate(
                design.controller, config.truth, hardware=config.hardware, frames=8000
            )
            seen = lbt.files.telemetry_from_simulation(
                run, config.hardware, sensor_gain=config.truth.sensor_gain, design=design
            )
            if method == "integrator":
                sizes(seen, folder)
            path = lbt.files.save_telemetry(folder / "t.aot.fits", seen)
            metres = np.max(np.abs(lbt.files.load_telemetry(path).commands / seen.commands - 1))
            print(
                f"{method:10s} time filters {response_error(design.controller):.1e}, "
                f"next command {next_command_error(path):.1e}, through metres {metres:.1e}"
            )


if __name__ == "__main__":
    main()
