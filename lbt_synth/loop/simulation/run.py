"""Runs a loop in the time domain: random disturbances, any controller, all series."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.linear.estimator_form import EstimatorForm, RunningEstimator
from lbt_synth.linear.held_controller import HasController, as_controller
from lbt_synth.linear.state_space import RunningController
from lbt_synth.loop.closed_loop import ClosedLoop, close_loop
from lbt_synth.loop.simulation.disturbances import draw_disturbance, draw_noise
from lbt_synth.loop.strehl import Imaging, series_strehl
from lbt_synth.models import LoopHardware, Truth
from lbt_synth.storage.summaries import Summarised
from lbt_synth.validation import FloatArray, frozen_copy, integer, number

_SETTLED = 1e-4  # decay of the slowest mode after which a loop has settled
_MOST_SETTLING = 200_000  # frames
_DEFAULT_SETTLING = 1000  # frames
_MOST_GIGABYTES = 8.0


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
    """Series of a closed loop, after it has settled.

    Attributes
    ----------
    total_nm, residual_nm : (cases, frames, n) ndarray
        Phase before and after the correction [nm].
    commands : (cases, frames, m) ndarray
        Commands u(k), as the mirror applied them.
    measurements : (cases, frames, q) ndarray
        Measurements y(k).
    frame_rate_hz : float
        Frame rate [Hz].
    seed : int
        Seed of the random series.
    """

    total_nm: FloatArray
    residual_nm: FloatArray
    commands: FloatArray
    measurements: FloatArray
    frame_rate_hz: float
    seed: int

    def _brief(self) -> str:
        cases, frames, modes = self.residual_nm.shape
        return f"{cases} x {frames} frames of {modes} modes at {self.frame_rate_hz:g} Hz"

    @property
    def rms_nm(self) -> FloatArray:
        """Residual of each case over all modes [nm rms], (cases,)."""
        return np.asarray(np.sqrt(np.sum(np.mean(self.residual_nm**2, axis=1), axis=1)))

    def strehl(self, imaging: Imaging) -> FloatArray:
        """Long-exposure Strehl ratio of each case, (cases,)."""
        return np.array([series_strehl(case, imaging) for case in self.residual_nm])


def simulate(
    controller: Controller | EstimatorForm | HasController | SteppedController,
    truth: Truth,
    *,
    hardware: LoopHardware,
    frames: int,
    cases: int = 1,
    seed: int = 0,
    settle_frames: int | None = None,
    stroke: float | None = None,
) -> Simulation:
    """Close the loop in the time domain.

    The random series depend on the seed, the truth and the number of frames
    only: controllers that are given the same ones meet the same disturbances,
    if ``settle_frames`` is the same too. Time 0 of a vibration that drifts is the first frame
    that is kept.

    Parameters
    ----------
    controller : Controller, Design, EstimatorForm or object with ``step(y)`` and ``reset()``
        The controller; a :class:`Controller` runs at the speed of matrix products where the
        stroke is not limited. The form of :func:`~lbt_synth.linear.estimator_form` is given the
        commands that were applied.
    truth : Truth
        Disturbances, noise and sensor gain.
    hardware : LoopHardware
        Sensor, mirror and delay.
    frames : int
        Frames to keep.
    cases : int, optional
        Independent runs at once.
    seed : int, optional
        Seed of the random series.
    settle_frames : int, optional
        Frames run before and dropped; by default until the slowest mode of the
        loop has decayed to 1e-4 (1000 frames for a stepped controller).
    stroke : float, optional
        Largest modulus of a command that the mirror applies; without a limit by default.

    Returns
    -------
    Simulation
        The series.

    Raises
    ------
    UnstableLoopError
        If the loop of a :class:`Controller` is unstable or marginally stable.
    ProblemError
        If a value is out of range, sizes clash, or a stepped controller returns
        commands that are not finite.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> lazy = lbt.integrator(path, gain=0.5)
    >>> shake = lbt.Truth(
    ...     turbulence=None,
    ...     noise_nm=10.0,
    ...     vibrations=(lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100),),
    ... )
    >>> run = lbt.simulate(lazy.controller, shake, hardware=path, frames=4000)
    >>> exact = lbt.residual_budget(lbt.close_loop(path, lazy.controller), shake)
    >>> bool(abs(run.rms_nm[0] / exact.rms_nm - 1) < 0.05)
    True
    """
    frames = integer(frames, "frames", at_least=1)
    cases = integer(cases, "cases", at_least=1)
    seed = integer(seed, "seed", at_least=0)
    limit = np.inf if stroke is None else number(stroke, "stroke", above=0)
    if isinstance(controller, EstimatorForm):
        controller = controller.start()
    if isinstance(controller, SteppedController):
        default = _DEFAULT_SETTLING
    else:
        controller = as_controller(controller, others=", an object with step(y) and reset()")
        loop = close_loop(hardware, controller, sensor_gain=truth.sensor_gain)
        loop.require_stable()
        if loop.reads_others:
            raise ProblemError(
                "this run has readings of the loop's own sensor alone; got a controller of several "
                "sensors. Try lbt-synth simulate."
            )
        default = settling_frames(loop.spectral_radius)
    settle = default
    if settle_frames is not None:
        settle = integer(settle_frames, "settle_frames", at_least=0)
    channels = 2 * (hardware.modes + hardware.n_measurements) + hardware.n_commands
    gigabytes = 8e-9 * (settle + frames) * cases * channels
    if gigabytes > _MOST_GIGABYTES:
        raise ProblemError(
            f"frames x cases must fit into {_MOST_GIGABYTES:g} GB; got {frames} x {cases}, which "
            f"need {gigabytes:.3g} GB. Run fewer cases at once, with different seeds."
        )
    disturbance_rng, noise_rng = np.random.default_rng(seed).spawn(2)
    total = draw_disturbance(
        truth,
        hardware,
        frames=settle + frames,
        cases=cases,
        rng=disturbance_rng,
        zero_frame=settle,
    )
    noise = draw_noise(truth, hardware, frames=settle + frames, cases=cases, rng=noise_rng)
    if isinstance(controller, Controller) and stroke is None:
        outputs = filter_series(loop.system, np.concatenate([total, noise], axis=2))
    else:
        own = controller.start() if isinstance(controller, Controller) else controller
        outputs = step_loop(own, truth.sensor_gain, hardware, total, noise, stroke=limit)
    return record_run(total, outputs, hardware, settle=settle, seed=seed)


def record_run(
    total: FloatArray, outputs: FloatArray, hardware: LoopHardware, *, settle: int, seed: int
) -> Simulation:
    """Return the series of a loop after it has settled, from ``phi_res, u, y`` side by side."""
    n, m = hardware.modes, hardware.n_commands
    kept = outputs[:, settle:]
    return Simulation(
        total_nm=frozen_copy(total[:, settle:]),
        residual_nm=frozen_copy(kept[:, :, :n]),
        commands=frozen_copy(kept[:, :, n : n + m]),
        measurements=frozen_copy(kept[:, :, n + m :]),
        frame_rate_hz=hardware.frame_rate_hz,
        seed=seed,
    )


def settling_frames(radius: float) -> int:
    """Frames until the slowest mode of a loop of that spectral radius has decayed to 1e-4."""
    if radius <= 0:
        return 1
    return int(min(np.ceil(np.log(_SETTLED) / np.log(radius)), _MOST_SETTLING))


def step_controller(
    controller: SteppedController | RunningController | RunningEstimator,
    y: FloatArray,
    size: int,
    *,
    frame: int,
    applied: FloatArray | None = None,
) -> FloatArray:
    """Give a controller its measurements, and return its commands if they are finite.

    An estimator form is given the commands that were applied in the last frame, too.
    """
    if isinstance(controller, RunningEstimator):
        u = controller.step(y, applied)
    else:
        u = np.asarray(controller.step(y), dtype=np.float64)
    finite = bool(np.isfinite(u).all())
    if u.shape != (size,) or not finite:
        kind = "" if finite else " with values that are not finite"
        raise ProblemError(
            f"the controller must return {size} finite commands; got {u.shape}{kind} in frame "
            f"{frame}."
        )
    return u


def step_loop(
    controller: SteppedController | RunningController | RunningEstimator,
    sensor_gain: float,
    hardware: LoopHardware,
    total: FloatArray,
    noise: FloatArray,
    *,
    stroke: float = np.inf,
) -> FloatArray:
    """Run the loop one frame at a time, as written in :class:`LoopHardware`.

    The mirror clips commands at the stroke, which then are those applied.

    Return ``phi_res, u, y`` side by side, (cases, frames, n + m + q).
    """
    cases, frames, n = total.shape
    m, q = hardware.n_commands, hardware.n_measurements
    taps, sensor, influence = hardware.mirror_taps, hardware.sensor, hardware.influence
    out = np.zeros((cases, frames, n + m + q))
    for phase, white, left in zip(total, noise, out, strict=True):
        controller.reset()
        residual = np.zeros(n)
        commands = np.zeros((len(taps), m))  # u(k), u(k-1), ...
        residuals, applied, measured = np.split(left, [n, n + m], axis=1)
        for k in range(frames):
            y = sensor_gain * sensor @ residual + white[k]
            u = step_controller(controller, y, m, frame=k, applied=commands[0])
            commands[1:] = commands[:-1]
            commands[0] = u if stroke == np.inf else np.clip(u, -stroke, stroke)
            residual = phase[k] - influence @ (taps @ commands)
            residuals[k], applied[k], measured[k] = residual, commands[0], y
    return out


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
    """Return the response of a loop to a step of the wavefront.

    Parameters
    ----------
    loop : ClosedLoop
        The loop.
    axis : int, optional
        Axis on which the step is, from 0.
    frames : int, optional
        Frames from the step on.

    Returns
    -------
    LoopStep
        Without other disturbances or noise.

    Raises
    ------
    ProblemError
        If there is no such axis, or no frame.

    Examples
    --------
    Nothing reaches the mirror within the two frames of delay:

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> loop = lbt.close_loop(path, lbt.integrator(path, gain=0.5).controller)
    >>> lbt.loop.step_response(loop, frames=5).residual.tolist()
    [1.0, 1.0, 0.5, 0.0, -0.25]
    """
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
