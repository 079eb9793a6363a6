"""What benchmarks share: timing by pairs, loops over records, a rival of least squares."""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

import lbt_synth as lbt
from lbt_synth.models.loop_hardware import past_corrections
from lbt_synth.models.resonance_spectrum import coefficient_rows, drive_ratio

FIGURES = Path(__file__).with_name("identification_figures.json")
Row = dict[str, Any]
PEERS = ("numpy", "scipy", "cvxpy", "clarabel", "control", "slycot")


def once(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def seconds(call: Callable[[], object], repeats: int) -> float:
    """Median time of a call after one warm-up."""
    call()
    return statistics.median(once(call) for _ in range(repeats))


def paired(
    ours: Callable[[], object], peer: Callable[[], object], repeats: int, *, calls: int = 1
) -> Row:
    """Medians of both and of the ratio peer / ours, taken in turn.

    ``calls`` of ours follow each other and their mean counts, so that a call of a
    millisecond is not measured on the caches that the peer has just emptied.
    """
    ours(), peer()
    mine, theirs = [], []
    for _ in range(repeats):
        mine.append(once(lambda: [ours() for _ in range(calls)]) / calls)
        theirs.append(once(peer))
    ratios = [t / m for m, t in zip(mine, theirs, strict=True)]
    return {
        "ours_s": statistics.median(mine),
        "peer_s": statistics.median(theirs),
        "ratio": statistics.median(ratios),
    }


def growth(sizes: list[int], times: list[float]) -> float:
    """Exponent p of ``time ~ size^p``, by least squares on logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def with_growth(rows: dict[int, Row]) -> dict[int, Row]:
    """Add the exponents of ours and of the peer to the row of the largest size."""
    sizes = list(rows)
    rows[sizes[-1]]["growth"] = growth(sizes, [rows[s]["ours_s"] for s in sizes])
    if all("peer_s" in row for row in rows.values()):
        rows[sizes[-1]]["peer_growth"] = growth(sizes, [rows[s]["peer_s"] for s in sizes])
    return rows


def machine() -> Row:
    """Describe what the figures were measured on."""
    cpu = ""
    info = Path("/proc/cpuinfo")
    if info.exists():
        found = re.search(r"model name\s*:\s*(.+)", info.read_text())
        cpu = found.group(1).strip() if found else ""
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    return {
        "processor": cpu or platform.processor(),
        "processors": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "blas": f"{blas['name']} {blas['version']}",
        "blas_threads": os.environ["OPENBLAS_NUM_THREADS"],
        **{name: version(name) for name in PEERS},
    }


def record_options(
    description: str | None, *, records: int, first: int = 0, **more: Any
) -> argparse.Namespace:
    """Parse which records to draw, and options of a benchmark by their defaults."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help=f"into {FIGURES.name}")
    for name, default in {"first": first, "records": records, "jobs": 1, **more}.items():
        if isinstance(default, bool):
            parser.add_argument(f"--{name}", action="store_true")
        elif isinstance(default, tuple):
            parser.add_argument(f"--{name}", nargs="+", type=type(default[0]), default=default)
        else:
            parser.add_argument(f"--{name}", type=type(default), default=default)
    return parser.parse_args()


def run_all(measure: Callable[[int], Row], asked: argparse.Namespace) -> list[Row]:
    """Measure each record by its seed, in line or in processes."""
    seeds = range(asked.first, asked.first + asked.records)
    if asked.jobs == 1:
        return [measure(seed) for seed in seeds]
    with ProcessPoolExecutor(asked.jobs) as pool:
        return list(pool.map(measure, seeds))


def write_figures(name: str, figures: Row) -> None:
    """Put the figures of a benchmark into the file that keeps them."""
    book = json.loads(FIGURES.read_text())
    FIGURES.write_text(json.dumps({**book, name: figures}, indent=2) + "\n")


def lagged(series: np.ndarray, count: int) -> np.ndarray:
    """Return a series (frames, n) and its past, (frames, count n), zeros before the first."""
    before = np.vstack([np.zeros((count - 1, series.shape[1])), series])
    return sliding_window_view(before, count, axis=0)[..., ::-1].reshape(len(series), -1)


def least_squares(
    open_loop: np.ndarray,
    mirror_taps: Sequence[float] | np.ndarray,
    count: int,
    training: Sequence[tuple[int, int]],
) -> np.ndarray:
    """Return what a predictor of past values, fitted to some frames, leaves of a series.

    A command of past pseudo-open-loop values reaches the mirror by its taps, so the series is
    regressed on its own past as the mirror would have followed it.
    """
    rows = lagged(past_corrections(np.asarray(mirror_taps), open_loop), count)
    frames = np.concatenate([np.arange(start + count + 2, stop) for start, stop in training])
    fit = np.linalg.lstsq(rows[frames], open_loop[frames], rcond=None)[0]
    return open_loop - rows @ fit


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number, evenly in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def random_line(
    rng: np.random.Generator,
    direction: tuple[float, float] | tuple[float],
    *,
    hz: tuple[float, float] = (5, 150),
    damping: tuple[float, float] = (0.002, 0.01),
    rms_nm: tuple[float, float] = (5, 100),
) -> lbt.Vibration:
    """Draw a resonance along a direction."""
    return lbt.Vibration(
        frequency_hz=float(rng.uniform(*hz)),
        damping=log_uniform(rng, *damping),
        rms_nm=float(rng.uniform(*rms_nm)),
        direction=direction,
    )


def frozen_flow(rng: np.random.Generator) -> lbt.Atmosphere:
    """Draw an atmosphere, which no process of finite order is."""
    return lbt.Atmosphere(
        seeing_arcsec=float(rng.uniform(0.5, 1.5)),
        outer_scale_m=float(rng.uniform(15, 40)),
        wind_speed_m_s=float(rng.uniform(5, 25)),
        diameter_m=8.22,
    )


def second_order(hz: float, damping: float, rms_nm: float, rate: float) -> lbt.models.ARModel:
    """Return turbulence of second order."""
    place = 2 * np.pi * hz / rate, damping
    (a1, a2), drive = coefficient_rows(*map(np.array, place)), drive_ratio(*place)
    return lbt.models.ARModel(
        coefficients=[a1, a2], driving_rms_nm=rms_nm * np.sqrt(drive), frame_rate_hz=rate
    )


def run_integrator(
    path: lbt.LoopHardware, truth: lbt.Truth, gain: float, frames: int, **options: Any
) -> tuple[lbt.identification.LoopRecord, Any]:
    """Return the record of a loop under an integrator, and its run."""
    law = lbt.integrator(path, gain=gain).controller
    run = lbt.simulate(law, truth, hardware=path, frames=frames, **options)
    record = lbt.identification.loop_record(
        run.measurements[0],
        run.commands[0],
        frame_rate_hz=path.frame_rate_hz,
        delay_frames=path.delay_frames,
        unit="nm",
    )
    return record, run
