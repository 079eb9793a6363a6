"""The exact residual of one closed loop, by origin: turbulence, vibrations, noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lbt_synth.linear import StateSpace
from lbt_synth.linear.quadrature import adaptive_integral, graded_edges
from lbt_synth.loop.closed_loop import ClosedLoop, require_loop_rate
from lbt_synth.loop.evaluator import STILL, Evaluator, ResidualBudget
from lbt_synth.loop.stable_range import append_taps
from lbt_synth.models import (
    ARModel,
    SinusoidalVibration,
    TipTiltPlant,
    Truth,
    Vibration,
)
from lbt_synth.models.mirror.frame_rate_system import Hold, instant_mirror
from lbt_synth.models.plant.seen_vibration import seen_vibration
from lbt_synth.models.sensor_suite import Motion, Motions, checked_motions
from lbt_synth.models.vibration import checked_direction
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy, require_instance


def residual_budget(
    loop: ClosedLoop, truth: Truth | TipTiltPlant, *, frame_means: bool = False
) -> ResidualBudget:
    """Exact stationary residual of a loop under a truth, as the camera sees it.

    Parameters
    ----------
    loop : ClosedLoop
        The loop; its sensor gain must be the truth's.
    truth : Truth or TipTiltPlant
        Disturbances. Where a plant's model is the truth, each mode has its own turbulence, and the
        processes are of means over frames; its turbulence, vibrations and noise enter any loop.
    frame_means : bool, optional
        Whether the phase of a frame is one number, as in a simulator that steps by frames. What
        moves within a frame is then left out, and rms and spectra are those of these numbers.

    Returns
    -------
    ResidualBudget
        Covariances by origin; means over the period of several sensors.

    Raises
    ------
    UnstableLoopError
        If the loop is unstable or marginally stable.
    ProblemError
        If a vibration, the turbulence or the noise does not fit the loop, or the sensor gains
        differ.

    Examples
    --------
    Noise through an integrator of gain g and delay 1 has the variance g / (2 - g):

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=1, modes=1)
    >>> lazy = lbt.Controller(A=1.0, B=0.5, C=1.0, D=0.0, dt_s=1 / 800)
    >>> loop = lbt.close_loop(path, lazy)
    >>> budget = lbt.residual_budget(loop, lbt.Truth(turbulence=None, noise_nm=3.0))
    >>> round(budget.noise_nm**2, 9)
    3.0

    Of a sinusoid of 20 Hz, ``1 - sinc^2(20/800)`` of the power moves within the frames:

    >>> line = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=797, direction=(1,))
    >>> shake = lbt.Truth(turbulence=None, vibrations=(line,))
    >>> round(lbt.residual_budget(loop, shake).within_nm, 1)
    36.1

    A Kalman filter leaves in its own model what it expects:

    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=15.5)
    >>> design = lbt.kalman(plant)
    >>> budget = lbt.residual_budget(design.close(plant.hardware), plant, frame_means=True)
    >>> bool(abs(budget.rms_nm / design.rms - 1) < 1e-9)
    True
    """
    require_instance(loop, ClosedLoop, "loop")
    loop.require_stable()
    if not hasattr(truth, "entering"):
        require_instance(truth, Truth)
    turbulence, lines, noise = truth.entering(loop.hardware, sensor_gain=loop.sensor_gain)
    of_means = frame_means or truth.is_of_means
    pairs = list(zip(lines, _motions(loop, truth.motions, len(lines)), strict=True))
    rows, n = loop_evaluator(loop, frame_means=frame_means), loop.hardware.modes
    steady = np.zeros((2, n, n))
    for spectrum, modes in turbulence:
        if isinstance(spectrum, ARModel):
            require_loop_rate(spectrum.frame_rate_hz, loop.hardware)
        steady += rows.of_turbulence(spectrum, np.eye(n)[None, :, list(modes)]).mean(axis=0)
    propagated = rows.of_noise(_noise_factor(loop, noise)[None]).mean(axis=0)
    shaken = np.zeros((2, n, n))
    amplitudes: list[ComplexArray] = []
    for line, motion in pairs:
        if isinstance(line, Vibration):
            shaken += _of_resonance(loop, rows, line, motion, of_means=of_means)
        else:
            f = np.full(len(rows.A), line.frequency_hz / loop.hardware.frame_rate_hz)
            entry = line.amplitude_nm * _sinusoid_entry(loop, line, motion)
            left, within = rows.of_sinusoids(f, entry[None])
            # what repeats with the period turns one sinusoid into several
            amplitudes += list(np.fft.fft(left, axis=0) / len(left))
            shaken[1] += within.mean(axis=0)
    return ResidualBudget(
        turbulence_nm2=frozen_copy(steady[0]),
        noise_nm2=frozen_copy(propagated[0]),
        random_vibration_nm2=frozen_copy(shaken[0]),
        within_nm2=frozen_copy(steady[1] + shaken[1] + propagated[1]),
        line_amplitudes_nm=np.array(amplitudes, dtype=np.complex128).reshape(-1, n),
    )


def model_readings(loop: ClosedLoop, plant: TipTiltPlant) -> FloatArray:
    """Return the covariance (q, q) of all readings in the first frame of a period."""
    every = _evaluator(loop, loop.system, None, in_image=False)
    parts = [every.shaken(_noise_factor(loop, plant.own_noise_factor))]
    for mode, model in enumerate(plant.turbulence):
        entry = np.eye(loop.system.B.shape[-1])[:, [mode]]
        parts.append(_driven(every, ar_process(model), entry))
    for line, motion in zip(plant.vibrations, plant.motions, strict=True):
        parts.append(_driven(every, *_shaken(loop, line, motion)))
    first = -plant.n_measurements
    return np.asarray(sum(part.output_covariances()[0, first:, first:] for part in parts))


def line_covariance(loop: ClosedLoop, line: Vibration) -> FloatArray:
    """Covariance (n, n) of the residual that a line leaves, in means over frames."""
    rows = loop_evaluator(loop, frame_means=True)
    return np.asarray(_of_resonance(loop, rows, line, {}, of_means=True)[0])


def noise_covariance(loop: ClosedLoop, factor: FloatArray) -> FloatArray:
    """Covariance of what noise of covariance ``factor factor'`` leaves in the image, (n, n)."""
    rows = loop_evaluator(loop, frame_means=False).of_noise(_noise_factor(loop, factor)[None])
    return np.asarray(rows.mean(axis=0).sum(axis=0))


