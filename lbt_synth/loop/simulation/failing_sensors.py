"""Runs of a loop of several sensors, some of which may fail on the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller
from lbt_synth.loop.simulation.disturbances import (
    DrawnLine,
    draw_noise,
    draw_parts,
    run_oscillator,
)
from lbt_synth.loop.simulation.run import Simulation, record_run
from lbt_synth.models import LoopHardware, SinusoidalVibration, Truth, Vibration
from lbt_synth.models.plant.readings import memory, other_exposures, own_exposure
from lbt_synth.models.plant.seen_vibration import seen_vibration
from lbt_synth.models.sensor_suite import (
    Accelerometer,
    Motion,
    checked_motions,
    period_frames,
)
from lbt_synth.models.vibration import DriftingVibration, checked_direction
from lbt_synth.validation import FloatArray, choice, integer, number

READINGS = ("missing", "zero", "frozen")


@dataclass(frozen=True, slots=True, kw_only=True)
class Drop:
    """A sensor or channel that fails for a while.

    Its readings are missing, which is seen, so that the fall-back filter takes over; or they are
    zero, or frozen at the last one, which the filter believes.
    """

    unit: str
    start_s: float
    end_s: float = np.inf
    reading: str = "missing"

    def __post_init__(self) -> None:
        number(self.start_s, "start_s", at_least=0)
        choice(self.reading, "reading", READINGS)
        if not self.end_s > self.start_s:
            raise ProblemError(
                f"{self.unit} must be back after it fails, at {self.start_s:g} s; got "
                f"{self.end_s:g} s."
            )

    def covers(self, time_s: float) -> bool:
        """Whether the sensor is away at a time."""
        return self.start_s <= time_s < self.end_s


def simulate_sensors(
    filters: Mapping[frozenset[str], Controller],
    truth: Truth,
    *,
    hardware: LoopHardware,
    frames: int,
    cases: int = 1,
    seed: int = 0,
    settle_frames: int = 1000,
    drops: Sequence[Drop] = (),
) -> Simulation:
    """Run a loop of several sensors, frame by frame.

    There is a controller for each set of sensors and channels that are not read; the empty set has
    that of all. They share their states, so that a switch is without a jump. Drops count from the
    first frame recorded. The measurements are those of all sensors, held from one reading to the
    next. ProblemError if a sensor that fails is not there, or has no filter.
    """
    frames = integer(frames, "frames", at_least=1)
    settle = integer(settle_frames, "settle_frames", at_least=0)
    rng, noise_rng, other_rng = np.random.default_rng(seed).spawn(3)
    size = {"frames": settle + frames, "cases": cases}
    total, lines = draw_parts(truth, hardware, rng=rng, zero_frame=settle, oscillators=True, **size)
    noise = draw_noise(truth, hardware, rng=noise_rng, **size)
    others = draw_others(truth, hardware, lines, other_rng, zero_frame=settle, **size)
    added = np.concatenate([noise, others], axis=2)
    for vibration, line in zip(truth.vibrations, lines, strict=True):
        total += line.motion[:, :, None] * checked_direction(vibration, hardware)
    for drop in drops:
        if drop.unit not in hardware.suite.units:
            raise ProblemError(
                f"a sensor that fails must be one of {', '.join(hardware.suite.units)}; got "
                f"{drop.unit!r}."
            )
    rate = hardware.frame_rate_hz
    events = {
        settle + int(np.ceil(segment.start_s * rate - 1e-6)): segment
        for segment in run_segments(drops, frames / rate)
    }
    out = _run(filters, hardware, total, added, truth.sensor_gain, events)
    return record_run(total, out, hardware, settle=settle, seed=seed)


def draw_others(
    truth: Truth,
    hardware: LoopHardware,
    lines: Sequence[DrawnLine],
    rng: np.random.Generator,
    *,
    frames: int,
    cases: int,
    zero_frame: int,
) -> FloatArray:
    """Draw noise and accelerations in the readings of the other sensors, (cases, frames, q).

    What a wavefront sensor reads of the residual is no part of them. The lines are those of
    :func:`draw_parts`, whose time 0 is frame ``zero_frame``.
    """
    suite = hardware.suite
    factors = [sensor.noise_factor(hardware.modes) for sensor in suite.sensors]
    drawn = [rng.standard_normal((cases, frames, len(factor))) @ factor.T for factor in factors]
    out = np.concatenate(drawn, axis=2)
    moving = checked_motions(truth.motions, suite, len(lines))
    first = out.shape[2] - len(suite.channels)  # column of the first channel
    for vibration, line, moved in zip(truth.vibrations, lines, moving, strict=True):
        seen = [first + i for i, name in enumerate(suite.channels) if name in moved]
        if not seen:
            continue
        if isinstance(vibration, Vibration):
            process = seen_vibration(vibration, moved, suite.accelerometers, hardware)
            inner = rng.standard_normal((cases, 1 + frames, process.B.shape[-1] - 3))
            drive = np.concatenate([line.drive, inner], axis=2)
            out[:, :, seen] += run_oscillator(process, vibration, drive)[:, :, 1:]
        else:
            time_s = (np.arange(frames) - zero_frame) / hardware.frame_rate_hz
            readings = [
                _acceleration(sensor, hardware, vibration, line.motion, moved[name], time_s)
                for sensor in suite.accelerometers
                for name in sensor.channels
                if name in moved
            ]
            out[:, :, seen] += np.stack(readings, axis=2)
    return out


def _acceleration(
    sensor: Accelerometer,
    hardware: LoopHardware,
    line: SinusoidalVibration | DriftingVibration,
    motion: FloatArray,
    moved: Motion,
    time_s: FloatArray,
) -> FloatArray:
    """Return what a channel reads of a sinusoid, (cases, frames) [m/s^2].

    A line that drifts counts with its frequency of the moment. That of one with a damping is an
    approximation, good for a narrow line: its mean acceleration is not only ``-w^2`` times its mean
    position.
    """
    if isinstance(line, DriftingVibration):
        frequency_hz = line.frequency_hz_at(time_s)
    else:
        frequency_hz = np.full(len(time_s), line.frequency_hz)
    turn = 2 * np.pi * frequency_hz * hardware.dt_s
    # whole frames of the age are a delay; what is left of it turns the phase, by two frames
    newest = int(sensor.age_frames(hardware) - period_frames(sensor, hardware) + 1)
    swing = sensor.swing(moved, frequency_hz, hardware) * np.exp(1j * turn * newest)
    # beyond its begin the motion counts as still: the first readings are in the settling
    padded = np.pad(motion, ((0, 0), (newest + 1, 0)), mode="edge")[:, : motion.shape[1] + 1]
    now, before = padded[:, 1:], padded[:, :-1]
    return np.asarray(swing.real * now - swing.imag * (before - np.cos(turn) * now) / np.sin(turn))


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """A time between two events: what is not read, and what reads zeros or its last reading."""

    start_s: float
    end_s: float
    missing: tuple[str, ...]
    wrong: Mapping[str, str]

    @property
    def text(self) -> str:
        """What fails, in words; empty if nothing does."""
        return ", ".join(
            [*self.missing, *(f"{unit} ({reading})" for unit, reading in self.wrong.items())]
        )


def run_segments(drops: Sequence[Drop], duration_s: float) -> tuple[Segment, ...]:
    """Return the times between failures and returns of sensors in a run."""
    events = {0.0, *(t for d in drops for t in (d.start_s, d.end_s) if t < duration_s)}
    starts = sorted(events)
    out = []
    for start_s, end_s in zip(starts, [*starts[1:], duration_s], strict=True):
        away = [drop for drop in drops if drop.covers(start_s)]
        missing = tuple(sorted({d.unit for d in away if d.reading == "missing"}))
        wrong = {d.unit: d.reading for d in away if d.unit not in missing}
        out.append(Segment(start_s=start_s, end_s=end_s, missing=missing, wrong=wrong))
    return tuple(out)


def _run(
    filters: Mapping[frozenset[str], Controller],
    hardware: LoopHardware,
    total: FloatArray,
    added: FloatArray,
    sensor_gain: float,
    events: Mapping[int, Segment],
) -> FloatArray:
    """Run all cases side by side; return ``phi_res, u, y``, (cases, frames, n + m + q)."""
    (cases, frames, n), suite = total.shape, hardware.suite
    m, rows, read = hardware.n_commands, suite.rows(hardware), suite.read(hardware)
    period, taps = len(read), hardware.mirror_taps
    exposures = [own_exposure(hardware), *other_exposures(hardware)]
    held = memory(exposures, n, period)
    seen = held.C.copy()
    seen[:, : hardware.n_measurements] *= sensor_gain
    x = np.zeros((filters[frozenset()].n_states, cases))
    state, y = np.zeros((held.n_states, cases)), np.zeros((added.shape[2], cases))
    commands = np.zeros((len(taps), m, cases))
    out = np.zeros((cases, frames, n + m + len(y)))
    A, B, C, D = filters[frozenset()].stacks()
    wrong: Mapping[str, str] = {}
    for k in range(frames):
        if k in events:
            missing, wrong = events[k].missing, events[k].wrong
            if frozenset(missing) not in filters:
                raise ProblemError(f"there is no filter without {', '.join(missing)}.")
            A, B, C, D = filters[frozenset(missing)].stacks()
        t, last = k % period, y.copy()
        y[read[t]] = added[:, k, read[t]].T
        y[: seen.shape[1]][read[t, : seen.shape[1]]] += (seen[t] @ state)[read[t, : seen.shape[1]]]
        for unit, reading in wrong.items():
            y[rows[unit]] = last[rows[unit]] if reading == "frozen" else 0.0
        x = A[t] @ x + B[t] @ y
        commands[1:] = commands[:-1].copy()
        commands[0] = C[t] @ x + D[t] @ y
        residual = total[:, k].T - hardware.influence @ np.tensordot(taps, commands, 1)
        state = held.A[t] @ state + held.B[t] @ residual
        out[:, k] = np.concatenate([residual, commands[0], y]).T
    return out
