"""The closed loop of a plant that several sensors see, and what it leaves, exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from lbt_synth.errors import ProblemError, UnstableLoopError
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.linear.quadrature import adaptive_integral, panel_edges
from lbt_synth.loop.closed_loop import (
    STABILITY_MARGIN,
    ClosedLoop,
    affine_radii,
    require_loop_rate,
)
from lbt_synth.loop.residual import ResidualBudget, require_true_gain
from lbt_synth.models import (
    ARModel,
    LoopHardware,
    SinusoidalVibration,
    Spectrum,
    Truth,
    Vibration,
)
from lbt_synth.models.fusion.plant import FusedPlant, memory, own_exposure, suite_exposures
from lbt_synth.models.fusion.seen_vibration import seen_vibration
from lbt_synth.models.fusion.sensors import OWN_SENSOR, Motion, SensorSuite, checked_motions
from lbt_synth.models.spectra import breakpoints_below
from lbt_synth.models.vibration import checked_direction, stationary_vibrations
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy, number


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusedLoop:
    """A loop around the controller of several sensors."""

    # from ``[phi_tot (n), added to each reading (q)]`` to ``[phi_res (n), u (m), y (q)]``
    system: StateSpace
    hardware: LoopHardware  # mirror, delay and own sensor
    suite: SensorSuite  # the other sensors
    controller: Controller  # the controller
    sensor_gain: float  # real gain of the loop's own sensor, relative to its matrix
    blind: tuple[str, ...] = ()  # sensors and channels whose readings are zero, or frozen

    @property
    def spectral_radius(self) -> float:
        """Spectral radius of the monodromy: of a period."""
        return self.system.spectral_radius

    @property
    def radius_per_frame(self) -> float:
        """What the slowest mode keeps from one frame to the next."""
        return self.system.radius_per_frame

    @property
    def is_stable(self) -> bool:
        """Whether the spectral radius is below 1 by more than 1e-9 per frame."""
        return self.radius_per_frame < 1 - STABILITY_MARGIN

    def require_stable(self) -> None:
        """Raise an UnstableLoopError if the loop is not stable."""
        if not self.is_stable:
            raise UnstableLoopError(
                f"the closed loop must be stable; got a spectral radius of "
                f"{self.spectral_radius:.6g} over a period of {self.system.period} frames at a "
                f"sensor gain of {self.sensor_gain:.6g}.",
                spectral_radius=self.spectral_radius,
            )


AnyLoop: TypeAlias = ClosedLoop | FusedLoop


def close_fused_loop(
    hardware: LoopHardware,
    suite: SensorSuite,
    controller: Controller,
    *,
    sensor_gain: float = 1.0,
    blind: tuple[str, ...] = (),
) -> FusedLoop:
    """Close the loop of several sensors, stable or not.

    The real gain of the loop's own sensor is relative to its matrix. ``blind`` names sensors whose
    readings do not follow the phase: they are zero, or frozen. A controller of other sizes or of
    another sampling period, or a name of no sensor, raises a ProblemError.
    """
    gain, period = number(sensor_gain, "sensor_gain", above=0), suite.period(hardware)
    rows = suite.rows(hardware)
    n, m, q = hardware.modes, hardware.n_commands, max(own.stop for own in rows.values())
    shape = (controller.period, *controller.D.shape[-2:])
    if shape != (period, m, q) or not np.isclose(controller.dt_s, hardware.dt_s, rtol=1e-9):
        raise ProblemError(
            f"the controller must map {q} measurements to {m} commands in a period of {period} "
            f"frames at {hardware.frame_rate_hz:.6g} Hz; got {shape[2]} to {shape[1]} in "
            f"{shape[0]} at {1 / controller.dt_s:.6g} Hz."
        )
    exposures = [own_exposure(hardware), *suite_exposures(suite, hardware)]
    held, k = memory(exposures, n, period), controller.to_statespace()
    mirror = hardware.mirror_system.whole
    A_m, B_m, C_m = mirror.repeated(m)
    position, direct = hardware.influence @ C_m, mirror.D * hardware.influence
    nk, nv, nh = k.n_states, len(A_m), held.n_states
    x, v, h = slice(nk), slice(nk, nk + nv), slice(nk + nv, nk + nv + nh)
    size = nk + nv + nh
    # y = measured s + e, u = command s + k.D e, phi_res = phi_tot + residual s - direct k.D e
    measured, command = np.zeros((period, q, size)), np.zeros((period, m, size))
    measured[:, : held.C.shape[1], h] = held.C
    measured[:, rows[OWN_SENSOR]] *= gain
    measured[:, suite.marked(blind, hardware)] = 0.0
    command[:, :, x] = k.C
    command += k.D @ measured
    residual = -direct @ command
    residual[:, :, v] -= position
    entry = np.zeros((period, n, n + q))
    entry[:, :, :n], entry[:, :, n:] = np.eye(n), -direct @ k.D
    A, B = np.zeros((period, size, size)), np.zeros((period, size, n + q))
    A[:, x] = k.B @ measured
    A[:, x, x] += k.A
    B[:, x, n:] = k.B
    A[:, v] = B_m @ command
    A[:, v, v] += A_m
    B[:, v, n:] = B_m @ k.D
    A[:, h] = held.B @ residual
    A[:, h, h] += held.A
    B[:, h] = held.B @ entry
    D = np.zeros((period, n + m + q, n + q))
    D[:, :n], D[:, n : n + m, n:], D[:, n + m :, n:] = entry, k.D, np.eye(q)
    C = np.concatenate([residual, command, measured], axis=1)
    system = StateSpace(A=A, B=B, C=C, D=D, dt_s=hardware.dt_s)
    return FusedLoop(
        controller=controller,
        system=system,
        hardware=hardware,
        suite=suite,
        sensor_gain=gain,
        blind=tuple(blind),
    )


def fused_radii_by_gain(
    hardware: LoopHardware, suite: SensorSuite, controller: Controller
) -> Callable[[FloatArray], FloatArray]:
    """Return the function from gains of the own sensor (g,) to spectral radii over a period (g,).

    Each phase of a loop is affine in this gain, so that two loops give all.
    """
    one, two = (
        close_fused_loop(hardware, suite, controller, sensor_gain=gain).system.stacks()[0]
        for gain in (1.0, 2.0)
    )
    return affine_radii(2 * one - two, two - one)


def fused_budget(loop: FusedLoop, truth: Truth) -> ResidualBudget:
    """Return the exact stationary residual of a fused loop under a truth, mean over the period.

    The loop has the truth's sensor gain. The noise is that of all sensors.
    """
    require_true_gain(loop.sensor_gain, truth)
    noise_nm = truth.noise_per_measurement(loop.hardware.n_measurements)
    return _budget(loop, truth, np.diag(noise_nm))


def fused_model_budget(loop: FusedLoop, plant: FusedPlant) -> ResidualBudget:
    """Return the exact residual of a loop where a plant's model is the truth."""
    own = plant.own
    truth = Truth(turbulence=own.turbulence, vibrations=own.vibrations, motions=plant.motions)
    return _budget(loop, truth, own.parts().noise_factor)