def loop_evaluator(loop: ClosedLoop, *, frame_means: bool) -> Evaluator:
    """Return the evaluator of a loop, in the image or in means over frames."""
    hardware, s, n = loop.hardware, loop.system, loop.hardware.modes
    if frame_means or (hardware.mirror is None and hardware.delay_frames % 1 == 0):
        rows = replace(s, C=s.C[..., :n, :], D=s.D[..., :n, :])
        return _evaluator(loop, rows, None, in_image=not frame_means)
    hold, command = hardware.mirror_system.hold, slice(n, n + hardware.n_commands)
    # the states of the mirror follow those of the controller
    first, commands = loop.controller.n_states, (s.C[..., command, :], s.D[..., command, :])
    C, D = hold.positions(hardware.influence, commands, first)
    size = len(hold.D) * n
    C, D = C.reshape(*s.C.shape[:-2], size, -1), D.reshape(*s.D.shape[:-2], size, s.D.shape[-1])
    return _evaluator(loop, replace(s, C=C, D=D), hold, in_image=True)


def _evaluator(
    loop: ClosedLoop, rows: StateSpace, hold: Hold | None, *, in_image: bool
) -> Evaluator:
    """Return the evaluator of a system from a loop's inputs to rows."""
    s = rows.balanced() if rows.period == 1 else rows
    A, B, C, D = s.stacks()
    return Evaluator(
        A=A,
        B=B,
        C=C,
        D=D,
        modes=loop.hardware.modes,
        frame_rate_hz=loop.hardware.frame_rate_hz,
        roots=_roots(loop.system.poles, loop.system.period),
        hold=hold,
        start=np.full(s.period, loop.hardware.delay_frames - 1),
        in_image=in_image,
        phases=s.period,
    )


