"""Whole commands, as a user waits for them: this version beside an earlier one.

``make bench`` prints the table, and writes ``benchmarks/commands.json`` and the page of the
documentation that shows it. Each command is a process of its own, with one BLAS thread and compiled
bytecode. Its processor time includes that of its workers, and its memory is that of the largest
process. ``--only WORD ...`` runs the rows with these words, ``--before none`` this version alone.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from harness import growth, machine

import lbt_synth as lbt

ROOT = Path(__file__).resolve().parents[1]
RESULTS = Path(__file__).with_name("commands.json")
PAGE = ROOT / "docs" / "benchmarks_commands.md"
BEFORE = "9ff5a1d"  # the last version before commands were made quick
ERRORS, GAINS = ("-3", "3", "100"), ("0.5", "1.5", "60")
CLI = ("-m", "lbt_synth")
FILTERS = "-c", "import numpy, scipy.linalg, astropy.io.fits"
SOLVER = "-c", "import cvxpy"
LEAST_GAMMA = """
import sys, time, numpy as np, lbt_synth as lbt
from lbt_synth.linear.riccati.filtering import kalman_riccati, least_gamma
air = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
lines = [
    lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=50.0, direction=(1.0, 0.0))
    for f in np.linspace(12, 90, (int(sys.argv[1]) - 4) // 2)
]
plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=air, vibrations=lines, noise_nm=15.5)
start = kalman_riccati(plant)
upper = lbt.hinf_norm(plant.error_system(start.gain_predictor)).upper
lower = float(np.sqrt(np.linalg.eigvalsh(plant.L @ start.P @ plant.L.T)[-1]))
took = []
for repeat in range(5):
    begun = time.process_time()
    least_gamma(plant, lower=lower, upper=upper, start=start)
    took.append(time.process_time() - begun)
