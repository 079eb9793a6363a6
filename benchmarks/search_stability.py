"""Does rounding move the search for a model, and how likely is what it finds?

    python benchmarks/search_stability.py [--scales 6] [--jobs 2] [--save FILE] [--beside FILE]

60 records (94 axes) of 15 to 30 s: wide_resonances.py, identification.py, short_records.py and the
good ones of wrong_commands.py. Each axis is searched several times, its series multiplied by 1,
1 + 1e-12, 1 + 2e-12 and so on. The cost of a model is minus its log-likelihood plus what the
criterion asks for its components; a model whose gain was not found has none. ``--beside`` compares
with what another version saved.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import identification
import numpy as np
import short_records
import wide_resonances
import wrong_commands

import lbt_synth as lbt
from lbt_synth.identification.fit.fitting import Search, cost
from lbt_synth.identification.fit.identify import axis_periodogram, find_axis

STEP = 1e-12
APART = 0.5  # of the log-likelihood: searches that end elsewhere


def records() -> Iterator[tuple[str, lbt.identification.LoopRecord]]:
    """Yield names and records."""
    for seed in range(14):
        yield f"wide {seed}", wide_resonances.draw(seed, 30.0)[0]
    for seed in range(14):
        yield f"plain {seed}", identification.case(seed, 30_000).record
    for seed in range(12):
        it = short_records.drifting_case(seed, 17.0)
        whole = it.record
        end = round(17.0 * whole.frame_rate_hz)
        assert whole.commands is not None
        yield (
            f"drift {seed}",
            lbt.identification.loop_record(
                whole.measurements[:end],
                whole.commands[:end],
                frame_rate_hz=whole.frame_rate_hz,
                delay_frames=whole.delay_frames,
                unit="nm",
            ),
        )
    for kind in wrong_commands.KINDS:
        for seed in range(2):
            yield f"good {kind} {seed}", wrong_commands.draw_good(kind, seed, 30.0)


def search(
    task: tuple[str, lbt.identification.LoopRecord], scales: int
) -> dict[str, tuple[list[float], float]]:
    """Return the costs of all searches of each axis, and their processor time."""
    name, record = task
    found = {}
    for i in range(record.axes):
        y, c = record.measurements[:, i], record.corrections()[:, i]
        begun, costs = time.process_time(), []
        for k in range(scales):
            scale = 1 + k * STEP
            data = axis_periodogram(y * scale, c * scale, record.frame_rate_hz, record.stretches())
            axis = find_axis(Search(data=data))
            is_found = axis.sensor_gain_error is not None
            costs.append(cost(Search(data=axis.data), axis.fitted_model) if is_found else np.nan)
        found[f"{name}, axis {i}"] = costs, time.process_time() - begun
    return found


def show(found: dict) -> None:
    """Print the axes whose searches end apart, and how far."""
    print("what each search is above the best of its axis, where they end apart (nan: no gain):")
    apart, flips, means = 0, 0, []
    for name, (costs, _) in found.items():
        if np.all(np.isnan(costs)):
            continue
        above = np.array(costs) - np.nanmin(costs)
        means.append(np.nanmean(above))
        apart += bool(np.nanmax(above) > APART)
        flips += bool(np.any(np.isnan(above)))
        if not np.all(above <= APART):
            print(f"  {name:22s}" + " ".join(f"{each:6.1f}" for each in above))
    seconds = sum(each for _, each in found.values())
    print(f"other models in {apart} of {len(found)} axes, {np.mean(means):.2f} above the best")
    print(f"a gain that only some searches find: {flips}; {seconds:.0f} s in all")


def compare(found: dict, other: dict) -> None:
    """Print where the searches of two versions end apart on average."""
    print("where they differ on average (positive: likelier here):")
    total = 0.0
    for name, (costs, _) in found.items():
        both = costs, other[name][0]
        if not any(np.all(np.isnan(each)) for each in both):
            by = float(np.nanmean(both[1]) - np.nanmean(both[0]))
            total += by
            if abs(by) > APART:
                print(f"  {name:22s}{by:+7.1f}")
    seconds, before = (sum(each for _, each in these.values()) for these in (found, other))
    print(f"all axes {total:+.1f}, {seconds / before:.2f} times their time")


def main() -> None:
    """Search all records."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scales", type=int, default=6)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--save", type=Path)
    parser.add_argument("--beside", type=Path)
    given = parser.parse_args()
    with ProcessPoolExecutor(given.jobs) as pool:
        parts = pool.map(partial(search, scales=given.scales), records())
        found = {name: each for part in parts for name, each in part.items()}
    show(found)
    if given.save:
        given.save.write_text(json.dumps(found))
    if given.beside:
        compare(found, json.loads(given.beside.read_text()))


if __name__ == "__main__":
    main()
