"""The exact residual of one closed loop, by origin: turbulence, vibrations, noise.

The camera sees the phase less the mirror's position at every moment. A command holds for one frame
from its arrival on, so that the mean square over a frame is that of the mean over the hold, less
the mirror, and of what moves within the hold. With a settled mirror the second is the phase's own:
no command follows it (C. Kulcsar, H.-F. Raynaud, C. Petit, J.-M. Conan, P. Viaris de Lesegno, Opt.
Express 14, 7464 (2006), doi:10.1364/OE.14.007464).

White noise and sampled processes are solved by Lyapunov equations where a hold is a frame, spectra
by adaptive quadrature on panels that crowd at the loop's resonances, sinusoids by the frequency
response. A sampled process is one of means over frames, whose density in the continuous phase is
larger by ``1 / sinc^2(f / f_s)``; spectra, and the rms of vibrations, are of the continuous phase.
Nothing lies above half the frame rate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.errors import ProblemError
from lbt_synth.linear import StateSpace
from lbt_synth.linear.quadrature import adaptive_integral, panel_edges
from lbt_synth.loop.closed_loop import ClosedLoop, require_loop_rate
from lbt_synth.loop.residual import ResidualBudget, require_true_gain
from lbt_synth.models import (
    ARModel,
    SinusoidalVibration,
    Spectrum,
    TipTiltPlant,
    Truth,
    Vibration,
)
from lbt_synth.models.mirror.frame_rate_system import Hold
from lbt_synth.models.plant.seen_vibration import seen_vibration
from lbt_synth.models.sensor_suite import Motion, Motions, checked_motions
from lbt_synth.models.spectra import breakpoints_below, spectrum_density
from lbt_synth.models.vibration import checked_direction, stationary_vibrations
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy, require_instance


def residual_budget(loop: ClosedLoop, truth: Truth, *, frame_means: bool = False) -> ResidualBudget:
    """Exact stationary residual of a loop under a truth, as the camera sees it.

    Parameters
    ----------
    loop : ClosedLoop
        The loop; its sensor gain must be the truth's.
    truth : Truth
        Disturbances.
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
    """
    require_instance(loop, ClosedLoop, "loop")
    loop.require_stable()
    require_true_gain(loop.sensor_gain, truth)
    n, noise_nm = loop.hardware.modes, truth.noise_per_measurement(loop.hardware.n_measurements)
    view = _view(loop, frame_means=frame_means)
    turbulence, vibration = np.zeros((2, 2, n, n))
    for spectrum, modes in truth.turbulence_groups(n):
        turbulence += view.of_spectrum(spectrum, _entry(loop, modes))
    lines = stationary_vibrations(truth.vibrations)
    amplitudes: list[ComplexArray] = []
    moving = _motions(loop, truth.motions, len(lines))
    resonances = []
    for line, motion in zip(lines, moving, strict=True):
        if isinstance(line, Vibration):
            resonances.append((line, motion))
        else:
            harmonics, within = view.of_sinusoid(line, motion)
            vibration[1] += within
            amplitudes += list(harmonics)
    vibration += view.of_lines(resonances, of_means=frame_means)
    return _make_budget(turbulence, vibration, view.of_noise(np.diag(noise_nm)), amplitudes)


def model_budget(
    loop: ClosedLoop, plant: TipTiltPlant, *, frame_means: bool = False
) -> ResidualBudget:
    """Exact stationary residual of a loop where a plant's model is the truth.

    Each mode has its own turbulence and each measurement its own noise, as in the plant. The
    processes of a plant are of means over frames.

    Parameters
    ----------
    loop : ClosedLoop
        A loop of the plant's hardware, around any controller.
    plant : TipTiltPlant
        Turbulence, vibrations and noise.
    frame_means : bool, optional
        As in :func:`residual_budget`.

    Returns
    -------
    ResidualBudget
        Covariances by origin.

    Raises
    ------
    UnstableLoopError
        If the loop is unstable or marginally stable.
    ProblemError
        If the loop has another sensor, mirror or delay than the plant.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=15.5)
    >>> design = lbt.kalman(plant)
    >>> loop = lbt.close_loop(plant.hardware, design.controller)
    >>> budget = lbt.loop.model_budget(loop, plant, frame_means=True)
    >>> bool(abs(budget.rms_nm / design.rms - 1) < 1e-9)
    True
    """
    require_instance(plant, TipTiltPlant)
    require_instance(loop, ClosedLoop)
    one, other = loop.hardware, plant.hardware
    pairs = [(loop.sensor_gain * one.sensor, other.sensor), (one.influence, other.influence)]
    alike = (
        all(a.shape == b.shape and np.allclose(a, b, rtol=1e-9, atol=0) for a, b in pairs)
        and one.delay_frames == other.delay_frames
        and one.mirror == other.mirror
    )
    if not alike:
        raise ProblemError(
            "the loop must have the plant's sensor, mirror and delay; got another. Close it with "
            "close_loop(plant.hardware, controller)."
        )
    return plant_budget(loop, plant, frame_means=frame_means)


def plant_budget(
    loop: ClosedLoop, plant: TipTiltPlant, *, frame_means: bool = False
) -> ResidualBudget:
    """Return what a plant's disturbances and noise leave in any loop, at its own sensor gain."""
    loop.require_stable()
    view = _view(loop, frame_means=frame_means)
    turbulence = np.zeros((2, loop.hardware.modes, loop.hardware.modes))
    for mode, model in enumerate(plant.turbulence):
        turbulence += view.of_spectrum(model, _entry(loop, [mode]))
    moving = _motions(loop, plant.motions, len(plant.vibrations))
    pairs = list(zip(plant.vibrations, moving, strict=True))
    vibration = view.of_lines(pairs, of_means=True)
    return _make_budget(turbulence, vibration, view.of_noise(plant.own_noise_factor), [])


