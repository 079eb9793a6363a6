"""Records whose commands are wrong: which faults are named, and which good records pass.

    python benchmarks/wrong_commands.py [--records 200] [--seconds 30] [--jobs 2] [--good] [--auto]

Loops of two axes at 1 kHz with a delay of 2 frames, an integrator of gain 0.2 to 0.6, sensor gain
0.4 to 1, noise 2 to 30 nm a frame (evenly in its logarithm), turbulence as in identification.py,
and 0 to 5 resonances of 5 to 100 nm rms in any direction, 5 to 150 Hz, damping 0.002 to 0.01. Each
record is given with each fault. ``--good`` draws loops of other kinds instead, without a fault:
wide resonances, the lines of ERIS, delays of 1.5 to 3 frames, AR1 turbulence, leaky and double
integrators, Kalman filters, unequal and low gains, coarse steps, at 500 to 2000 Hz. ``--auto``
designs from each record that passes, and runs the design in the true loop: is it stable, and how
much more variance does it leave than the best linear controller?
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from harness import frozen_flow, log_uniform, random_line, record_options, run_all, second_order

import lbt_synth as lbt
from lbt_synth.identification.commands.verdict import explain_commands

RATE, DELAY, SETTLE = 1000.0, 2, 1000
FAULTS = {  # and the beginning of what repairs it
    "none": "",
    "sign": "--command-sign -1",
    "swap": "--swap-axes",
    "rotation": "--command-matrix",
    "scale 1000": "--command-scale 0.001",
    "scale 0.5": "--command-scale 2",
    "shift": "--command-shift-frames",
    "increments": "--command-increments",
    "other night": "",
    "axis late": "",
}
PART_SIZE = FAULTS["scale 0.5"]  # also named in a warning beside a design
KINDS = (
    *("wide", "eris", "fraction", "ar1", "leaky", "double", "kalman", "unequal", "low"),
    "quantised",
)
ERIS_HZ = (10, 16, 25.8, 45.5, 48.3, 72.5, 96.7)


@dataclass
class Loop:
    """A random loop."""

    seed: int
    frames: int
    truth: lbt.Truth
    gain: float

    @property
    def path(self) -> lbt.LoopHardware:
        """Sensor, mirror and delay."""
        return lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=DELAY)


def draw_lines(rng: np.random.Generator, count: int, damping: tuple[float, float]) -> Iterator:
    """Draw resonances in any direction."""
    for _ in range(count):
        angle = rng.uniform(0, np.pi)
        yield random_line(rng, (np.cos(angle), np.sin(angle)), damping=damping)


def draw_loop(seed: int, frames: int) -> Loop:
    """Draw a loop; odd ones have frozen flow."""
    rng = np.random.default_rng([seed, 17])
    noise = log_uniform(rng, 2, 30)
    sensor_gain, gain = float(rng.uniform(0.4, 1.0)), float(rng.uniform(0.2, 0.6))
    turbulence: lbt.models.Spectrum = frozen_flow(rng)
    if seed % 2 == 0:
        corner = log_uniform(rng, 0.2, 3)
        damping, rms = float(rng.uniform(0.1, 1)), float(rng.uniform(200, 800))
        turbulence = second_order(corner, damping, rms, RATE)
    lines = tuple(draw_lines(rng, int(rng.integers(0, 6)), (0.002, 0.01)))
    truth = lbt.Truth(
        turbulence=turbulence, vibrations=lines, noise_nm=noise, sensor_gain=sensor_gain
    )
    return Loop(seed, frames + SETTLE, truth, gain)


def run(loop: Loop, night: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Run a loop; return measurements and commands."""
    law = lbt.integrator(loop.path, gain=loop.gain).controller
    made = lbt.simulate(
        law, loop.truth, hardware=loop.path, frames=loop.frames, seed=loop.seed + 10_000 * night
    )
    return made.measurements[0][SETTLE:], made.commands[0][SETTLE:]