print(min(took))
"""


@dataclass
class Work:
    """One row: the arguments of the interpreter, and what limits it."""

    name: str
    arguments: Callable[[Path], tuple[str, ...]]  # from the folder of the inputs
    bar_s: float | None = None
    bar_ratio: float | None = None  # to the peer
    peer: tuple[str, ...] | None = None
    size: float | None = None  # of what the work grows with
    series: str = ""  # rows of one series share a growth exponent
    prints_s: bool = False  # it prints its own time, without the imports
    repeats: int = 1


@dataclass
class Measured:
    """What one process took."""

    processor_s: float
    wall_s: float
    peak_mb: float


@dataclass
class Row:
    """A work, measured."""

    work: str
    now: Measured
    before: Measured | None = None
    peer_s: float | None = None
    bar: str = ""
    growth: float | None = None
    failed_before: str = field(default="")


def record(folder: Path, seconds: int) -> Path:
    """Write a record in a process of its own: commands inherit the peak of this one."""
    target = folder / f"record_{seconds}.fits"
    if not target.exists():
        with ProcessPoolExecutor(1) as helper:
            helper.submit(_write_record, target, seconds).result()
    return target


def _write_record(target: Path, seconds: int) -> None:
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
    seen = lbt.files.telemetry_from_simulation(run, path, sensor_gain=0.8, design=ran)
    lbt.files.save_telemetry(target, seen)


def gain_files(folder: Path) -> list[str]:
    """Write the gain files of three designs of the example."""
    files = [folder / f"{name}.fits" for name in ("kalman", "hinf", "integrator")]
    if not files[0].exists():
        config = lbt.load_config(ROOT / "examples" / "lbt.yaml")
        designs = (
            lbt.kalman(config.plant),
            lbt.hinf(config.plant, gamma_ratio=1.2),
            lbt.integrator(config.hardware, gain=0.5),
        )
        for target, design in zip(files, designs, strict=True):
            lbt.save_gain(target, design)
    return [str(target) for target in files]


def study(folder: Path, samples: int) -> tuple[str, ...]:
    """Write a study of two gain files, and return its command."""
    kalman, hinf, _ = gain_files(folder)
    text = (ROOT / "examples" / "study.yaml").read_text()
    head, tail = text.split("controllers:")
    parameters = tail[tail.index("parameters:") :]
    head = head.replace("samples: 4096 ", f"samples: {samples} ")
    head = head.replace("config: lbt.yaml", f"config: {ROOT / 'examples' / 'lbt.yaml'}")
    files = f"controllers:\n  kalman: {{file: {kalman}}}\n  hinf: {{file: {hinf}}}\n\n"
    target = folder / f"study_{samples}.yaml"
    target.write_text(head + files + parameters)
    return (*CLI, "study", str(target), "-o", fresh(folder / f"study_{samples}"), "--jobs", "2")


def fresh(target: Path) -> str:
    """Return a directory that does not exist."""
    shutil.rmtree(target, ignore_errors=True)
    return str(target)


def design(*options: str) -> Callable[[Path], tuple[str, ...]]:
    return lambda folder: (*CLI, "design", *options, "-o", str(folder / "out.fits"))


def works() -> list[Work]:
    example, robust = "examples/lbt.yaml", "examples/lbt_robust.yaml"
    rows = [
        Work("import numpy, scipy.linalg, astropy.io.fits", lambda _: FILTERS, repeats=3),
        Work("import cvxpy", lambda _: SOLVER, repeats=3),
        Work(
            "design, Kalman",
            design(example, "--method", "kalman"),
            bar_ratio=1.6,
            peer=FILTERS,
            repeats=3,
        ),
        Work(
            "design, H-infinity by LMI",
            design(example, "--method", "hinf"),
            bar_ratio=1.4,
            peer=SOLVER,
            repeats=3,
        ),
        Work("design, robust", design(robust, "--method", "robust"), bar_s=6),
        Work(
            "tradeoff",
            lambda folder: (*CLI, "tradeoff", example, "-o", str(folder / "front.csv")),
            bar_s=8,
        ),
        Work(
            "report of three designs",
            lambda f: (*CLI, "report", example, *gain_files(f), "-o", str(f / "page.html")),
            bar_s=4,
        ),
        Work(
            "robustness map, 100 x 60 points x 3 designs",
            lambda f: (
                *(*CLI, "robustness", example, *gain_files(f), "-o", str(f / "map.csv")),
                *("--errors-hz", *ERRORS, "--sensor-gains", *GAINS),
            ),
            bar_s=4,
        ),
    ]
    for seconds, bar_s in ((60, 2), (600, 6)):
        rows.append(
            Work(
                f"identify, two axes, {seconds} s at 1 kHz",
                lambda f, seconds=seconds: (
                    *(*CLI, "identify", str(record(f, seconds))),
                    *("-o", str(f / "identified.yaml")),
                ),
                bar_s=bar_s,
                size=seconds,
                series="identify",
            )
        )
    rows.append(
        Work(
            "auto, the same 60 s",
            lambda f: (*CLI, "auto", str(record(f, 60)), "-o", str(f / "auto.fits")),
            bar_s=6,
        )
    )
    for samples, bar_s in ((100_000, None), (1_000_000, 35)):
        rows.append(
            Work(
                f"study, {samples:,} samples, two gain files, two workers",
                lambda f, samples=samples: study(f, samples),
                bar_s=bar_s,
                size=samples,
                series="study",
            )
        )
    for states, bar_s in ((10, None), (26, 0.008), (50, None), (100, 0.3)):
        rows.append(
            Work(
                f"search for the least gamma, {states} states",
                lambda _, states=states: ("-c", LEAST_GAMMA, str(states)),
                bar_s=bar_s,
                size=states,
                series="gamma",
                prints_s=True,
            )
        )
    return rows


def measure(work: Work, tree: Path, folder: Path) -> Measured:
    """Run a work in a copy of a version; the quickest of its repeats counts."""
    runs = [_run_once(work, work.arguments(folder), tree) for _ in range(work.repeats)]
    return min(runs, key=lambda run: run.processor_s)


def _run_once(work: Work, arguments: tuple[str, ...], tree: Path) -> Measured:
    """Run a process to its end; raise if it fails."""
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    with tempfile.TemporaryFile() as out:
        start = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, *arguments], cwd=tree, env=environment, stdout=out, stderr=out
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        wall_s = time.perf_counter() - start
        out.seek(0)
        said = out.read().decode()
    if process.returncode:
        raise RuntimeError(said.strip().splitlines()[-1])
    processor_s = float(said) if work.prints_s else used.ru_utime + used.ru_stime
    return Measured(processor_s=processor_s, wall_s=wall_s, peak_mb=used.ru_maxrss / 1024)


def copy_version(reference: str | None, target: Path) -> Path:
    """Copy this version, or that of a commit, and compile it."""
    if reference is None:
        for name in ("lbt_synth", "examples"):
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, target / name, ignore=ignored)
    else:
        packed = subprocess.run(
            ["git", "archive", reference, "lbt_synth", "examples"],
            cwd=ROOT,
            check=True,
            capture_output=True,
        ).stdout
        with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            archive.extractall(target, filter="data")
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    compiling = [sys.executable, "-m", "compileall", "-q", str(target / "lbt_synth")]
    subprocess.run(compiling, check=True, env=environment)
    return target


def run_row(work: Work, now: Path, before: Path | None, folder: Path) -> Row:
    """Measure a work in both versions, and its peer, one after the other."""
    row = Row(work=work.name, now=measure(work, now, folder))
    if work.bar_s is not None:
        row.bar = f"{work.bar_s:g} s"
    if before is not None and work.arguments(folder)[:2] not in (FILTERS, SOLVER):
        try:
            row.before = measure(work, before, folder)
        except RuntimeError as error:
            row.failed_before = str(error)
    if work.peer is not None:
        peer = Work("peer", lambda _: work.peer, repeats=work.repeats)
        row.peer_s = measure(peer, now, folder).processor_s
        row.bar = f"{work.bar_ratio:g} x peer"
    return row


HEADINGS = (
    *("work", "now [s]", "before [s]", "before / now", "now / peer", "bar"),
    *("processors", "peak [MB]", "growth"),
)


def cells(row: dict[str, object]) -> list[str]:
    """One line of the table."""
    now, before, peer_s = row["now"], row["before"], row["peer_s"]
    took = now["processor_s"]

    def shown(value: float | None, digits: str) -> str:
        return "" if value is None else f"{value:{digits}}"

    return [
        row["work"],
        shown(took, ".4g"),
        shown(before and before["processor_s"], ".4g"),
        shown(before and before["processor_s"] / took, ".2f"),
        shown(peer_s and took / peer_s, ".2f"),
        row["bar"],
        shown(took / now["wall_s"] if took > 1.1 * now["wall_s"] else None, ".2f"),
        shown(now["peak_mb"], ".0f"),
        shown(row["growth"], ".2f"),
    ]


def page(found: dict[str, object]) -> str:
    """The table and the machine, in Markdown."""
    lines = [HEADINGS, ("---", *("---:",) * (len(HEADINGS) - 1)), *map(cells, found["rows"])]
    body = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    here = {"before": found["before"]} | found["machine"]
    listing = "\n".join(f"- {key.replace('_', ' ')}: {value}" for key, value in here.items())
    return f"{body}\n\n{listing}\n"


def save(rows: dict[str, dict[str, object]], before: str) -> dict[str, object]:
    """Write the rows that are there, with the growth of each series, and their page."""
    order = [work for work in works() if work.name in rows]
    for series in ("identify", "study", "gamma"):
        same = [work for work in order if work.series == series]
        for work in same:
            rows[work.name]["growth"] = None
        if len(same) > 1:
            times = [rows[work.name]["now"]["processor_s"] for work in same]
            rows[same[-1].name]["growth"] = growth([work.size for work in same], times)
    found = {
        "before": before,
        "machine": machine(),
        "rows": [rows[work.name] for work in order],
    }
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")
    PAGE.write_text(page(found))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", default=BEFORE, help="commit, tag or none")
    parser.add_argument("--only", nargs="*", default=[], help="words of the rows to run")
    chosen = parser.parse_args()
    table = [w for w in works() if not chosen.only or any(x in w.name for x in chosen.only)]
    if not table:
        parser.error(f"no row has one of {', '.join(chosen.only)}")
    known = json.loads(RESULTS.read_text())["rows"] if chosen.only and RESULTS.exists() else []
    rows = {row["work"]: row for row in known}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        now = copy_version(None, folder / "now")
        before = None
        if chosen.before != "none":
            before = copy_version(chosen.before, folder / "before")
        for work in table:
            print(f"... {work.name}", file=sys.stderr, flush=True)
            rows[work.name] = asdict(run_row(work, now, before, folder))
            found = save(rows, chosen.before)
    lines = [list(HEADINGS), *map(cells, found["rows"])]
    widths = np.max([[len(cell) for cell in line] for line in lines], axis=0)
    for line in lines:
        padded = (cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True))
        print("  ".join((line[0].ljust(widths[0]), *padded)))


if __name__ == "__main__":
    main()
