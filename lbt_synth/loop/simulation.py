"""Runs a loop in time: any disturbance, any controller, sensors that fail; returns all series."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.linear.controller import (
    EstimatorForm,
    HasController,
    RunningController,
    as_controller,
)
from lbt_synth.loop.closed_loop import ClosedLoop, close_loop, reads_others
from lbt_synth.loop.disturbances import Disturbance, draw_disturbance
from lbt_synth.loop.strehl import Imaging, series_strehl
from lbt_synth.models import LoopHardware, Truth
from lbt_synth.models.plant.assembly import sensor_memory
from lbt_synth.storage.summaries import Summarised
from lbt_synth.validation import (
    FloatArray,
    choice,
    float_array,
    frozen_copy,
    integer,
    number,
    require_instance,
)

_SETTLED = 1e-4  # decay of the slowest mode after which a loop has settled
_MOST_SETTLING = 200_000  # frames
_DEFAULT_SETTLING = 1000  # frames
_MOST_GIGABYTES = 8.0

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


@runtime_checkable
class SteppedController(Protocol):
    """Anything that maps one measurement to one command, frame after frame."""

    def step(self, y: FloatArray) -> FloatArray:
        """Take y(k), return u(k)."""
        ...

    def reset(self) -> None:
        """Return to the initial state."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Simulation(Summarised):
    """Series of a closed loop, after it has settled."""

    total_nm: FloatArray  # mean phase over each frame, (cases, frames, n)
    residual_nm: FloatArray  # the same after the correction
    # mean square of the residual, as the camera sees it, while the command holds that arrives in a
    # frame, (cases, frames, n)
    image_nm2: FloatArray
    commands: FloatArray  # u(k), as the mirror applied them, (cases, frames, m)
    # y(k); of several sensors all, held from one reading to the next, (cases, frames, q)
    measurements: FloatArray
    frame_rate_hz: float
    seed: int  # of the random series; 0 where they were recorded

    def _brief(self) -> str:
        cases, frames, modes = self.residual_nm.shape
        return f"{cases} x {frames} frames of {modes} modes at {self.frame_rate_hz:g} Hz"

    @property
    def rms_nm(self) -> FloatArray:
        """Residual of each case over all modes, as the camera sees it [nm rms], (cases,)."""
        return np.asarray(np.sqrt(np.sum(np.mean(self.image_nm2, axis=1), axis=1)))

    def strehl(self, imaging: Imaging) -> FloatArray:
        """Long-exposure Strehl ratio of each case, (cases,)."""
        beside = np.mean(self.image_nm2 - self.residual_nm**2, axis=1)  # the means over frames
        pairs = zip(self.residual_nm, beside, strict=True)
        return np.array([series_strehl(case, imaging, within_nm2=w) for case, w in pairs])

    def part(self, first: int, last: int) -> Simulation:
        """Return the run from one frame to before another."""
        names = ("total_nm", "residual_nm", "image_nm2", "commands", "measurements")
        return replace(self, **{name: getattr(self, name)[:, first:last] for name in names})