def spoil(loop: Loop, fault: str) -> tuple[np.ndarray, np.ndarray]:
    """Return measurements and commands with a fault."""
    y, u = run(loop)
    if fault == "rotation":
        angle = np.deg2rad(30 if loop.seed % 3 else -30)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return y, u @ turn.T
    if fault == "shift":
        return y[5:-5], np.roll(u, (-2, -1, 1, 2)[loop.seed % 4], axis=0)[5:-5]
    if fault == "axis late":
        return y[1:], np.column_stack([u[1:, 0], u[:-1, 1]])
    wrong = {
        "none": u,
        "sign": -u,
        "swap": u[:, ::-1],
        "scale 1000": 1000 * u,
        "scale 0.5": 0.5 * u,
        "increments": np.diff(u, axis=0, prepend=u[:1]),
    }
    return y, wrong[fault] if fault in wrong else run(loop, night=1)[1]


def try_design(loop: Loop, record: lbt.identification.LoopRecord) -> tuple[str, float]:
    """Return what became of a design in the true loop, and its variance over the least one."""
    try:
        made = lbt.design_from_record(record)
    except lbt.errors.RecordError as error:
        return f"named: {error.options}", np.nan
    except lbt.errors.LbtSynthError as error:
        return f"refused: {error}", np.nan
    warned = any(PART_SIZE in note for note in made.model.notes)
    closed = lbt.close_loop(loop.path, made.design.controller, sensor_gain=loop.truth.sensor_gain)
    if not closed.is_stable:
        return "UNSTABLE", np.inf
    try:
        least_nm = lbt.loop.least_residual(loop.path, loop.truth).rms_nm
    except lbt.errors.CoupledModesError:  # lines at any angle: no limit is known
        least_nm = np.nan
    what = f"stable, warned of {PART_SIZE}" if warned else "stable"
    return what, (lbt.residual_budget(closed, loop.truth).rms_nm / least_nm) ** 2


def judge(
    seed: int, frames: int, design: bool
) -> list[tuple[str, bool, bool, float, str, str, float]]:
    """Return fault, whether named, whether passed, seconds, words, and what the design does."""
    loop, out = draw_loop(seed, frames), []
    for fault, options in FAULTS.items():
        y, u = spoil(loop, fault)
        record = lbt.identification.loop_record(
            y, u, frame_rate_hz=RATE, delay_frames=DELAY, unit="nm"
        )
        start = time.perf_counter()
        verdict = explain_commands(record)
        seconds = time.perf_counter() - start
        right = verdict.repair.options.startswith(options) and verdict.accepted == (fault == "none")
        words = {"other night": "nothing to do", "axis late": "later than those of axis 0"}
        if fault in words:
            right = not verdict.accepted and words[fault] in verdict.explanation
        said = "" if right else f"{seed}: {verdict.explanation} {verdict.repair.options}"
        made = try_design(loop, record) if design and verdict.accepted else ("", np.nan)
        if made[0].startswith("named:"):  # by the gains of the fit
            right = bool(options) and made[0].startswith(f"named: {options}")
            said = "" if right else f"{seed}: {made[0]}"
            accepted, seconds = False, time.perf_counter() - start
        else:
            accepted = verdict.accepted
            if PART_SIZE in made[0]:
                right, said = options == PART_SIZE, f"{seed}: {made[0]}"
        out.append((fault, right, accepted, seconds, said, *made))
        print(seed, *out[-1], sep="; ", file=sys.stderr, flush=True)
    return out


def draw_good(kind: str, seed: int, seconds: float) -> lbt.identification.LoopRecord:
    """Draw a record without a fault."""
    rng = np.random.default_rng([seed, 77])
    rate, delay = float(rng.choice([500.0, 800.0, 1000.0, 2000.0])), 2.0
    noise = log_uniform(rng, 2, 25)
    sensor, gain = float(rng.uniform(0.35, 1.1)), float(rng.uniform(0.15, 0.6))
    lines = list(draw_lines(rng, int(rng.integers(0, 6)), (0.001, 0.02)))
    turbulence: lbt.models.Spectrum = frozen_flow(rng)
    if kind == "wide":
        lines += draw_lines(rng, 3, (0.05, 0.3))
    if kind == "eris":
        each = list(draw_lines(rng, len(ERIS_HZ), (0.004, 0.05)))
        lines = [
            lbt.Vibration(
                frequency_hz=f, damping=v.damping, rms_nm=v.rms_nm, direction=tuple(v.direction)
            )
            for f, v in zip(ERIS_HZ, each, strict=True)
        ]
    if kind == "fraction":
        delay = float(rng.choice([1.5, 2.3, 2.7, 3.0]))
    if kind == "ar1":
        turbulence = lbt.models.ARModel(
            coefficients=[float(rng.uniform(0.98, 0.9995))],
            driving_rms_nm=float(rng.uniform(5, 40)),
            frame_rate_hz=rate,
        )
    path = lbt.LoopHardware(frame_rate_hz=rate, delay_frames=delay)
    truth = lbt.Truth(
        turbulence=turbulence, vibrations=tuple(lines), noise_nm=noise, sensor_gain=sensor
    )
    gain = min(gain, (0.6 if delay <= 2 else 0.35) / sensor)
    law = good_law(kind, path, gain, sensor, noise, lines)
    made = lbt.simulate(
        law, truth, hardware=path, frames=int(seconds * rate), seed=seed, settle_frames=500
    )
    y, u = made.measurements[0], made.commands[0]
    if kind == "quantised":
        y, u = np.round(y), 2 * np.round(u / 2)
    return lbt.identification.loop_record(y, u, frame_rate_hz=rate, delay_frames=delay, unit="nm")


