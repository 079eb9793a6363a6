"""Evaluates controllers in an ensemble of loops: exact residuals by origin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError
from lbt_synth.linear import Controller
from lbt_synth.linear.held_controller import as_controller
from lbt_synth.loop.closed_loop import require_loop_rate, require_matching_controller
from lbt_synth.loop.ensemble.closed_loops import LoopStack, close_loops, stack_evaluator
from lbt_synth.loop.ensemble.loop_ensemble import (
    EnsembleVibration,
    LoopEnsemble,
    Turbulence,
    turbulence_rows,
)
from lbt_synth.loop.evaluator import Evaluator
from lbt_synth.loop.residual import ResidualBudget
from lbt_synth.models import ARModel, LoopHardware, ModalTurbulence
from lbt_synth.models.vibration import sampled_lines
from lbt_synth.validation import FloatArray, IntArray, read_only, require_instance

_AT_ONCE = 1024  # loops with vibrations
_TOGETHER = 2048  # loops with the same frequencies: as many as repay their panels


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
        if isinstance(spectrum, ARModel | ModalTurbulence):
            require_loop_rate(spectrum.frame_rate_hz, hardware)
    # loops that differ only in their vibrations are closed once
    points, which = ensemble.distinct(hardware, apart=len(matrices[0]) > 1)
    gains, delays = ensemble.gains()[points], ensemble.delays(hardware)[points]
    stable, groups = close_loops(matrices, hardware, gains, delays)
    met = [(turbulence_rows(spectrum, points), modes) for spectrum, modes in turbulence]
    noise_nm, n, here = ensemble.noise(hardware)[points], hardware.modes, stable[which]
    steady = np.where(stable[:, None, None, None, None], 0.0, np.full((2, 2, n, n), np.nan))
    shaken = np.where(here[:, None, None, None], 0.0, np.full((2, n, n), np.nan))
    sinusoids = [line for line in lines if line.damping is None]
    amplitudes = np.where(here[:, None, None], 0j, np.full((len(sinusoids), n), np.nan))
    for stacks in groups:
        place = np.full(stable.size, -1)
        place[stacks[0].loops] = np.arange(stacks[0].loops.size)
        for rows in _batches(np.flatnonzero(stable & (place >= 0)), stacks, place):
            spectra = [(turbulence_rows(spectrum, rows), modes) for spectrum, modes in met]
            for stack in (stack.take(place[rows]) for stack in stacks):
                left = _of_part(stack, spectra, noise_nm[rows], hardware, in_image=in_image)
                steady[rows] += left
        for rows in _split(np.flatnonzero(here & (place[which] >= 0)), _AT_ONCE):
            chosen = [stack.take(place[which[rows]]) for stack in stacks]
            number = 0
            for line in lines:
                reached = _reached(chosen, line.direction[rows])
                modes = np.concatenate([own for _, own in reached])
                loops = stack_evaluator(reached, hardware, in_image=in_image)
                along = line.direction[np.ix_(rows, modes)]
                if line.damping is not None:
                    shaken[np.ix_(rows, np.arange(2), modes, modes)] += _of_resonance(
                        loops, line, rows, along
                    )
                    continue
                entry = np.zeros((rows.size, loops.B.shape[2]), dtype=np.complex128)
                entry[:, : modes.size] = np.sqrt(2) * line.rms_nm[rows][:, None] * along
                f = line.frequency_hz[rows] / hardware.frame_rate_hz
                amplitudes_nm, within = loops.of_sinusoids(f, entry)
                amplitudes[np.ix_(rows, np.array([number]), modes)] = amplitudes_nm[:, None]
                shaken[np.ix_(rows, np.array([1]), modes, modes)] += within[:, None]
                number += 1
    of_turbulence, of_noise = np.moveaxis(steady[which], 1, 0)
    return ResidualBudget(
        stable=read_only(here),
        turbulence_nm2=of_turbulence[:, 0],
        noise_nm2=of_noise[:, 0],
        random_vibration_nm2=shaken[:, 0],
        within_nm2=of_turbulence[:, 1] + of_noise[:, 1] + shaken[:, 1],
        line_amplitudes_nm=amplitudes,
    )


def textbook_matrices(controllers: Sequence[Controller]) -> tuple[FloatArray, ...]:
    """Return controllers with equal numbers of states as balanced ``A, B, C, D``, textbook form.

    Only in states of comparable units does an entry that is tiny beside the others do nothing.
    """
    systems = [controller.to_statespace() for controller in controllers]
    systems = [system.balanced() if system.n_states else system for system in systems]
    return tuple(np.stack([getattr(system, name) for system in systems]) for name in "ABCD")


def _batches(found: IntArray, stacks: list[LoopStack], place: IntArray) -> list[IntArray]:
    """Split loops into batches; those next to instability, which need short panels, together."""
    poles = np.concatenate([stack.poles for stack in stacks], axis=1)[place[found]]
    found = found[np.argsort(np.max(np.abs(poles), axis=1), kind="stable")]
    return _split(found, _TOGETHER)


def _split(rows: IntArray, most: int) -> list[IntArray]:
    """Split rows into batches of at most so many, none of them empty."""
    return [rows[i : i + most] for i in range(0, rows.size, most)]


def _of_part(
    stack: LoopStack,
    turbulence: list[tuple[Turbulence, tuple[int, ...]]],
    noise_nm: FloatArray,
    hardware: LoopHardware,
    *,
    in_image: bool,
) -> FloatArray:
    """Covariances (k, 2, 2, n, n) from turbulence and from noise (k, q): of means, and within.

    ``turbulence`` pairs each spectrum with its modes. All is of the whole loop: the covariances of
    other parts are zero. What reaches equal parts alike is evaluated once.
    """
    n, part = hardware.modes, stack.part
    out = np.zeros((stack.loops.size, 2, 2, n, n))
    of_turbulence, of_noise = out[:, 0], out[:, 1]
    loops = stack_evaluator([(stack, part.modes[0])], hardware, in_image=in_image)
    known: dict[object, FloatArray] = {}
    for own, inputs in zip(part.modes, part.measurements, strict=True):
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


def _of_resonance(
    loops: Evaluator, line: EnsembleVibration, rows: IntArray, along: FloatArray
) -> FloatArray:
    """Covariances (k, 2, n, n) of the residual from a damped vibration, of means and within."""
    rate, frequency_hz, rms_nm = loops.frame_rate_hz, line.frequency_hz[rows], line.rms_nm[rows]
    if loops.in_image:
        rms_nm = rms_nm * np.sinc(frequency_hz / rate)
    process = sampled_lines(frequency_hz, line.damping[rows], rms_nm, rate)
    return loops.of_process(*process, along[..., None])


def _reached(stacks: list[LoopStack], along: FloatArray) -> list[tuple[LoopStack, IntArray]]:
    """Return the stacks that directions (k, n) reach, and the modes that each stands for."""
    pairs = [(stack, modes) for stack in stacks for modes in stack.part.modes]
    return [(stack, modes) for stack, modes in pairs if np.any(along[:, modes])]