def simulate(
    controller: Controller | EstimatorForm | HasController | SteppedController,
    disturbance: Truth | Disturbance,
    *,
    hardware: LoopHardware,
    frames: int | None = None,
    cases: int = 1,
    seed: int = 0,
    settle_frames: int | None = None,
    stroke: float | None = None,
    drops: Sequence[Drop] = (),
    frame_means: bool = False,
) -> Simulation:
    """Close the loop in the time domain.

    The random series depend on the seed, the truth and the number of frames only: controllers that
    are given the same ones, and the same ``settle_frames``, meet the same disturbances. Time 0 of a
    vibration that drifts is the first frame that is kept.

    Parameters
    ----------
    controller : Controller, Design, EstimatorForm or object with ``step(y)`` and ``reset()``
        The controller; a :class:`Controller` of the loop's own sensor runs at the speed of matrix
        products where the stroke is not limited. A design of several sensors has its fall-backs.
    disturbance : Truth or Disturbance
        A truth, from which phase and noise are drawn; or the series themselves.
    hardware : LoopHardware
        Sensors, mirror and delay.
    frames : int, optional
        Frames to keep; all by default where the series are given.
    cases, seed : int, optional
        Independent runs at once, and the seed of the random series, of a truth.
    settle_frames : int, optional
        Frames run before and dropped; by default until the slowest mode of the loop has decayed to
        1e-4 (1000 frames for a stepped controller), and none of series that are given.
    stroke : float, optional
        Largest modulus of a command that the mirror applies; without a limit by default.
    drops : sequence of Drop, optional
        Sensors that fail, in a loop of several; they count from the first frame that is kept.
    frame_means : bool, optional
        Whether the phase of a frame that is drawn is one number, as in :func:`residual_budget`.

    Returns
    -------
    Simulation
        The series.

    Raises
    ------
    UnstableLoopError
        If the loop of a :class:`Controller` is unstable or marginally stable.
    ProblemError
        If a value is out of range, sizes clash, a stepped controller returns commands that are not
        finite, or a sensor that fails is not there or has no fall-back.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> lazy = lbt.integrator(path, gain=0.5)
    >>> noisy = lbt.Truth(turbulence=None, noise_nm=10.0)
    >>> run = lbt.simulate(lazy, noisy, hardware=path, frames=4000)
    >>> exact = lbt.residual_budget(lbt.close_loop(path, lazy.controller), noisy)
    >>> bool(abs(run.rms_nm[0] / exact.rms_nm - 1) < 0.05)
    True
    """
    require_instance(hardware, LoopHardware, "hardware")
    if not isinstance(disturbance, Truth):
        require_instance(disturbance, Disturbance, "disturbance")
    limit = np.inf if stroke is None else number(stroke, "stroke", above=0)
    running, path, loop = _started(controller, hardware, disturbance.sensor_gain)
    settle = integer(settle_frames or 0, "settle_frames", at_least=0)
    if isinstance(disturbance, Truth):
        if settle_frames is None:
            settle = settling_frames(loop.radius_per_frame) if loop else _DEFAULT_SETTLING
        kept = integer(frames, "frames", at_least=1)
        cases = integer(cases, "cases", at_least=1)
        seed = integer(seed, "seed", at_least=0)
        channels = (2 + len(path.mirror_system.hold.D)) * path.modes
        channels += 2 * path.n_readings + path.n_commands
        if (gigabytes := 8e-9 * (settle + kept) * cases * channels) > _MOST_GIGABYTES:
            raise ProblemError(
                f"frames x cases must fit into {_MOST_GIGABYTES:g} GB; got {kept} x {cases}, which "
                f"need {gigabytes:.3g} GB. Run fewer cases at once, with different seeds."
            )
        disturbance = draw_disturbance(
            disturbance,
            path,
            frames=settle + kept,
            cases=cases,
            seed=seed,
            zero_frame=settle,
            frame_means=frame_means,
        )
    if loop is not None and stroke is None and not (path.suite.sensors or drops):
        noise = disturbance.noise_of(path.n_measurements)
        inputs = np.concatenate([disturbance.phase_nm, noise], axis=2)
        outputs = filter_series(loop.system, inputs)
    else:
        outputs = _step(
            running, disturbance, path, limit, _events(drops, path, settle, disturbance.frames)
        )
    n, m = path.modes, path.n_commands
    squares = outputs[:, :, :n] ** 2
    if not disturbance.frame_means:
        squares = _held_squares(disturbance, outputs[:, :, n : n + m], path)
    return Simulation(
        total_nm=frozen_copy(disturbance.phase_nm[:, settle:]),
        residual_nm=frozen_copy(outputs[:, settle:, :n]),
        image_nm2=frozen_copy(squares[:, settle:]),
        commands=frozen_copy(outputs[:, settle:, n : n + m]),
        measurements=frozen_copy(outputs[:, settle:, n + m :]),
        frame_rate_hz=path.frame_rate_hz,
        seed=seed,
    )


def _started(
    controller: Controller | EstimatorForm | HasController | SteppedController,
    hardware: LoopHardware,
    sensor_gain: float,
) -> tuple[SteppedController | RunningController, LoopHardware, ClosedLoop | None]:
    """Return a running controller, the hardware that it reads, and a linear loop."""
    alone = hardware.own_sensor_alone()
    if isinstance(controller, EstimatorForm):
        return controller.start(), alone, None
    if isinstance(controller, SteppedController):
        ours = getattr(controller, "controller", None)  # of a twin, what it computes
        reads = isinstance(ours, Controller) and reads_others(hardware, ours)
        return controller, hardware if reads else alone, None
    others = ", an object with step(y) and reset()"
    plain = as_controller(controller, others=others, any_period=True)
    path = hardware if reads_others(hardware, plain) else alone
    loop = close_loop(path, plain, sensor_gain=sensor_gain)
    loop.require_stable()
    return plain.start(getattr(controller, "controllers", None)), path, loop