def _of_resonance(
    loop: ClosedLoop,
    rows: Evaluator,
    line: Vibration,
    motion: Mapping[str, Motion],
    *,
    of_means: bool,
) -> FloatArray:
    """Return what a resonance leaves, (2, n, n), whose rms is of means or of all moments."""
    if _moved_rows(loop, motion):
        return _of_seen(loop, rows, line, motion)
    rate = loop.hardware.frame_rate_hz
    share = 1.0 if of_means else float(np.sinc(line.frequency_hz / rate))
    model = replace(line, rms_nm=share * line.rms_nm).ar_model(rate)
    along = checked_direction(line, loop.hardware)
    driving_rms_nm = np.array([model.driving_rms_nm])
    left = rows.of_process(model.coefficients[None], driving_rms_nm, along[None, :, None])
    return np.asarray(left.mean(axis=0))


def _of_seen(
    loop: ClosedLoop, rows: Evaluator, line: Vibration, motion: Mapping[str, Motion]
) -> FloatArray:
    """Return what a line leaves that channels read, too, (2, n, n)."""
    process, entry = _shaken(loop, line, motion)
    n, rate = loop.hardware.modes, loop.hardware.frame_rate_hz
    driven = _driven(rows, process, entry)
    hold, along = rows.hold or STILL, entry[:n, :1]
    out = np.zeros((2, n, n))
    if rows.hold is None:
        out[0] = driven.output_covariances().mean(axis=0)
    if not rows.in_image:
        return out

    def density(f_hz: FloatArray) -> FloatArray:
        """Return the powers (f, 2, n, n) of the mean, and within."""
        f = f_hz / rate
        mean = process.phase_response(f_hz)[:, :1, 0]  # (f, 1, drives), of each phase
        moving = mean / np.sinc(f)[:, None, None]
        means = hold.phase_means(f) * np.exp(-1j * np.pi * f)[:, None]
        rest = 1 - np.abs(means) ** 2 @ hold.weights
        power = np.sum(np.abs(moving) ** 2, axis=(1, 2))
        left = np.zeros((f.size, 2, n, n))
        left[:, 1] = (power * rest)[:, None, None] * (along @ along.T)
        if rows.hold is not None:
            response = driven.system().phase_response(f_hz)
            positions = response.reshape(*response.shape[:2], -1, n, response.shape[-1])
            phase = means[:, None, :, None, None] * moving[:, :, None, None] * along
            of_mean = np.einsum("g,ftgid->ftid", hold.weights, phase - positions)
            apart, scale = phase - positions - of_mean[:, :, None], 1 / response.shape[1]
            left[:, 0] = scale * np.real(np.einsum("ftid,ftjd->fij", of_mean, of_mean.conj()))
            left[:, 1] += scale * np.real(
                np.einsum("g,ftgid,ftgjd->fij", hold.weights, apart, apart.conj())
            )
        return 2 / rate * left

    roots = np.concatenate([rows.roots, _roots(process.poles, process.period)])
    return out + adaptive_integral(density, graded_edges(roots) * rate / 2)


def _driven(rows: Evaluator, process: StateSpace, entry: FloatArray) -> Evaluator:
    """Return a loop from the drives of a process, whose phases are those of the loop."""
    A, B, C, _ = (stack[np.arange(rows.phases) % process.period] for stack in process.stacks())
    return rows.driven(A, B, C, entry[None])


def _motions(loop: ClosedLoop, motions: Motions, lines: int) -> Motions:
    """Return which channels each line moves: none where the loop reads its own sensor alone."""
    if not loop.reads_others:
        return ({},) * lines
    return checked_motions(motions, loop.hardware.suite, lines)


def _moved_rows(loop: ClosedLoop, motion: Mapping[str, Motion]) -> list[tuple[int, str]]:
    """Return the inputs of a loop at which channels read a line, and the channels, in order."""
    if not loop.reads_others:
        return []
    rows, n = loop.hardware.suite.rows(loop.hardware), loop.hardware.modes
    return [(n + rows[name].start, name) for name in loop.hardware.suite.channels if name in motion]