def model_readings(loop: ClosedLoop, plant: TipTiltPlant) -> FloatArray:
    """Return the covariance of all readings in the first frame of a period, (q, q).

    A plant's model is the truth. In that frame every sensor is read.
    """
    systems = [_noise_system(loop, loop.system, plant.own_noise_factor)]
    for mode, model in enumerate(plant.turbulence):
        systems.append(_driven_system(loop.system, ar_process(model), _entry(loop, [mode])))
    for line, motion in zip(plant.vibrations, plant.motions, strict=True):
        process, entry = _shaken(loop, line, motion)
        systems.append(_driven_system(loop.system, process, entry))
    first = -plant.n_measurements
    return np.asarray(sum(s.output_covariances()[0, first:, first:] for s in systems))


def line_covariance(loop: ClosedLoop, line: Vibration) -> FloatArray:
    """Covariance (n, n) of the residual that a line leaves, in means over frames."""
    return np.asarray(_view(loop, frame_means=True).of_lines([(line, {})], of_means=True)[0])


def noise_covariance(loop: ClosedLoop, factor: FloatArray) -> FloatArray:
    """Covariance of what noise of covariance ``factor factor'`` leaves in the image, (n, n)."""
    return np.asarray(np.sum(_view(loop, frame_means=False).of_noise(factor), axis=0))