def _held_squares(
    disturbance: Disturbance, commands: FloatArray, hardware: LoopHardware
) -> FloatArray:
    """Return the mean square (cases, frames, n) of the residual over each hold."""
    system, hold, m = hardware.mirror_system, hardware.mirror_system.hold, commands.shape[2]
    pieces, moving = disturbance.over_holds(hold)
    A, B, _ = system.core.repeated(m)
    rows = np.zeros((m, len(A))), np.eye(m)
    C, D = hold.positions(hardware.influence, rows, 0)
    outputs = D.shape[0] * D.shape[1]  # (g n)
    mirror = StateSpace(A=A, B=B, C=C.reshape(outputs, -1), D=D.reshape(outputs, m))
    positions = np.reshape(filter_series(mirror, commands), pieces.shape)
    late = int(hold.start)
    pieces[:, late:] -= positions[:, : commands.shape[1] - late]
    squares = np.einsum("g,ckgi->cki", hold.weights, pieces**2) + moving[:, None]
    return np.asarray(squares, dtype=np.float64)


def settling_frames(radius: float) -> int:
    """Frames until the slowest mode of a loop of that spectral radius has decayed to 1e-4."""
    if radius <= 0:
        return 1
    return int(min(np.ceil(np.log(_SETTLED) / np.log(radius)), _MOST_SETTLING))


def run_frames(
    controller: SteppedController | RunningController,
    measure: Callable[[int], FloatArray],
    expose: Callable[[int, FloatArray, FloatArray], None],
    *,
    frames: int,
    shape: tuple[int, ...],
    taps: FloatArray,
    stroke: float = np.inf,
) -> None:
    """Run a controller around whatever is measured and corrected, frame by frame.

    In frame k ``measure(k)`` returns y(k), and ``expose(k, correction, u)`` is given what the taps
    of the mirror make of the commands, (m,) or (m, cases), as they were applied, clipped at the
    stroke. A controller of ours is told what was applied in the last frame.
    """
    controller.reset()
    commands = np.zeros((len(taps), *shape))  # u(k), u(k-1), ...
    for k in range(frames):
        y = measure(k)
        if isinstance(controller, RunningController):
            u = controller.step(y, commands[0])
        else:
            u = float_array(controller.step(y), "the controller's commands")
        finite = bool(np.isfinite(u).all())
        if u.shape != shape or not finite:
            kind = "" if finite else " with values that are not finite"
            raise ProblemError(
                f"the controller must return {shape[0]} finite commands; got {u.shape}{kind} in "
                f"frame {k}."
            )
        commands = np.concatenate([np.clip(u, -stroke, stroke)[None], commands[:-1]])
        expose(k, np.tensordot(taps, commands, 1), commands[0])


