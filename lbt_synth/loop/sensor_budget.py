"""What a loop that several sensors see leaves, exactly, as a mean over their common period."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lbt_synth.linear import StateSpace
from lbt_synth.linear.quadrature import adaptive_integral, panel_edges
from lbt_synth.loop.closed_loop import ClosedLoop, require_loop_rate
from lbt_synth.loop.residual import ResidualBudget
from lbt_synth.models import (
    ARModel,
    SinusoidalVibration,
    Spectrum,
    TipTiltPlant,
    Truth,
    Vibration,
)
from lbt_synth.models.plant.seen_vibration import seen_vibration
from lbt_synth.models.sensor_suite import Motion, checked_motions
from lbt_synth.models.spectra import breakpoints_below
from lbt_synth.models.vibration import checked_direction, stationary_vibrations
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy


def model_readings(loop: ClosedLoop, plant: TipTiltPlant) -> FloatArray:
    """Return the covariance of all readings in the first frame of a period, (q, q).

    A plant's model is the truth. In that frame every sensor is read.
    """
    systems = [_noise_system(loop, plant.own_noise_factor)]
    for mode, model in enumerate(plant.turbulence):
        systems.append(_driven_system(loop, _ar_process(model), _entry(loop, mode)))
    for line, motion in zip(plant.vibrations, plant.motions, strict=True):
        systems.append(_shaken_system(loop, line, motion))
    first = -plant.n_measurements
    return np.asarray(sum(s.output_covariances()[0, first:, first:] for s in systems))


def budget_of_sensors(loop: ClosedLoop, truth: Truth, noise_factor: FloatArray) -> ResidualBudget:
    """Return the exact stationary residual of a loop of several sensors, mean over the period.

    The noise factor is that of the loop's own sensor; the others have their own.
    """
    loop.require_stable()
    n = loop.hardware.modes
    turbulence, vibration = np.zeros((2, n, n))
    for spectrum, modes in truth.turbulence_groups(n):
        for mode in modes:
            turbulence += _power(loop, spectrum, _entry(loop, mode))
    lines = stationary_vibrations(truth.vibrations)
    moving = checked_motions(truth.motions, loop.hardware.suite, len(lines))
    amplitudes: list[ComplexArray] = []
    for line, motion in zip(lines, moving, strict=True):
        if isinstance(line, Vibration):
            vibration += residual_power(loop, _shaken_system(loop, line, motion))
        else:
            entry = _sinusoid_entry(loop, line, motion)
            response = _line_response(loop, entry, np.array([line.frequency_hz]))[0]
            # what repeats with the period turns one sinusoid into several
            amplitudes += list(line.amplitude_nm * np.fft.fft(response, axis=0) / len(response))
    return ResidualBudget(
        turbulence_nm2=frozen_copy(turbulence),
        noise_nm2=frozen_copy(residual_power(loop, _noise_system(loop, noise_factor))),
        random_vibration_nm2=frozen_copy(vibration),
        line_amplitudes_nm=np.array(amplitudes, dtype=np.complex128).reshape(len(amplitudes), n),
    )


def _entry(loop: ClosedLoop, mode: int) -> FloatArray:
    """Return how the phase of a mode enters a loop, (n + q, 1)."""
    return np.eye(loop.system.B.shape[-1], 1, -mode)


def _moved_rows(loop: ClosedLoop, motion: Mapping[str, Motion]) -> list[tuple[int, str]]:
    """Return the inputs of a loop at which channels read a line, and the channels, in order."""
    rows, n = loop.hardware.suite.rows(loop.hardware), loop.hardware.modes
    return [(n + rows[name].start, name) for name in loop.hardware.suite.channels if name in motion]


def _shaken_system(loop: ClosedLoop, line: Vibration, motion: Mapping[str, Motion]) -> StateSpace:
    """Return the system from the white drive of a line to all outputs of a loop."""
    hardware, moved = loop.hardware, _moved_rows(loop, motion)
    entry = np.zeros((loop.system.B.shape[-1], 1 + len(moved)))
    entry[: hardware.modes, 0] = checked_direction(line, hardware)
    for column, (row, name) in enumerate(moved, start=1):
        entry[row, column] = name not in loop.blind
    if not moved:
        return _driven_system(loop, _ar_process(line.ar_model(hardware.frame_rate_hz)), entry)
    seen = seen_vibration(line, motion, loop.hardware.suite.accelerometers, hardware)
    return _driven_system(loop, seen, entry)


def _sinusoid_entry(
    loop: ClosedLoop, line: SinusoidalVibration, motion: Mapping[str, Motion]
) -> ComplexArray:
    """Return how a sinusoid of unit amplitude enters a loop, (n + q, 1)."""
    hardware, entry = loop.hardware, np.zeros((loop.system.B.shape[-1], 1), dtype=np.complex128)
    entry[: hardware.modes, 0] = checked_direction(line, hardware)
    of_channel = {
        name: sensor for sensor in loop.hardware.suite.accelerometers for name in sensor.channels
    }
    for row, name in _moved_rows(loop, motion):
        if name not in loop.blind:
            entry[row] = of_channel[name].swing(motion[name], line.frequency_hz, hardware)
    return entry


def _power(loop: ClosedLoop, spectrum: Spectrum, entry: FloatArray) -> FloatArray:
    """Return the residual's covariance for a spectrum that enters as given, (n, n)."""
    if isinstance(spectrum, ARModel):
        require_loop_rate(spectrum.frame_rate_hz, loop.hardware)
        return residual_power(loop, _driven_system(loop, _ar_process(spectrum), entry))

    def density(frequency: FloatArray) -> FloatArray:
        response = _line_response(loop, entry, frequency)
        power = np.real(np.einsum("fti,ftj->fij", response, response.conj())) / response.shape[1]
        return np.asarray(spectrum.psd(frequency)[:, None, None] * power)

    rate = loop.hardware.frame_rate_hz
    poles, N = loop.system.poles, loop.system.period
    # a pole of the period shows at each of its roots
    turns = np.exp(2j * np.pi * np.arange(N) / N)
    roots = (np.abs(poles) ** (1 / N) * np.exp(1j * np.angle(poles) / N))[:, None] * turns
    edges = [panel_edges(roots, rate), breakpoints_below(spectrum, rate / 2)]
    return adaptive_integral(density, np.unique(np.concatenate(edges)))


