"""An ensemble of loops, and exact residuals by origin of controllers in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear import Controller
from lbt_synth.linear.controller import as_controller
from lbt_synth.loop.closed_loop import require_loop_rate, require_matching_controller
from lbt_synth.loop.evaluator import ResidualBudget
from lbt_synth.loop.stacks import LoopStack, close_loops, stack_evaluator
from lbt_synth.models import (
    ARModel,
    Atmosphere,
    LoopHardware,
    SinusoidalVibration,
    Spectrum,
    Vibration,
)
from lbt_synth.models.loop_hardware import LONGEST_DELAY
from lbt_synth.models.spectra import spectrum_key
from lbt_synth.models.vibration import sampled_lines
from lbt_synth.validation import (
    BoolArray,
    FloatArray,
    IntArray,
    frozen_copy,
    positive,
    read_only,
    real_array,
    require_instance,
    sequence,
    set_fields,
)

_TOGETHER = 2048  # loops with the same frequencies: as many as repay their panels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EnsembleVibration:
    """A vibration that differs between p loops.

    Parameters
    ----------
    frequency_hz : float or (p,) array_like
        Frequency [Hz].
    rms_nm : float or (p,) array_like
        Standard deviation along its direction [nm rms wavefront].
    direction : (n,) or (p, n) array_like, optional
        Direction over the modes, made a unit vector; along the first of two by default.
    damping : float or (p,) array_like, optional
        Damping ratio, above 0; without it the vibration is a sinusoid.
    sections : int, optional
        Resonances in series, of a bump.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> line = lbt.loop.EnsembleVibration(frequency_hz=[19.5, 20.0, 20.5], rms_nm=563.6)
    >>> line.damping is None
    True
    """

    frequency_hz: Any
    rms_nm: Any
    direction: Any = (1.0, 0.0)
    damping: Any = None
    sections: int = 1

    def __post_init__(self) -> None:
        for name in ("frequency_hz", "rms_nm", "damping"):
            if getattr(self, name) is not None:
                set_fields(self, **{name: positive(getattr(self, name), name)})
        direction = real_array(self.direction, "direction")
        size = np.linalg.norm(np.atleast_1d(direction), axis=-1, keepdims=True)
        if direction.ndim not in (1, 2) or not np.all(size > 0):
            wanted = "a vector over the modes, or one per loop, and not zero"
            raise ProblemError(f"direction must be {wanted}; got shape {direction.shape}.")
        set_fields(self, direction=frozen_copy(direction / size))


def ensemble_vibration(vibration: Vibration | SinusoidalVibration) -> EnsembleVibration:
    """Return a vibration as all loops meet it."""
    return EnsembleVibration(
        frequency_hz=vibration.frequency_hz,
        rms_nm=vibration.rms_nm,
        direction=vibration.direction,
        damping=vibration.damping if isinstance(vibration, Vibration) else None,
        sections=vibration.sections if isinstance(vibration, Vibration) else 1,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopEnsemble:
    """Conditions of p loops with the same sensor and mirror.

    Parameters
    ----------
    sensor_gain : float or (p,) array_like, optional
        Real sensor gain of each loop relative to the sensor matrix.
    delay_frames : float or (p,) array_like, optional
        Real total delay [frames], 1 to 20; that of the loop by default.
    noise_nm : float, (p,) or (p, q) array_like, optional
        Standard deviation of the noise on each measurement per frame [nm].
    turbulence : Spectrum, sequence of Spectrum or None, optional
        Spectrum of each mode, the modes independent: one for all of them, or one per mode. A
        An Atmosphere or an ARModel that is a stack holds one per loop.
    vibrations : sequence of EnsembleVibration, optional
        The vibrations.
    loops : int, optional
        Number of loops p, where no array gives it.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.
    DimensionError
        If arrays have different lengths.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> weak = lbt.loop.LoopEnsemble(sensor_gain=[0.4, 0.7, 1.0], noise_nm=15.5)
    >>> weak.loops
    3
    """

    sensor_gain: Any = 1.0
    delay_frames: Any = None
    noise_nm: Any = 0.0
    turbulence: Any = None
    vibrations: tuple[EnsembleVibration, ...] = ()
    loops: int = 0

    def __post_init__(self) -> None:
        set_fields(self, vibrations=sequence(self.vibrations, "vibrations"))
        for line in self.vibrations:
            require_instance(line, EnsembleVibration)
        noise = real_array(self.noise_nm, "noise_nm")
        if np.any(noise < 0):
            raise ProblemError(f"noise_nm must be at least 0; got {noise.min():.6g}.")
        set_fields(self, sensor_gain=positive(self.sensor_gain, "sensor_gain"), noise_nm=noise)
        if self.delay_frames is not None:
            delay = real_array(self.delay_frames, "delay_frames")
            if np.any((delay < 1) | (delay > LONGEST_DELAY)):
                bounds, got = f"at least 1 and at most {LONGEST_DELAY}", delay.ravel().tolist()
                raise ProblemError(f"delay_frames must be {bounds}; got {got}.")
            set_fields(self, delay_frames=delay)
        lengths = {len(values) for values in self._values_per_loop()} | ({self.loops} - {0})
        if len(lengths - {1}) > 1:
            raise DimensionError(
                f"all must have one entry per loop; got {sorted(lengths)} entries."
            )
        if 0 in lengths:
            raise DimensionError("an ensemble needs at least one loop; got none.")
        set_fields(self, loops=max(lengths, default=1))

    def _values_per_loop(self) -> list[FloatArray]:
        """Return all arrays that have one entry per loop."""
        values = [self.sensor_gain, self.noise_nm, self.delay_frames]
        for line in self.vibrations:
            values += [line.frequency_hz, line.rms_nm, line.damping]
            values += [line.direction] if line.direction.ndim == 2 else []
        for part in self._turbulence_parts(1):
            values += _turbulence_values(part)
        return [value for value in values if np.ndim(value)]

    def _turbulence_parts(self, modes: int) -> tuple[Any, ...]:
        """Return the turbulence as it is per mode, or for each of some modes."""
        one = not isinstance(self.turbulence, Sequence)
        return (self.turbulence,) * modes if one else tuple(self.turbulence)

    def delays(self, hardware: LoopHardware) -> FloatArray:
        """Return the total delay of each loop [frames], (p,)."""
        delay = hardware.delay_frames if self.delay_frames is None else self.delay_frames
        return np.broadcast_to(delay, (self.loops,))

    def gains(self) -> FloatArray:
        """Return the sensor gain of each loop, (p,)."""
        return np.broadcast_to(self.sensor_gain, (self.loops,))

    def noise(self, hardware: LoopHardware) -> FloatArray:
        """Return the noise of each measurement [nm], (p, q)."""
        q, given = hardware.n_measurements, np.asarray(self.noise_nm)
        given = given[:, None] if given.ndim == 1 else given
        if given.ndim == 2 and given.shape[1] not in (1, q):
            got = given.shape[1]
            raise DimensionError(f"noise_nm must have one column per measurement ({q}); got {got}.")
        return np.broadcast_to(given, (self.loops, q))

    def groups(self, hardware: LoopHardware) -> list[tuple[Spectrum, tuple[int, ...]]]:
        """Return the turbulence with the modes that have it."""
        n, parts = hardware.modes, self._turbulence_parts(hardware.modes)
        if len(parts) != n:
            raise DimensionError(
                f"turbulence must have one entry per mode ({n}); got {len(parts)}."
            )
        groups: dict[object, tuple[Spectrum, tuple[int, ...]]] = {}
        for mode, part in enumerate(parts):
            if part is not None:
                first, modes = groups.get(spectrum_key(part), (part, ()))
                groups[spectrum_key(part)] = (first, (*modes, mode))
        return list(groups.values())

    def lines(self, hardware: LoopHardware) -> list[EnsembleVibration]:
        """Return the vibrations with all their arrays (p,), and directions (p, n)."""
        out, p, n, nyquist = [], self.loops, hardware.modes, hardware.frame_rate_hz / 2
        for line in self.vibrations:
            if line.direction.shape[-1] != n:
                got = line.direction.shape[-1]
                raise DimensionError(
                    f"the direction of a vibration must have {n} components, one per mode; got "
                    f"{got}."
                )
            if not np.max(line.frequency_hz) < nyquist:
                limit, got = f"the Nyquist frequency {nyquist:.6g} Hz", np.max(line.frequency_hz)
                raise ProblemError(f"a vibration must lie below {limit}; got {got:.6g} Hz.")
            values = {name: getattr(line, name) for name in ("frequency_hz", "rms_nm", "damping")}
            whole: dict[str, Any] = {
                k: np.broadcast_to(v, (p,)) for k, v in values.items() if v is not None
            }
            out.append(replace(line, **whole, direction=np.broadcast_to(line.direction, (p, n))))
        return out


def _turbulence_values(turbulence: Spectrum | None) -> list[FloatArray]:
    """Return the arrays of a turbulence that have one entry per loop."""
    if isinstance(turbulence, Atmosphere):
        values = turbulence.seeing_arcsec, turbulence.wind_speed_m_s, turbulence.outer_scale_m
        return [value for value in values if value is not None]
    if isinstance(turbulence, ARModel) and turbulence.coefficients.ndim > 1:
        return [*turbulence.coefficients.T, turbulence.driving_rms_nm]
    if turbulence is not None and not isinstance(turbulence, Spectrum):
        raise ProblemError(
            "turbulence must be a spectrum, None, or a sequence of these; got "
            f" {type(turbulence).__name__}."
        )
    return []


def turbulence_rows(turbulence: Spectrum, rows: IntArray) -> Spectrum:
    """Return the turbulence of some loops."""
    if isinstance(turbulence, Atmosphere) and np.size(turbulence.wind_speed_m_s) > 1:
        return turbulence.take(rows)
    if isinstance(turbulence, ARModel) and turbulence.count > 1:
        return turbulence.take(rows)
    return turbulence


def ensemble_residuals(
    controller: Any,
    hardware: LoopHardware,
    ensemble: LoopEnsemble,
    *,
    frame_means: bool = False,
) -> ResidualBudget:
    """Evaluate a controller exactly in many loops, or many controllers in one loop each.

    The answers are those of :func:`residual_budget`, loop by loop: stability by eigenvalues,
    spectra and noise by adaptive quadrature, auto-regressive processes by Lyapunov equations,
    sinusoids by the closed loops' response. Independent tip and tilt are evaluated separately.

    Parameters
    ----------
    controller : Controller, Design, or sequence of these
        One controller for all loops, or one per loop, all with as many states.
    hardware : LoopHardware
        Sensor and mirror of all loops; the ensemble may have other delays.
    ensemble : LoopEnsemble
        What the loops meet, p of them.
    frame_means : bool, optional
        As in :func:`residual_budget`.

    Returns
    -------
    ResidualBudget
        Stability and covariances by origin.

    Raises
    ------
    ProblemError
        If the controller, a vibration, the turbulence or the noise does not fit the loop.
    NumericalError
        If an equation was not solved.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.005, rms_nm=797)
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5
    ... )
    >>> ensemble = lbt.loop.LoopEnsemble(
    ...     sensor_gain=[0.8, 1.0, 4.0],
    ...     turbulence=slow,
    ...     noise_nm=15.5,
    ...     vibrations=[lbt.loop.EnsembleVibration(frequency_hz=[19.0, 20.0, 20.0], rms_nm=797)],
    ... )
    >>> found = lbt.loop.ensemble_residuals(lbt.kalman(plant).controller, plant.hardware, ensemble)
    >>> found.rms_nm.round(1).tolist()
    [204.2, 191.7, nan]
    """
    require_instance(hardware, LoopHardware)
    require_instance(ensemble, LoopEnsemble)
    given = controller if isinstance(controller, list | tuple) else [controller]
    each = [as_controller(one) for one in given]
    for one in each:
        require_matching_controller(hardware.own_sensor_alone(), one)
    sizes, count = sorted({one.n_states for one in each}), ensemble.loops
    if len(each) not in (1, count) or len(sizes) != 1:
        raise DimensionError(
            f"give one controller, or one per loop ({count}) with as many states each; got "
            f"{len(each)} with {sizes} states."
        )
    matrices = textbook_matrices(each)
    return residuals_from_matrices(matrices, hardware, ensemble, in_image=not frame_means)


def residuals_from_matrices(
    matrices: tuple[FloatArray, ...],
    hardware: LoopHardware,
    ensemble: LoopEnsemble,
    *,
    in_image: bool,
) -> ResidualBudget:
    """Evaluate controllers ``A, B, C, D`` in textbook form, (1 or p, ., .) each."""
    turbulence, lines = ensemble.groups(hardware), ensemble.lines(hardware)
    for spectrum, _ in turbulence:
        if isinstance(spectrum, ARModel):
            require_loop_rate(spectrum.frame_rate_hz, hardware)
    stable, groups = close_loops(matrices, hardware, ensemble.gains(), ensemble.delays(hardware))
    noise_nm, n, p = ensemble.noise(hardware), hardware.modes, ensemble.loops
    sinusoids = [line for line in lines if line.damping is None]
    steady, shaken = np.zeros((p, 2, 2, n, n)), np.zeros((p, 2, n, n))
    amplitudes = np.zeros((p, len(sinusoids), n), dtype=np.complex128)
    for left in (steady, shaken, amplitudes):
        left[~stable] = np.nan
    for stacks in groups:
        for batch in _batches(stacks, stable):
            some = [stack.take(batch) for stack in stacks]
            rows = some[0].loops
            spectra = [(turbulence_rows(spectrum, rows), modes) for spectrum, modes in turbulence]
            for stack in some:
                steady[rows] += _of_part(
                    stack, spectra, noise_nm[rows], hardware, in_image=in_image
                )
            for line in lines:
                members = _reached(some, line.direction[rows])
                modes = np.concatenate([own for _, own in members])
                loops = stack_evaluator(members, hardware, in_image=in_image)
                along = line.direction[np.ix_(rows, modes)]
                f = line.frequency_hz[rows] / hardware.frame_rate_hz
                if line.damping is not None:
                    share = np.sinc(f) if in_image else 1.0
                    process = sampled_lines(
                        line.frequency_hz[rows],
                        line.damping[rows],
                        share * line.rms_nm[rows],
                        hardware.frame_rate_hz,
                        line.sections,
                    )
                    moved = loops.of_process(*process, along[..., None])
                else:
                    entry = np.zeros((rows.size, loops.B.shape[2]), dtype=np.complex128)
                    entry[:, : modes.size] = np.sqrt(2) * line.rms_nm[rows][:, None] * along
                    amplitudes_nm, within = loops.of_sinusoids(f, entry)
                    place = np.ix_(rows, np.array([sinusoids.index(line)]), modes)
                    amplitudes[place] = amplitudes_nm[:, None]
                    moved = np.stack([0 * within, within], axis=1)
                shaken[np.ix_(rows, np.arange(2), modes, modes)] += moved
    of_turbulence, of_noise = np.moveaxis(steady, 1, 0)
    return ResidualBudget(
        stable=read_only(stable),
        turbulence_nm2=of_turbulence[:, 0],
        noise_nm2=of_noise[:, 0],
        random_vibration_nm2=shaken[:, 0],
        within_nm2=of_turbulence[:, 1] + of_noise[:, 1] + shaken[:, 1],
        line_amplitudes_nm=amplitudes,
    )


def textbook_matrices(controllers: Sequence[Controller]) -> tuple[FloatArray, ...]:
    """Return controllers of as many states as balanced ``A, B, C, D`` in textbook form."""
    systems = [controller.to_statespace() for controller in controllers]
    systems = [system.balanced() if system.n_states else system for system in systems]
    return tuple(np.stack([getattr(system, name) for system in systems]) for name in "ABCD")


def _batches(stacks: list[LoopStack], stable: BoolArray) -> list[IntArray]:
    """Split the stable loops into batches; those next to instability need short panels."""
    poles = np.concatenate([stack.poles for stack in stacks], axis=1)
    order = np.argsort(np.max(np.abs(poles), axis=1), kind="stable")
    order = order[stable[stacks[0].loops[order]]]
    return [order[i : i + _TOGETHER] for i in range(0, order.size, _TOGETHER)]


def _of_part(
    stack: LoopStack,
    turbulence: list[tuple[Spectrum, tuple[int, ...]]],
    noise_nm: FloatArray,
    hardware: LoopHardware,
    *,
    in_image: bool,
) -> FloatArray:
    """Covariances (k, 2, 2, n, n) from turbulence and from noise (k, q): of means, and within.

    They are of the whole loop; what reaches equal parts alike is evaluated once.
    """
    n = hardware.modes
    out = np.zeros((stack.loops.size, 2, 2, n, n))
    of_turbulence, of_noise = out[:, 0], out[:, 1]
    loops = stack_evaluator([(stack, stack.modes[0])], hardware, in_image=in_image)
    known: dict[object, FloatArray] = {}
    for own, inputs in zip(stack.modes, stack.measurements, strict=True):
        at = np.ix_(own, own)
        noise = noise_nm[:, inputs]
        if noise.tobytes() not in known:
            known[noise.tobytes()] = loops.of_noise(noise[..., None] * np.eye(inputs.size))
        of_noise[:, :, *at] += known[noise.tobytes()]
        for i, (spectrum, modes) in enumerate(turbulence):
            columns = np.flatnonzero(np.isin(own, modes))
            key = i, *columns.tolist()
            if key not in known and columns.size:
                entry = np.eye(own.size)[None, :, columns]
                known[key] = loops.of_turbulence(spectrum, entry)
            of_turbulence[:, :, *at] += known.get(key, 0.0)
    return out


def _reached(stacks: list[LoopStack], along: FloatArray) -> list[tuple[LoopStack, IntArray]]:
    """Return the stacks that directions (k, n) reach, and the modes that each stands for."""
    pairs = [(stack, modes) for stack in stacks for modes in stack.modes]
    return [(stack, modes) for stack, modes in pairs if np.any(along[:, modes])]