def model_readings(loop: FusedLoop, plant: FusedPlant) -> FloatArray:
    """Return the covariance of all readings in the first frame of a period, (q, q).

    A plant's model is the truth. In that frame every sensor is read.
    """
    own = plant.own
    systems = [_noise_system(loop, own.parts().noise_factor)]
    for mode, model in enumerate(own.turbulence):
        systems.append(_driven_system(loop, _ar_process(model), _entry(loop, mode)))
    for line, motion in zip(own.vibrations, plant.motions, strict=True):
        systems.append(_shaken_system(loop, line, motion))
    first = -plant.n_measurements
    return np.asarray(sum(s.output_covariances()[0, first:, first:] for s in systems))


def _budget(loop: FusedLoop, truth: Truth, noise_factor: FloatArray) -> ResidualBudget:
    loop.require_stable()
    hardware, n = loop.hardware, loop.hardware.modes
    turbulence, vibration = np.zeros((2, n, n))
    for spectrum, modes in truth.turbulence_groups(n):
        for mode in modes:
            turbulence += _power(loop, spectrum, _entry(loop, mode))
    lines = stationary_vibrations(truth.vibrations)
    moving = checked_motions(truth.motions, loop.suite, len(lines))
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


def _entry(loop: FusedLoop, mode: int) -> FloatArray:
    """Return how the phase of a mode enters a loop, (n + q, 1)."""
    return np.eye(loop.system.B.shape[-1], 1, -mode)


