"""Speed, each operation as a ratio to a peer in the same run, and its growth with size.

``make bench`` prints tables and writes ``benchmarks/results.json`` and the page of the
documentation that shows them. A ratio above 1 means that this package is faster than its
peer, except for the imports, where it is the time over that of ``import numpy, scipy.linalg``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import control
import numpy as np
from commands import COMMANDS
from harness import Row, machine, paired
from speed_export import REALTIME
from speed_linear import SIZED

import lbt_synth as lbt
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.studies.robustness import RobustnessMap

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "benchmarks_table.md"
FRAMES = 8000


def interpreter(arguments: list[str]) -> Callable[[], object]:
    return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)


def imports() -> dict[str, Row]:
    base = interpreter(["-c", "import numpy, scipy.linalg"])
    out = {}
    for name, arguments in (
        ("import lbt_synth", ["-c", "import lbt_synth"]),
        ("lbt-synth --help", ["-m", "lbt_synth.cli.main", "--help"]),
    ):
        figures = paired(interpreter(arguments), base, 7)
        out[name] = figures | {"ratio": 1 / figures["ratio"], "bar": 1.5}
    return out


def time_domain() -> dict[str, Row]:
    config = lbt.load_config(ROOT / "examples" / "lbt.yaml")
    loop = lbt.close_loop(config.hardware, lbt.kalman(config.plant).controller)
    system, peer = loop.system, loop.system.to_control()
    rng = np.random.default_rng(0)
    out = {}
    one = rng.standard_normal((FRAMES, system.B.shape[1]))
    first = paired(
        lambda: filter_series(system, one),
        lambda: control.forced_response(peer, U=one.T),
        9,
        calls=20,
    )
    out[f"loop, 1 case x {FRAMES} frames"] = first | {"bar": 50}
    many = rng.standard_normal((1000, FRAMES, system.B.shape[1]))
    # the peer knows one case a call: ten calls stand for a thousand
    figures = paired(
        lambda: filter_series(system, many),
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
    error = np.max(np.abs(filter_series(system, one) - expected.T)) / np.max(np.abs(expected))
    assert error < 1e-10, error
    return out


def maps() -> dict[str, Row]:
    """Exact Strehl ratios at 41 sensor gains and 41 frequency errors."""
    config = lbt.load_config(ROOT / "examples" / "lbt.yaml")
    design, truth = lbt.kalman(config.plant), config.truth
    errors, gains = np.linspace(-3.5, 3.5, 41), np.linspace(0.25, 1.3, 41)

    def point(gain: float, error: float) -> float:
        lines = [replace(v, frequency_hz=v.frequency_hz - error) for v in truth.vibrations]
        met = replace(truth, sensor_gain=gain, vibrations=tuple(lines))
        loop = lbt.close_loop(config.hardware, design.controller, sensor_gain=gain)
        return lbt.strehl(lbt.residual_budget(loop, met), config.imaging)

    def mapped() -> RobustnessMap:
        return lbt.studies.robustness_map(
            design, truth, config.imaging, errors_hz=errors, sensor_gains=gains
        )

    # the peer knows one point a call: 25 of them stand for all 1681
    some = np.arange(0, 41, 10)
    figures = paired(mapped, lambda: [[point(g, e) for e in errors[some]] for g in gains[some]], 5)
    expected = np.array([[point(g, e) for e in errors[some]] for g in gains[some]])
    error = np.max(np.abs(mapped().strehl[0][np.ix_(some, some)] / expected - 1))
    assert error < 1e-6, error
    share = errors.size * gains.size / some.size**2
    return {
        "Strehl map, 41 x 41 (point by point)": {
            "ours_s": figures["ours_s"],
            "peer_s": share * figures["peer_s"],
            "ratio": share * figures["ratio"],
            "bar": 50,
        }
    }


def unit(rows: dict[str, Row]) -> tuple[str, float]:
    """Unit of a table's times and how many of it are a second."""
    return ("ns", 1e9) if all(row["ours_s"] < 1e-5 for row in rows.values()) else ("ms", 1e3)


def cells(name: str, row: Row, per_second: float) -> list[str]:
    """One line of a table: name, ours, peer, ratio, bar, growth."""

    def shown(key: str, factor: float, digits: str) -> str:
        return f"{factor * row[key]:{digits}}" if key in row else ""

    form = ".3f" if per_second == 1e3 else ".1f"
    return [
        name,
        *(shown(key, per_second, form) for key in ("ours_s", "peer_s")),
        shown("ratio", 1, ".2f"),
        shown("bar", 1, "g") or (f"{1e3 * row['bar_s']:g} ms" if "bar_s" in row else ""),
        *(shown(key, 1, ".2f") for key in ("growth", "peer_growth")),
    ]


def headings(time_unit: str) -> list[str]:
    times = (f"ours [{time_unit}]", f"peer [{time_unit}]")
    return ["", *times, "ratio", "bar", "growth", "peer's growth"]


def page(title: str, head: list[str], lines: list[list[str]]) -> str:
    rule = "|---|" + "---:|" * (len(head) - 1)
    body = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"## {title}\n\n| {' | '.join(head)} |\n{rule}\n{body}\n"


def main() -> None:
    here = machine()
    results: dict[str, object] = {}
    pages = []
    everyday = {**imports(), **time_domain(), **maps()}
    tables = [("everyday operations", "operation", everyday)]
    for title, first, case in (*COMMANDS, *SIZED, *REALTIME):
        print(f"... {title}", file=sys.stderr)
        tables.append((title, first, {str(size): row for size, row in case().items()}))
    for title, first, rows in tables:
        time_unit, per_second = unit(rows)
        head = headings(time_unit)
        lines = [cells(name, row, per_second) for name, row in rows.items()]
        results[title] = rows
        pages.append(page(title[0].upper() + title[1:], [first, *head[1:]], lines))
        print(pages[-1])
    target = Path(__file__).with_name("results.json")
    target.write_text(json.dumps({"machine": here, "results": results}, indent=1) + "\n")
    listing = "\n".join(f"- {key.replace('_', ' ')}: {value}" for key, value in here.items())
    PAGE.write_text("## Machine\n\n" + listing + "\n\n" + "\n".join(pages))
    print(f"\nwritten: {target}, {PAGE}")


if __name__ == "__main__":
    main()
