"""Our gain files in pyRTC's own loop, beside its predictors, on the same disturbance.

From the repository, with the extra ``pyrtc``::

    python benchmarks/pyrtc_loop.py [GAIN.fits...]
    python benchmarks/pyrtc_loop.py arithmetic GAIN.fits...
    python benchmarks/pyrtc_loop.py draws GAIN.fits...

Each predictor runs in a system of pyRTC that is started from the exported folder: its loop, its
shared memory. The truth is that of examples/lbt.yaml, 16 000 frames; those of pyRTC and the row
*fitted* are fitted to the same 16 000 frames of another draw before. Printed: the residual of both
axes after 2000 frames [nm rms], the largest difference from the commands that the controller gives
in our simulation and that of its twin in numpy, over the largest command, and the time per frame.

The second form runs the twin, without pyRTC, for a million frames in all, beside the controller in
double precision: their residuals at four sensor gains, and the rms of the difference, which is the
noise of the arithmetic.

The third form replays six other draws, each after a draw to which ``least_squares`` is fitted, and
prints the residual of each [nm rms], and their mean.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("PYRTC_LOG_LEVEL", "ERROR")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
from support.pyrtc_systems import drawn, pol_series, residual_rms, running
from support.recorded_runs import recorded_run

import lbt_synth as lbt
from lbt_synth.interop.pyrtc import plugin
from lbt_synth.interop.pyrtc.export import InnerLoop, pol_filter

FRAMES, SETTLE, QUIET = 16_000, 2000, 5


def main() -> None:
    """Print a line per predictor, or per sensor gain."""
    if sys.argv[1:2] == ["arithmetic"]:
        for file in sys.argv[2:]:
            compare_arithmetic(file)
    elif sys.argv[1:2] == ["draws"]:
        compare_draws({Path(file).stem: lbt.load_gain(file) for file in sys.argv[2:]})
    else:
        compare_predictors()


def predicted(kind: str, training: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Commands of a predictor of pyRTC, fitted to one pseudo-open-loop series, over another."""
    options = {"type": kind, "horizon": 2}
    predictor = plugin.register().make_predictor(options, training.shape[1])
    predictor.fit(training)
    predictor.reset()
    commands = np.zeros(series.shape)
    for k, measured in enumerate(series):
        predictor.update(measured)
        commands[k] = predictor.predict()
    return commands


def compare_draws(designs: dict[str, lbt.Design]) -> None:
    """Print a line per draw, and the means."""
    config = lbt.load_config("examples/lbt.yaml")
    truth, path = config.truth, config.hardware
    rows = []
    print("  ".join(f"{name:13}" for name in (*designs, "least_squares")))
    for seed in range(3, 9):
        total, noise = drawn(truth, path, frames=FRAMES, seed=seed)
        runs = [
            recorded_run(design.controller.start(), path, total, noise)[..., :2]
            for design in designs.values()
        ]
        training = pol_series(truth, path, frames=FRAMES, seed=100 + seed)
        series = np.zeros_like(total[0])
        series[1:] = total[0, :-1] + noise[0, 1:]  # the phase of a frame is measured in the next
        commands = predicted("least_squares", training, series)
        runs.append(total - np.vstack([np.zeros((1, 2)), commands[:-1]]))
        rows.append([residual_rms(run[:, SETTLE:]) for run in runs])
        print("  ".join(f"{value:<13.2f}" for value in rows[-1]), flush=True)
    print("  ".join(f"{value:<13.2f}" for value in np.mean(rows, axis=0)) + "  mean")


def compare_arithmetic(file: str) -> None:
    """Print what single precision adds to the residual [nm rms]."""
    truth, design = lbt.load_config("examples/lbt.yaml").truth, lbt.load_gain(file)
    total, noise = drawn(truth, design.hardware, frames=250_000, seed=0)
    print(f"{file}\ngain    single      double      difference")
    for gain in (1.0, 0.7, 0.5, 0.358):
        single, double = (
            recorded_run(one, design.hardware, total, noise, sensor_gain=gain)[:, SETTLE:, :2]
            for one in (InnerLoop(pol_filter(design)), design.controller.start())
        )
        sizes = [residual_rms(series) for series in (single, double, single - double)]
        print(f"{gain:<6g}  " + "  ".join(f"{size:<10.6g}" for size in sizes), flush=True)


def compare_predictors() -> None:
    config = lbt.load_config("examples/lbt.yaml")
    truth, path = config.truth, config.hardware
    training = pol_series(truth, path, frames=FRAMES, seed=1)
    total, noise = drawn(truth, path, frames=FRAMES, seed=2, quiet=QUIET)
    designs = {Path(file).stem: lbt.load_gain(file) for file in sys.argv[1:]}
    designs = designs or {"kalman": lbt.kalman(config.plant)}
    names = {name: (design, None) for name, design in designs.items()}
    plain = next(iter(designs.values()))
    names |= {f"{name}, fitted": (design, "fit") for name, design in designs.items()}
    for kind in ("persistence", "ar_kalman", "least_squares"):
        names[f"pyRTC {kind}"] = (plain, kind)
    print("predictor                  residual   from ours   from twin   per frame")
    with tempfile.TemporaryDirectory() as folder:
        for name, (design, kind) in names.items():
            at = Path(folder) / name.replace(" ", "_")
            lbt.interop.export(at, design, "pyrtc")
            own = kind in (None, "fit")
            predictor = None if own else {"type": kind, "delay_frames": 2}
            train = None if kind is None else training
            with running(at, predictor=predictor, training=train) as (telescope, _):
                start = time.perf_counter()
                found = recorded_run(telescope, path, total, noise)
                seconds = time.perf_counter() - start
            words = "-           -        "
            if kind is None:
                largest = np.max(np.abs(found[..., 2:4]))
                other = (design.controller.start(), InnerLoop(pol_filter(design)))
                runs = (recorded_run(one, path, total, noise) for one in other)
                apart = (np.max(np.abs(run - found)[..., 2:4]) / largest for run in runs)
                words = "   ".join(f"{value:<9.2g}" for value in apart)
            print(
                f"{name:26} {residual_rms(found[:, SETTLE:]):8.2f}   {words}   "
                f"{1e6 * seconds / FRAMES:.0f} us",
                flush=True,
            )


if __name__ == "__main__":
    main()