def _moved_rows(loop: FusedLoop, motion: Mapping[str, Motion]) -> list[tuple[int, str]]:
    """Return the inputs of a loop at which channels read a line, and the channels, in order."""
    rows, n = loop.suite.rows(loop.hardware), loop.hardware.modes
    return [(n + rows[name].start, name) for name in loop.suite.channels if name in motion]


def _shaken_system(
    loop: FusedLoop, line: Vibration, motion: Mapping[str, Motion]
) -> StateSpace:
    """Return the system from the white drive of a line to all outputs of a loop."""
    hardware, moved = loop.hardware, _moved_rows(loop, motion)
    entry = np.zeros((loop.system.B.shape[-1], 1 + len(moved)))
    entry[: hardware.modes, 0] = checked_direction(line, hardware)
    for column, (row, name) in enumerate(moved, start=1):
        entry[row, column] = name not in loop.blind
    if not moved:
        return _driven_system(loop, _ar_process(line.ar_model(hardware.frame_rate_hz)), entry)
    seen = seen_vibration(line, motion, loop.suite.accelerometers, hardware)
    return _driven_system(loop, seen, entry)


def _sinusoid_entry(
    loop: FusedLoop, line: SinusoidalVibration, motion: Mapping[str, Motion]
) -> ComplexArray:
    """Return how a sinusoid of unit amplitude enters a loop, (n + q, 1)."""
    hardware, entry = loop.hardware, np.zeros((loop.system.B.shape[-1], 1), dtype=np.complex128)
    entry[: hardware.modes, 0] = checked_direction(line, hardware)
    of_channel = {name: sensor for sensor in loop.suite.accelerometers for name in sensor.channels}
    for row, name in _moved_rows(loop, motion):
        if name not in loop.blind:
            entry[row] = of_channel[name].swing(motion[name], line.frequency_hz, hardware)
    return entry


def _power(loop: FusedLoop, spectrum: Spectrum, entry: FloatArray) -> FloatArray:
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
    loop: FusedLoop, entry: FloatArray | ComplexArray, frequency_hz: FloatArray
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


def _driven_system(loop: FusedLoop, process: StateSpace, entry: FloatArray) -> StateSpace:
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


def _noise_system(loop: FusedLoop, own: FloatArray) -> StateSpace:
    """Return the system from white noise to all outputs of a loop."""
    n, s = loop.hardware.modes, loop.system
    noise = loop.suite.noise_factor(own, n)
    noise[loop.suite.marked(loop.blind, loop.hardware)] = 0.0
    return StateSpace(A=s.A, B=s.B[..., n:] @ noise, C=s.C, D=s.D[..., n:] @ noise, dt_s=s.dt_s)


def residual_power(loop: FusedLoop, system: StateSpace) -> FloatArray:
    """Return the residual's covariance from white noise to a loop's outputs, mean over phases."""
    n = loop.hardware.modes
    return np.asarray(np.mean(system.output_covariances()[:, :n, :n], axis=0))
