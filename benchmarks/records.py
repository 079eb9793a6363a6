"""Records: false alarms and missed outliers, time, the error of the pseudo-open loop."""

from __future__ import annotations

import time

import numpy as np
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.identification.records.clock import build_clock

RATE = 1000.0


def alarms() -> None:
    """Frames called faulty in clean records of a million frames."""
    rng = np.random.default_rng(1)
    frames = 1_000_000
    t = np.arange(frames) / RATE
    w = 2 * np.pi * 0.045
    resonant = lfilter(
        [1.0],
        [1, -2 * np.exp(-0.005 * w) * np.cos(w), np.exp(-0.01 * w)],
        rng.standard_normal(frames),
    )
    turbulence = lfilter([1.0], [1, -1.997477, 0.997555], rng.standard_normal(frames))
    cases = {
        "white noise": rng.standard_normal(frames),
        "sinusoid of 500 nm rms at 20 Hz, noise 15.5 nm": 500 * np.sqrt(2) * np.cos(40 * np.pi * t)
        + 15.5 * rng.standard_normal(frames),
        "AR2 line of 500 nm rms at 45 Hz, damping 0.005, noise 15.5 nm": 500
        * resonant
        / resonant.std()
        + 15.5 * rng.standard_normal(frames),
        "AR2 turbulence of 592 nm, noise 15.5 nm": 592 * turbulence / turbulence.std()
        + 15.5 * rng.standard_normal(frames),
        "the same in steps of 30 nm": 30
        * np.round((592 * turbulence / turbulence.std() + 15.5 * rng.standard_normal(frames)) / 30),
    }
    for name, series in cases.items():
        seen = lbt.identification.loop_record(series, frame_rate_hz=RATE, unit="nm")
        print(f"faulty of 1e6, {name}: {frames - seen.health.usable}")


def rounded_times() -> None:
    """Records whose times are rounded to ms: laid out right, wrongly, or refused."""
    rng = np.random.default_rng(1)
    counts: dict[tuple[int, bool, str], int] = {}
    for _ in range(6000):
        rate = float(
            rng.choice(
                [
                    1000.0,
                    1000 + rng.uniform(-10, 10),
                    round(1000 + rng.uniform(-10, 10), 1),
                    rng.uniform(500, 2100),
                ]
            )
        )
        rows, count = int(rng.choice([50, 300, 2000, 10_000])), int(rng.choice([0, 0, 1, 2, 5]))
        lost = rng.choice(np.arange(rows // 7, rows - rows // 7), count, replace=False)
        kept = np.setdiff1d(np.arange(rows), lost)
        ms = (kept / rate + rng.uniform(0, 1e-3)) * 1e3
        times = 1e-3 * (np.round(ms) if rng.choice([0, 1]) else np.floor(ms))
        times = times + rng.choice([0, 1.7e9])
        try:
            clock = build_clock(len(kept), frame_rate_hz=rate, times_s=times)
            word = "right" if np.array_equal(clock.frame_of_row, kept) else "wrong"
            word = "not used" if "not used" in "".join(clock.notes) else word
        except lbt.errors.ProblemError:
            word = "refused"
        key = (rows, count > 0, word)
        counts[key] = counts.get(key, 0) + 1
    for (rows, holes, word), count in sorted(counts.items()):
        print(f"times in ms, {rows} rows, {'some' if holes else 'none'} lost: {count} {word}")


def missed() -> None:
    """Share of single spikes that are found, over their size in noise."""
    rng = np.random.default_rng(2)
    for size in (6, 7, 8, 9, 10, 12):
        y = rng.standard_normal(400_000)
        at = np.arange(200, 400_000, 400)
        y[at] += size * np.sign(rng.standard_normal(at.size))
        seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
        found = ~seen.usable
        print(
            f"spikes of {size} sigma: {100 * found[at].mean():.1f} % found, "
            f"{found.sum() - found[at].sum()} other frames"
        )


def pseudo_open_loop() -> None:
    """Error of the pseudo-open loop of a simulated loop without noise."""
    shell = lbt.models.PositionLoop.from_bandwidth(
        natural_frequency_hz=50, damping=0.5, bandwidth_hz=300, sampling_hz=24_000
    )
    air = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=80.0, frame_rate_hz=RATE)
    for delay in (1, 2, 2.4, 3):
        for mirror in (None, shell):
            path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, mirror=mirror)
            truth = lbt.Truth(turbulence=air, sensor_gain=0.4)
            controller = lbt.integrator(path, gain=0.2).controller
            run = lbt.simulate(controller, truth, hardware=path, frames=30_000)
            night = lbt.files.telemetry_from_simulation(run, path)
            seen = lbt.load_record(night)
            good = np.flatnonzero(seen.usable)
            error = seen.pseudo_open_loop(0.4)[good] - run.total_nm[0, good - 1]
            print(
                f"delay {delay}, {len(path.mirror_taps)} taps: "
                f"{np.abs(error).max() / np.abs(run.total_nm).max():.1e} of the largest phase"
            )


def times() -> None:
    """Seconds to make a record of 60 000 frames of two axes."""
    y, u = np.random.default_rng(0).standard_normal((2, 60_000, 2))
    best = np.inf
    for _ in range(5):
        start = time.perf_counter()
        lbt.identification.loop_record(y, u, frame_rate_hz=RATE, delay_frames=2.4, unit="nm")
        best = min(best, time.perf_counter() - start)
    print(f"60 000 frames, two axes, measurements and commands: {1e3 * best:.0f} ms")


if __name__ == "__main__":
    alarms()
    rounded_times()
    missed()
    pseudo_open_loop()
    times()