def _make_budget(
    turbulence: FloatArray,
    vibration: FloatArray,
    noise: FloatArray,
    amplitudes: list[ComplexArray],
) -> ResidualBudget:
    """Return the budget of pairs of covariances: of the means, and of what moves within."""
    shape = len(amplitudes), turbulence.shape[-1]
    return ResidualBudget(
        turbulence_nm2=frozen_copy(turbulence[0]),
        noise_nm2=frozen_copy(noise[0]),
        random_vibration_nm2=frozen_copy(vibration[0]),
        within_nm2=frozen_copy(turbulence[1] + vibration[1] + noise[1]),
        line_amplitudes_nm=np.array(amplitudes, dtype=np.complex128).reshape(shape),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """What of a loop counts as its residual.

    Without pieces it is the mean over a frame, and the rows of the system are the residual. With
    pieces they are the mirror's mean positions in the pieces of a hold. What it returns are pairs
    (2, n, n): the covariance of the mean, and of what moves within a frame.
    """

    loop: ClosedLoop
    system: StateSpace  # from [phi_tot, noise] to the residual (n), or to the positions (g n)
    pieces: Hold | None
    in_image: bool  # whether what moves within a frame counts

    def of_spectrum(self, spectrum: Spectrum, entry: FloatArray) -> FloatArray:
        """Return what phases of a spectrum leave, or of a sampled process, one for each column."""
        if isinstance(spectrum, ARModel):
            require_loop_rate(spectrum.frame_rate_hz, self.loop.hardware)
            process = ar_process(spectrum)
            return np.asarray(sum(self.of_process(process, one[:, None]) for one in entry.T))

        def density(frequency: FloatArray) -> FloatArray:
            pieces, rest = self._residuals(frequency, entry)
            power = self._powers(pieces, rest, entry)
            return np.asarray(spectrum_density(spectrum, frequency)[:, None, None, None] * power)

        kinks = breakpoints_below(spectrum, self.loop.hardware.frame_rate_hz / 2)
        return self._integral(density, kinks)

    def of_lines(
        self, lines: Sequence[tuple[Vibration, Mapping[str, Motion]]], *, of_means: bool
    ) -> FloatArray:
        """Return what resonances leave, whose rms is of means over frames, or of all moments.

        Those of one direction that no channel sees are one process.
        """
        n = self.loop.hardware.modes
        out = np.zeros((2, n, n))
        shared: dict[bytes, tuple[FloatArray, list[StateSpace]]] = {}
        for line, motion in lines:
            seen = bool(_moved_rows(self.loop, motion))
            if not (of_means or seen):
                share = float(np.sinc(line.frequency_hz / self.loop.hardware.frame_rate_hz))
                line = replace(line, rms_nm=share * line.rms_nm)
            process, entry = _shaken(self.loop, line, motion)
            if seen:
                out += self.of_process(process, entry)
            else:
                shared.setdefault(entry.tobytes(), (entry, []))[1].append(process)
        for entry, processes in shared.values():
            out += self.of_process(_sum_of(processes), entry)
        return out

    def of_process(self, process: StateSpace, entry: FloatArray) -> FloatArray:
        """Return what a process of means over frames leaves, the first of what enters."""
        driven = _driven_system(self.system, process, entry)
        n = self.loop.hardware.modes
        out = np.zeros((2, n, n))
        if self.pieces is None:
            out[0] = np.mean(driven.output_covariances(), axis=0)
        if not self.in_image:
            return out
        rate = self.loop.hardware.frame_rate_hz

        def density(frequency: FloatArray) -> FloatArray:
            mean = process.phase_response(frequency)[:, :1, 0]  # (f, 1, drives), of each phase
            moving = mean / np.sinc(frequency / rate)[:, None, None]
            means, rest = self._phase_means(frequency)
            alone = np.sum(np.abs(moving) ** 2, axis=(1, 2))
            if self.pieces is None:
                pieces = np.zeros((*moving.shape[:2], 1, n, moving.shape[2]))
            elif entry.shape[1] == 1 and process.period == 1:  # the phase is all that enters
                unit = self._powers(*self._residuals(frequency, entry), entry)
                return np.asarray(2 / rate * alone[:, None, None, None] * unit)
            else:
                response = driven.phase_response(frequency)
                positions = response.reshape(*response.shape[:2], -1, n, response.shape[-1])
                phase = means[:, None, :, None, None] * moving[:, :, None, None]
                pieces = phase * entry[:n, :1] - positions
            power = np.sum(np.abs(moving) ** 2, axis=2)[:, 0] * rest
            return 2 / rate * self._powers(pieces, power, entry[:, :1])

        edges = panel_edges(_roots(process.poles, process.period), rate)
        return out + self._integral(density, edges[(edges > 0) & (edges < rate / 2)])

    def of_sinusoid(
        self, line: SinusoidalVibration, motion: Mapping[str, Motion]
    ) -> tuple[ComplexArray, FloatArray]:
        """Return the amplitudes of the means, (N, n), and the covariance of what moves within.

        What repeats with the period turns one sinusoid into several.
        """
        entry = _sinusoid_entry(self.loop, line, motion)
        pieces, rest = self._residuals(np.array([line.frequency_hz]), entry)
        within = line.rms_nm**2 * self._powers(pieces, rest, entry)[0, 1]
        mean = np.einsum("g,tgi->ti", self._weights, pieces[0, ..., 0])
        if self.pieces is not None:  # with the phase that it has in its own hold
            turn = line.frequency_hz / self.loop.hardware.frame_rate_hz * self.pieces.start
            mean = mean * np.exp(-2j * np.pi * turn)
        return line.amplitude_nm * np.fft.fft(mean, axis=0) / len(mean), within

    def of_noise(self, factor: FloatArray) -> FloatArray:
        """Return what white noise of covariance ``factor factor'`` leaves; others have theirs."""
        n = self.loop.hardware.modes
        covariance = _noise_system(self.loop, self.system, factor).output_covariances().mean(axis=0)
        blocks = covariance.reshape(-1, n, covariance.shape[0] // n, n)
        w = self._weights
        mean = np.einsum("g,gihj,h->ij", w, blocks, w)
        return np.array([mean, np.einsum("g,gigj->ij", w, blocks) - mean])

    @property
    def _weights(self) -> FloatArray:
        """Lengths of the pieces [frames], (g,)."""
        return np.ones(1) if self.pieces is None else self.pieces.weights

    def _phase_means(self, frequency_hz: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Means of a unit phase over the pieces, (f, g), and the power that moves within, (f,)."""
        f = frequency_hz / self.loop.hardware.frame_rate_hz
        if self.pieces is None:
            means = np.sinc(f)[:, None].astype(np.complex128)
        else:  # as seen from the middle of the frame, where the mean has its phase
            means = self.pieces.phase_means(f) * np.exp(-1j * np.pi * f)[:, None]
        return means, 1 - np.abs(means) ** 2 @ self._weights

    def _residuals(
        self, frequency_hz: FloatArray, entry: FloatArray | ComplexArray
    ) -> tuple[ComplexArray, FloatArray]:
        """Residual in each piece of unit phases, (f, N, g, n, w), and the power within, (f,).

        The phases enter by the columns (n + q, w).
        """
        n, width = self.loop.hardware.modes, entry.shape[1]
        used = np.flatnonzero(np.any(entry, axis=1))
        s = replace(self.system, B=self.system.B[..., used], D=self.system.D[..., used])
        share = np.ones(len(frequency_hz))  # of a unit phase that the mean over a frame is
        means, rest = self._phase_means(frequency_hz)
        if self.in_image:
            share = np.sinc(frequency_hz / self.loop.hardware.frame_rate_hz)
        enters = np.where(used < n, share[:, None], 1.0)[..., None] * entry[used]
        response = np.einsum("ftiu,fuw->ftiw", s.phase_response(frequency_hz), enters)
        pieces = response.reshape(*response.shape[:2], -1, n, width)
        if self.pieces is not None:
            pieces = means[:, None, :, None, None] * entry[:n] - pieces
        return pieces, rest * self.in_image

    def _powers(self, pieces: ComplexArray, rest: FloatArray, entry: Any) -> FloatArray:
        """Powers (f, 2, n, n) of the mean and within, from pieces (f, N, g, n, w) and the rest."""
        n, w = self.loop.hardware.modes, self._weights
        mean = np.einsum("g,ftgiw->ftiw", w, pieces)
        apart = pieces - mean[:, :, None]
        scale = 1 / pieces.shape[1]
        out = np.empty((len(pieces), 2, n, n))
        out[:, 0] = scale * np.real(np.einsum("ftiw,ftjw->fij", mean, mean.conj()))
        out[:, 1] = scale * np.real(np.einsum("g,ftgiw,ftgjw->fij", w, apart, apart.conj()))
        along = np.real(entry[:n])
        out[:, 1] += rest[:, None, None] * (along @ along.T)
        return out

    def _integral(
        self, density: Callable[[FloatArray], FloatArray], edges_hz: FloatArray
    ) -> FloatArray:
        """Integrate over (0, Nyquist), on panels around the loop's poles and further edges."""
        edges = [resonance_edges(self.loop), edges_hz]
        return adaptive_integral(density, np.unique(np.concatenate(edges)))


def _view(loop: ClosedLoop, *, frame_means: bool) -> _View:
    """Return the residual of a loop in the image, or in means over frames."""
    hardware, s, n = loop.hardware, loop.system, loop.hardware.modes
    if frame_means or (hardware.mirror is None and hardware.delay_frames % 1 == 0):
        rows = replace(s, C=s.C[..., :n, :], D=s.D[..., :n, :])
        return _View(loop, _balanced(rows), None, not frame_means)
    pieces, command = hardware.mirror_system.hold, slice(n, n + hardware.n_commands)
    # the states of the mirror follow those of the controller
    first, commands = loop.controller.n_states, (s.C[..., command, :], s.D[..., command, :])
    C, D = pieces.positions(hardware.influence, commands, first)
    shape = len(pieces.D) * n
    C, D = C.reshape(*s.C.shape[:-2], shape, -1), D.reshape(*s.D.shape[:-2], shape, s.D.shape[-1])
    return _View(loop, _balanced(replace(s, C=C, D=D)), pieces, True)


def _balanced(system: StateSpace) -> StateSpace:
    """Return a system in states of comparable units, in which its response keeps its digits."""
    return system.balanced() if system.period == 1 else system


def _sum_of(processes: Sequence[StateSpace]) -> StateSpace:
    """Return the sum of processes of one output, each with its own drive."""
    A, B = (block_diag(*(getattr(one, name) for one in processes)) for name in "AB")
    C = np.hstack([one.C for one in processes])
    return replace(processes[0], A=A, B=B, C=C, D=np.zeros((1, B.shape[1])))


def _entry(loop: ClosedLoop, modes: Sequence[int]) -> FloatArray:
    """Return how the phases of modes enter a loop, (n + q, w)."""
    return np.eye(loop.system.B.shape[-1])[:, list(modes)]


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
    """Return how a sinusoid of unit amplitude enters a loop, (n + q, 1)."""
    hardware, entry = loop.hardware, np.zeros((loop.system.B.shape[-1], 1), dtype=np.complex128)
    entry[: hardware.modes, 0] = checked_direction(line, hardware)
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


def _driven_system(s: StateSpace, process: StateSpace, entry: FloatArray) -> StateSpace:
    """Return the system from the drive of a process to the outputs of one that it enters.

    The process x(k + 1) = A x(k) + B w(k) has acted by the time of its newest sample.
    """
    phases = np.arange(s.period) % process.period
    process_A, process_B, process_C = (stack[phases] for stack in process.stacks()[:3])
    samples = entry @ process_C
    loop_A, loop_B, loop_C, loop_D = s.stacks()
    size, n = s.n_states + process.n_states, s.n_states
    A, B = np.zeros((s.period, size, size)), np.zeros((s.period, size, process.B.shape[-1]))
    A[:, :n, :n], A[:, :n, n:], A[:, n:, n:] = loop_A, loop_B @ samples, process_A
    B[:, n:] = process_B
    C = np.concatenate([loop_C, loop_D @ samples], axis=2)
    D = np.zeros((C.shape[1], B.shape[2]))
    if s.period == 1:
        return StateSpace(A=A[0], B=B[0], C=C[0], D=D, dt_s=s.dt_s)
    return StateSpace(A=A, B=B, C=C, D=D, dt_s=s.dt_s)


def _noise_system(loop: ClosedLoop, s: StateSpace, own: FloatArray) -> StateSpace:
    """Return the system from white noise to the outputs of a system of the loop's inputs."""
    n, hardware = loop.hardware.modes, loop.hardware
    noise = own
    if loop.reads_others:
        noise = hardware.suite.noise_factor(own, n)
        noise[hardware.suite.marked(loop.blind, hardware)] = 0.0
    return StateSpace(A=s.A, B=s.B[..., n:] @ noise, C=s.C, D=s.D[..., n:] @ noise, dt_s=s.dt_s)


def _roots(poles: ComplexArray, period: int) -> ComplexArray:
    """Return where the poles of a period show in a response: at each of their roots."""
    turns = np.exp(2j * np.pi * np.arange(period) / period)
    roots = np.abs(poles) ** (1 / period) * np.exp(1j * np.angle(poles) / period)
    return np.asarray((roots[:, None] * turns).ravel())


def resonance_edges(loop: ClosedLoop) -> FloatArray:
    """Panels of (0, Nyquist) [Hz] for a loop."""
    roots = _roots(loop.system.poles, loop.system.period)
    return panel_edges(roots, loop.hardware.frame_rate_hz)


def settling_error(loop: ClosedLoop, truth: Truth) -> ResidualBudget:
    """Position of a settled mirror less the real one, for the commands that a loop gives.

    The paper's equation 1, ``phi_cor(k-1) = N u(k-2)`` (at its delay of two frames), is exact
    for a mirror that settles at once; this is by how much it misses the position averaged
    over the exposure. It is no residual: the loop corrects for part of it.

    Parameters
    ----------
    loop : ClosedLoop
        The loop, with the real mirror in its hardware.
    truth : Truth
        Disturbances; its sensor gain must be the loop's.

    Returns
    -------
    ResidualBudget
        Covariances of the difference, by origin; ``rms_nm`` is its size.

    Raises
    ------
    UnstableLoopError
        If the loop is unstable or marginally stable.
    ProblemError
        If a vibration does not fit the loop, or the sensor gains differ.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> shell = lbt.models.PositionLoop.from_bandwidth(
    ...     natural_frequency_hz=50, damping=0.5, bandwidth_hz=500
    ... )
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1, mirror=shell)
    >>> shake = lbt.Truth(
    ...     turbulence=None,
    ...     noise_nm=1.0,
    ...     vibrations=(
    ...         lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100, direction=(1,)),
    ...     ),
    ... )
    >>> loop = lbt.close_loop(path, lbt.integrator(path, gain=0.3).controller)
    >>> missed = lbt.loop.settling_error(loop, shake)
    >>> 0 < missed.rms_nm < lbt.residual_budget(loop, shake).rms_nm
    True
    """
    return residual_budget(replace(loop, system=_difference_loop(loop)), truth, frame_means=True)


def _difference_loop(loop: ClosedLoop) -> StateSpace:
    """Loop whose first outputs are the settled mirror's position less the real one."""
    s, n, m = loop.system, loop.hardware.modes, loop.hardware.n_commands
    if loop.hardware.mirror is None:  # it leaves nothing, not even rounding
        C, D = np.vstack([0 * s.C[:n], s.C[n:]]), np.vstack([0 * s.D[:n], s.D[n:]])
        return replace(s, C=C, D=D)
    ideal = replace(loop.hardware, mirror=None).mirror_system.whole
    real = loop.hardware.mirror_system.whole
    each, influence = np.eye(m), loop.hardware.influence
    command, through = s.C[n : n + m], s.D[n : n + m]
    entry = np.kron(np.concatenate([ideal.B, real.B])[:, None], each)
    position = influence @ np.kron(np.concatenate([ideal.C, -real.C]), each)
    direct = (ideal.D - real.D) * influence
    past = np.kron(block_diag(ideal.A, real.A), each)
    return StateSpace(
        A=np.block([[s.A, np.zeros((s.n_states, len(past)))], [entry @ command, past]]),
        B=np.vstack([s.B, entry @ through]),
        C=np.block([[direct @ command, position], [s.C[n:], np.zeros((len(s.C) - n, len(past)))]]),
        D=np.vstack([direct @ through, s.D[n:]]),
        dt_s=s.dt_s,
    )