def _step(
    controller: SteppedController | RunningController,
    disturbance: Disturbance,
    hardware: LoopHardware,
    stroke: float,
    events: Mapping[int, Segment],
) -> FloatArray:
    """Run the loop frame by frame; return ``phi_res, u, y``, (cases, frames, n + m + q)."""
    total, noise = disturbance.phase_nm, disturbance.noise_of(hardware.n_readings)
    together = isinstance(controller, RunningController)
    if len(total) > 1 and not together:
        pairs = zip(total, noise, strict=True)
        cases = (replace(disturbance, phase_nm=phase, noise=white) for phase, white in pairs)
        runs = [_step(controller, case, hardware, stroke, events) for case in cases]
        return np.concatenate(runs)
    (cases, frames, n), m, suite = total.shape, hardware.n_commands, hardware.suite
    rows, read = suite.rows(hardware), suite.read(hardware)
    A, B, seen = sensor_memory(hardware, own=True)
    seen[:, : hardware.n_measurements] *= disturbance.sensor_gain
    wavefront = read[:, : seen.shape[1]]
    state, y = np.zeros((A.shape[1], cases)), np.zeros((noise.shape[2], cases))
    out = np.zeros((cases, frames, n + m + len(y)))
    wrong: Mapping[str, str] = {}
    missing: tuple[str, ...] = ()

    def measure(k: int) -> FloatArray:
        nonlocal wrong, missing
        if k in events:
            wrong, missing = events[k].wrong, events[k].missing
            if isinstance(controller, RunningController):
                controller.miss(missing)
        t, last = k % len(read), y.copy()
        y[read[t]] = noise[:, k, read[t]].T
        y[: seen.shape[1]][wavefront[t]] += (seen[t] @ state)[wavefront[t]]
        for unit, reading in wrong.items():
            y[rows[unit]] = last[rows[unit]] if reading == "frozen" else 0.0
        if together:
            return y
        shown = y[:, 0].copy()
        for unit in missing:
            shown[rows[unit]] = np.nan
        return shown

    def expose(k: int, correction: FloatArray, command: FloatArray) -> None:
        nonlocal state
        t = k % len(read)
        residual = total[:, k].T - hardware.influence @ correction.reshape(m, -1)
        state = A[t] @ state + B[t] @ residual
        out[:, k, :n], out[:, k, n : n + m], out[:, k, n + m :] = residual.T, command.T, y.T

    taps, shape = hardware.mirror_taps, (m, cases) if together else (m,)
    run_frames(controller, measure, expose, frames=frames, shape=shape, taps=taps, stroke=stroke)
    return out


def _events(
    drops: Sequence[Drop], hardware: LoopHardware, settle: int, frames: int
) -> dict[int, Segment]:
    """Return what fails from which frame on."""
    hardware.suite.marked(tuple(drop.unit for drop in drops), hardware)  # refuses other names
    rate = hardware.frame_rate_hz
    segments = run_segments(drops, (frames - settle) / rate) if drops else ()
    return {settle + int(np.ceil(s.start_s * rate - 1e-6)): s for s in segments}


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
    segments = []
    for start_s, end_s in pairwise([*sorted(events), duration_s]):
        away = [drop for drop in drops if drop.start_s <= start_s < drop.end_s]
        missing = tuple(sorted({d.unit for d in away if d.reading == "missing"}))
        wrong = {d.unit: d.reading for d in away if d.unit not in missing}
        segments.append(Segment(start_s=start_s, end_s=end_s, missing=missing, wrong=wrong))
    return tuple(segments)


SHOWN_FRAMES = 120  # of a response, unless more are asked for
_SETTLED_BAND = 0.05  # part of the step


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopStep:
    """Response of an axis to a step of one on it."""

    axis: int  # the axis, from 0
    time_s: FloatArray  # (k,): time after the step [s]
    residual: FloatArray  # (k,): residual of that axis, as a part of the step
    command: FloatArray  # (k,): command of the same number, as a part of the step

    @property
    def overshoot_percent(self) -> float:
        """How far the correction goes beyond the step [%]."""
        return 100 * max(0.0, float(-np.min(self.residual)))

    @property
    def settling_s(self) -> float:
        """Time after which the residual stays within 5 % of the step [s]; nan if it does not."""
        outside = np.flatnonzero(np.abs(self.residual) > _SETTLED_BAND)
        after = int(outside[-1]) + 1 if outside.size else 0
        return float(self.time_s[after]) if after < self.time_s.size else float("nan")


def step_response(loop: ClosedLoop, *, axis: int = 0, frames: int = SHOWN_FRAMES) -> LoopStep:
    """Return the response of a loop to a step of the wavefront on an axis, without noise."""
    n = loop.hardware.modes
    own = integer(axis, "axis", at_least=0, below=n)
    inputs = np.zeros((integer(frames, "frames", at_least=1), n + loop.hardware.n_measurements))
    inputs[:, own] = 1.0
    outputs = filter_series(loop.system, inputs)
    return LoopStep(
        axis=own,
        time_s=frozen_copy(np.arange(len(inputs)) / loop.hardware.frame_rate_hz),
        residual=frozen_copy(outputs[:, own]),
        command=frozen_copy(outputs[:, n + min(own, loop.hardware.n_commands - 1)]),
    )
