"""Speed of the everyday operations, each as a ratio to a peer in the same run.

``make bench`` prints a table and writes ``benchmarks/results.json``. A ratio
above 1 means that this package is faster than its peer, except for the imports,
where it is the time over that of ``import numpy, scipy.linalg``.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import control
import numpy as np

import lbt_synth as lbt

ROOT = Path(__file__).resolve().parents[1]
FRAMES = 8000


def seconds(call: Callable[[], object], repeats: int) -> float:
    """Median time of a call after one warm-up."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def paired(
    ours: Callable[[], object], peer: Callable[[], object], repeats: int, *, calls: int = 1
) -> dict[str, float]:
    """Medians of both and of the ratio peer / ours, taken in turn.

    ``calls`` of ours follow each other and their mean counts, so that a call of a
    millisecond is not measured on the caches that the peer has just emptied.
    """
    ours(), peer()
    mine, theirs = [], []
    for _ in range(repeats):
        for call, count, times in ((ours, calls, mine), (peer, 1, theirs)):
            start = time.perf_counter()
            for _ in range(count):
                call()
            times.append((time.perf_counter() - start) / count)
    ratios = [t / m for m, t in zip(mine, theirs, strict=True)]
    return {
        "ours_s": statistics.median(mine),
        "peer_s": statistics.median(theirs),
        "ratio": statistics.median(ratios),
    }


def interpreter(arguments: list[str]) -> Callable[[], object]:
    return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)


def imports() -> dict[str, dict[str, float]]:
    base = interpreter(["-c", "import numpy, scipy.linalg"])
    out = {}
    for name, arguments in (
        ("import lbt_synth", ["-c", "import lbt_synth"]),
        ("lbt-synth --help", ["-m", "lbt_synth.cli.main", "--help"]),
        ("first Kalman design", ["-c", "import lbt_synth as l; l.kalman(l.EstimationProblem("
                                 "A=1., B=[[1., 0.]], C=1., D=[[0., 1.]], L=1.))"]),
    ):  # fmt: skip
        figures = paired(interpreter(arguments), base, 7)
        out[name] = figures | {"ratio": 1 / figures["ratio"], "bar": 1.5}
    del out["first Kalman design"]["bar"]
    return out


def time_domain() -> dict[str, dict[str, float]]:
    config = lbt.load_config(ROOT / "examples" / "lbt.yaml")
    loop = lbt.close_loop(config.hardware, lbt.kalman(config.plant).controller)
    system, peer = loop.system, loop.system.to_control()
    rng = np.random.default_rng(0)
    out = {}
    one = rng.standard_normal((FRAMES, system.B.shape[1]))
    first = paired(
        lambda: lbt.filter_series(system, one),
        lambda: control.forced_response(peer, U=one.T),
        9,
        calls=20,
    )
    out[f"loop, 1 case x {FRAMES} frames"] = first | {"bar": 50}
    many = rng.standard_normal((1000, FRAMES, system.B.shape[1]))
    # the peer knows one case a call: ten calls stand for a thousand
    figures = paired(
        lambda: lbt.filter_series(system, many),
        lambda: [control.forced_response(peer, U=case.T) for case in many[:10]],
        3,
    )
    out[f"loop, 1000 cases x {FRAMES} frames"] = {
        "ours_s": figures["ours_s"],
        "peer_s": 100 * figures["peer_s"],
        "ratio": 100 * figures["ratio"],
        "bar": 50,
    }
    _, expected = control.forced_response(peer, U=one.T)
    error = np.max(np.abs(lbt.filter_series(system, one) - expected.T)) / np.max(np.abs(expected))
    assert error < 1e-10, error
    return out


def synthesis() -> dict[str, dict[str, float]]:
    plant = lbt.load_config(ROOT / "examples" / "lbt.yaml").plant
    return {
        name: {"ours_s": seconds(call, 5)}
        for name, call in (
            ("Kalman, Riccati", lambda: lbt.kalman(plant)),
            ("Kalman, SDP", lambda: lbt.kalman(plant, method="sdp")),
            ("H-infinity 1.2, Riccati", lambda: lbt.hinf(plant, gamma_ratio=1.2, method="riccati")),
            ("H-infinity 1.2, LMI", lambda: lbt.hinf(plant, gamma_ratio=1.2)),
        )
    }


def main() -> None:
    results = {**imports(), **time_domain(), **synthesis()}
    machine = {
        "python": platform.python_version(),
        "system": platform.platform(),
        "processors": os.cpu_count(),
        "blas_threads": os.environ["OPENBLAS_NUM_THREADS"],
    }
    print(f"{'operation':32} {'ours [ms]':>12} {'peer [ms]':>12} {'ratio':>8} {'bar':>6}")
    for name, row in results.items():
        cells = [
            f"{1e3 * row[key]:12.3f}" if key in row else " " * 12 for key in ("ours_s", "peer_s")
        ]
        ratio = f"{row['ratio']:8.2f}" if "ratio" in row else " " * 8
        print(f"{name:32} {' '.join(cells)} {ratio} {row.get('bar', ''):>6}")
    target = Path(__file__).with_name("results.json")
    target.write_text(json.dumps({"machine": machine, "results": results}, indent=1) + "\n")
    print(f"written: {target}")


if __name__ == "__main__":
    main()
