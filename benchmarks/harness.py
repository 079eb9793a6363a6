"""Timing by pairs, growth with size, and the machine."""

from __future__ import annotations

import os
import platform
import re
import statistics
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

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
        **{
            name: version(name)
            for name in ("numpy", "scipy", "cvxpy", "clarabel", "control", "slycot")
        },
    }