def good_law(
    kind: str, path: lbt.LoopHardware, gain: float, sensor: float, noise: float, lines: list
) -> lbt.Controller:
    """Return the controller of a kind of loop."""
    one, rate = np.eye(2), path.frame_rate_hz
    still = {"D": np.zeros((2, 2)), "dt_s": 1 / rate}
    if kind == "kalman":
        slow = lbt.models.ARModel(
            coefficients=[1.99, -0.9902], driving_rms_nm=2.0, frame_rate_hz=rate
        )
        plant = lbt.tip_tilt_plant(
            frame_rate_hz=rate,
            turbulence=slow,
            vibrations=lines,
            noise_nm=noise,
            sensor_matrix=sensor * one,
        )
        return lbt.kalman(plant).controller
    if kind == "leaky":
        return lbt.Controller(A=0.99 * one, B=gain * one, C=one, **still)
    if kind == "double":
        A = np.block([[one, 0.03 * one], [0 * one, one]])
        B = np.vstack([gain * one, 0.3 * gain * one])
        return lbt.Controller(A=A, B=B, C=np.hstack([one, 0 * one]), **still)
    gains = {"unequal": np.diag([gain, gain / 2]), "low": 0.05 / sensor * one}
    return lbt.Controller(A=one, B=gains.get(kind, gain * one), C=one, **still)


def judge_good(seed: int, seconds: float) -> list[tuple[str, bool, bool, float, str]]:
    """Return kind, whether it passed (twice), seconds, and the words."""
    out = []
    for kind in KINDS:
        record = draw_good(kind, seed, seconds)
        start = time.perf_counter()
        verdict = explain_commands(record)
        words = (
            "" if verdict.accepted else f"{seed}: {verdict.explanation} {verdict.repair.options}"
        )
        passed = verdict.accepted
        out.append((kind, passed, passed, time.perf_counter() - start, words))
    return out


def show_designs(designs: list[tuple[str, float]]) -> None:
    """Print what the designs of the accepted records do in the true loop."""
    stable = [ratio for what, ratio in designs if what.startswith("stable")]
    unstable = sum(what == "UNSTABLE" for what, _ in designs)
    refused = len(designs) - len(stable) - unstable
    print(f"    designs: {len(stable)} stable, {unstable} unstable, {refused} refused", end="")
    if stable:
        parts = np.nanquantile(stable, [0.5, 0.9, 1])
        print("; variance over the least: median, 90 %, largest", *(f"{x:.3f}" for x in parts))
    else:
        print()


def main() -> None:
    """Print the table."""
    given = record_options(__doc__, records=200, jobs=2, seconds=30.0, good=False, auto=False)
    one = partial(judge, frames=int(given.seconds * RATE), design=given.auto)
    if given.good:
        one = partial(judge_good, seconds=given.seconds)
    rows = [row for rows in run_all(one, given) for row in rows]
    for fault in KINDS if given.good else FAULTS:
        own = [row for row in rows if row[0] == fault]
        named, passed = (np.mean([row[i] for row in own]) for i in (1, 2))
        slowest = max(row[3] for row in own)
        print(f"{fault:12s} right {100 * named:5.1f} %  passed {100 * passed:5.1f} %  ", end="")
        print(f"slowest {slowest:.1f} s")
        if given.auto:
            show_designs([row[5:] for row in own if len(row) > 5 and row[5]])
        for row in own:
            if row[4]:
                print("    ", row[4])


if __name__ == "__main__":
    main()
