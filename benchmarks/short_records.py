"""Short records of drifting loops: gain files written, residuals, tests on unseen data, times.

    python benchmarks/short_records.py [--records 40] [--jobs 2] [--seconds 30 17 10]

The loops are those of ``identification.py`` at 500 to 2000 Hz, with a drift on top of the
turbulence: a first-order process of 50 to 1000 nm rms (in its logarithm) whose pole is 0.999 to
0.99995 (in the logarithm of its distance from 1). What each design leaves is computed exactly in
the truth, and replayed on the minute after its record.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import identification as loops
import numpy as np
from harness import log_uniform, record_options, run_all

import lbt_synth as lbt
from lbt_synth.identification.prediction.residual import (
    estimate_residual,
    gather,
    mode_noise,
    replay,
    settled_test,
)

UNSEEN_S = 60.0
POLES = (0.99995, 0.999)
DRIFT_NM = (50.0, 1000.0)
LENGTHS_S = (30.0, 17.0, 10.0)


def drifting_case(seed: int, seconds: float) -> loops.Case:
    """Draw a loop with a drift, and run it for so long and for a minute more."""
    rng = np.random.default_rng([seed, 2])
    rate = float(np.round(log_uniform(rng, 500, 2000)))
    pole = 1 - log_uniform(rng, *(1 - np.array(POLES)))
    rms = log_uniform(rng, *DRIFT_NM)
    drift = lbt.models.ARModel(
        coefficients=[pole], driving_rms_nm=rms * np.sqrt(1 - pole**2), frame_rate_hz=rate
    )
    return loops.case(seed, round((seconds + UNSEEN_S) * rate), rate=rate, drift=drift)


def replayed(
    it: loops.Case, controller: lbt.Controller, run: tuple[int, int], test: tuple[int, int]
) -> tuple[float, float]:
    """Variance that a controller leaves of recorded frames and its error [nm^2], by a replay."""
    path = replace(it.path, sensor_matrix=it.truth.sensor_gain * it.path.sensor)
    loop = lbt.close_loop(path, controller)
    if not loop.is_stable:
        return float("inf"), float("nan")
    kept, z = settled_test((run,), (test,), path), it.record.pseudo_open_loop(it.truth.sensor_gain)
    noise = mode_noise(path, np.array([[it.truth.noise_nm**2]]), 0.0)
    found = estimate_residual(gather(replay(loop, z, (run,)), kept), kept, *noise)
    return found.total_nm2, found.total_error_nm2


def studied(seed: int, seconds: float) -> dict:
    """Everything that is measured of one record."""
    it = drifting_case(seed, seconds)
    whole, frames = it.record, round(seconds * it.path.frame_rate_hz)
    record = lbt.identification.loop_record(
        whole.measurements[:frames],
        whole.commands[:frames],
        frame_rate_hz=whole.frame_rate_hz,
        delay_frames=2,
        unit="nm",
    )
    out = {"seed": seed, "seconds": seconds, "error": ""}
    begin = time.process_time()
    try:
        found = lbt.design_from_record(record)
    except lbt.errors.LbtSynthError as error:
        return out | {"error": str(error), "time_s": time.process_time() - begin}
    out["time_s"] = time.process_time() - begin
    truth = it.truth
    best = lbt.kalman(loops.exact_plant(it)).controller
    limit = lbt.loop.least_residual(it.path, truth, frame_means=True).rms_nm ** 2
    last, every = (frames, whole.frames), (0, whole.frames)
    later = [replayed(it, each, every, last)[0] for each in (found.design.controller, best)]
    # the test that auto makes, of a filter whose residual is known exactly
    tested, error = replayed(it, best, (0, frames), (frames // 2, frames))
    exact = loops.left(it, best)
    half = lbt.kalman(found.half_model.plant()).controller
    axis = found.model.axes[0]
    told = axis.sensor_gain_error
    return out | {
        "ratio": loops.left(it, found.design.controller) / exact,
        "limit": loops.left(it, found.design.controller) / limit,
        "later": later[0] / later[1],
        "gain_deviation": np.nan if told is None else (axis.sensor_gain - truth.sensor_gain) / told,
        "gain": abs(axis.sensor_gain / truth.sensor_gain - 1),
        "half": loops.left(it, half) / exact,
        "deviation": (tested - exact) / error,
        "notes": found.held_out.notes,
    }


def show(seconds: float, results: list[dict]) -> None:
    """Print what was found of the records of one length."""
    written = [r for r in results if not r["error"]]
    print(f"{seconds:g} s: {len(results)} records, gain file of {len(written)}")
    for r in results:
        if r["error"]:
            print(f"  record {r['seed']}: {r['error']}")
    if not written:
        return
    for key, words in (
        ("ratio", "residual variance, exact: design / truth's filter"),
        ("later", "the same on the minute after the record"),
        ("limit", "the same / limit of performance"),
        ("half", "first half's design / truth's filter"),
        ("gain", "sensor gain, relative error"),
    ):
        values = np.sort([r[key] for r in written])
        print(
            f"  {words:50s} median {np.median(values):.4f}, 90th percentile "
            f"{values[int(0.9 * (len(values) - 1))]:.4f}, largest {values[-1]:.4f}"
        )
    deviations = np.array([r["deviation"] for r in written])
    print(
        f"  test of the truth's filter: {np.sqrt(np.mean(deviations**2)):.2f} standard errors rms "
        f"from the exact residual, largest {np.max(np.abs(deviations)):.1f}"
    )
    times = [r["time_s"] for r in results]
    print(f"  processor time: median {np.median(times):.1f} s, largest {np.max(times):.1f} s")
    for r in written:
        for note in r["notes"]:
            print(f"  record {r['seed']}: {note}")


def main() -> None:
    """Run the study."""
    asked = record_options(__doc__, records=40, jobs=2, seconds=LENGTHS_S)
    for seconds in asked.seconds:
        show(seconds, run_all(partial(studied, seconds=seconds), asked))


if __name__ == "__main__":
    main()