def _line_response(
    loop: ClosedLoop, entry: FloatArray | ComplexArray, frequency_hz: FloatArray
) -> ComplexArray:
    """Return the residual at each phase for ``exp(2 pi i f k dt)`` that enters so, (f, N, n)."""
    used = np.flatnonzero(entry[:, 0])
    s, n = loop.system, loop.hardware.modes
    residual = replace(s, B=s.B[..., used], C=s.C[..., :n, :], D=s.D[..., :n, used])
    return np.asarray(residual.phase_response(frequency_hz) @ entry[used, 0])


def _ar_process(model: ARModel) -> StateSpace:
    """Return the system from white noise to a process."""
    drive, output = np.zeros((2, model.order, 1))
    drive[0], output[0] = model.driving_rms_nm, 1.0
    return StateSpace(A=model.companion, B=drive, C=output.T, D=np.zeros((1, 1)))


def _driven_system(loop: ClosedLoop, process: StateSpace, entry: FloatArray) -> StateSpace:
    """Return the system from the drive of a process to all outputs of a loop that it enters."""
    s = loop.system
    phases = np.arange(s.period) % process.period
    process_A, process_B, process_C = (stack[phases] for stack in process.stacks()[:3])
    samples = entry @ process_C
    size, n = s.n_states + process.n_states, s.n_states
    A, B = np.zeros((s.period, size, size)), np.zeros((s.period, size, process.B.shape[-1]))
    A[:, :n, :n], A[:, :n, n:], A[:, n:, n:] = s.A, s.B @ samples, process_A
    B[:, n:] = process_B
    C = np.concatenate([np.broadcast_to(s.C, (s.period, *s.C.shape[-2:])), s.D @ samples], axis=2)
    return StateSpace(A=A, B=B, C=C, D=np.zeros((C.shape[1], B.shape[2])), dt_s=s.dt_s)


def _noise_system(loop: ClosedLoop, own: FloatArray) -> StateSpace:
    """Return the system from white noise to all outputs of a loop."""
    n, s = loop.hardware.modes, loop.system
    noise = loop.hardware.suite.noise_factor(own, n)
    noise[loop.hardware.suite.marked(loop.blind, loop.hardware)] = 0.0
    return StateSpace(A=s.A, B=s.B[..., n:] @ noise, C=s.C, D=s.D[..., n:] @ noise, dt_s=s.dt_s)


def residual_power(loop: ClosedLoop, system: StateSpace) -> FloatArray:
    """Return the residual's covariance from white noise to a loop's outputs, mean over phases."""
    n = loop.hardware.modes
    return np.asarray(np.mean(system.output_covariances()[:, :n, :n], axis=0))