def _shaken(
    loop: ClosedLoop, line: Vibration, motion: Mapping[str, Motion]
) -> tuple[StateSpace, FloatArray]:
    """Return a line as a process, and how it enters a loop."""
    hardware, moved = loop.hardware, _moved_rows(loop, motion)
    entry = np.zeros((loop.system.B.shape[-1], 1 + len(moved)))
    entry[: hardware.modes, 0] = checked_direction(line, hardware)
    for column, (row, name) in enumerate(moved, start=1):
        entry[row, column] = name not in loop.blind
    if not moved:
        return ar_process(line.ar_model(hardware.frame_rate_hz)), entry
    return seen_vibration(line, motion, hardware.suite.accelerometers, hardware), entry


def _sinusoid_entry(
    loop: ClosedLoop, line: SinusoidalVibration, motion: Mapping[str, Motion]
) -> ComplexArray:
    """Return how a sinusoid of unit amplitude enters a loop, (n + q,)."""
    hardware, entry = loop.hardware, np.zeros(loop.system.B.shape[-1], dtype=np.complex128)
    entry[: hardware.modes] = checked_direction(line, hardware)
    of_channel = {
        name: sensor for sensor in hardware.suite.accelerometers for name in sensor.channels
    }
    for row, name in _moved_rows(loop, motion):
        if name not in loop.blind:
            entry[row] = of_channel[name].swing(motion[name], line.frequency_hz, hardware)
    return entry


def ar_process(model: ARModel) -> StateSpace:
    """Return the system from white noise to a process."""
    drive, output = np.zeros((2, model.order, 1))
    drive[0], output[0] = model.driving_rms_nm, 1.0
    D = np.zeros((1, 1))
    return StateSpace(A=model.companion, B=drive, C=output.T, D=D, dt_s=1 / model.frame_rate_hz)


def _noise_factor(loop: ClosedLoop, own: FloatArray) -> FloatArray:
    """Return the square root of the noise of all that a loop reads, (q, p)."""
    if not loop.reads_others:
        return own
    suite = loop.hardware.suite
    noise = suite.noise_factor(own, loop.hardware.modes)
    noise[suite.marked(loop.blind, loop.hardware)] = 0.0
    return np.asarray(noise)


def _roots(poles: ComplexArray, period: int) -> ComplexArray:
    """Return where the poles of a period show in a response: at each of their roots."""
    turns = np.exp(2j * np.pi * np.arange(period) / period)
    roots = np.abs(poles) ** (1 / period) * np.exp(1j * np.angle(poles) / period)
    return np.asarray((roots[:, None] * turns).ravel())


def resonance_edges(loop: ClosedLoop) -> FloatArray:
    """Panels of (0, Nyquist) [Hz] for a loop."""
    roots = _roots(loop.system.poles, loop.system.period)
    return graded_edges(roots) * loop.hardware.frame_rate_hz / 2


def settling_error(loop: ClosedLoop, truth: Truth) -> ResidualBudget:
    """Position of a settled mirror less the real one, for the commands that a loop gives.

    It is by how much the paper's equation 1, ``phi_cor(k-1) = N u(k-2)``, misses the position over
    the exposure; no residual, as the loop corrects for part of it.
    """
    return residual_budget(replace(loop, system=_difference_loop(loop)), truth, frame_means=True)


def _difference_loop(loop: ClosedLoop) -> StateSpace:
    """Return the loop to the settled mirror's position less the real one, phase less residual."""
    hardware, s, n = loop.hardware, loop.system, loop.hardware.modes
    if hardware.mirror is None:  # it leaves nothing, not even rounding
        return replace(s, C=0 * s.C[:n], D=0 * s.D[:n])
    settled = append_taps(loop.commanding(), instant_mirror(hardware.delay_frames).taps)
    C, D = hardware.influence @ settled.C, hardware.influence @ settled.D + s.D[:n]
    C[:, : s.n_states] += s.C[:n]
    D[:, :n] -= np.eye(n)
    return replace(settled, C=C, D=D)
