"""Evaluates controllers in an ensemble of loops: exact residuals by origin.

Spectra and noise go through quadrature, auto-regressive processes through Lyapunov equations,
sinusoids through the loops' responses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear import Controller
from lbt_synth.linear.held_controller import as_controller
from lbt_synth.linear.lyapunov import stationary_covariances, stationary_root
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.loop.closed_loop import require_loop_rate, require_matching_controller
from lbt_synth.loop.ensemble.closed_loops import LoopStack, close_loops
from lbt_synth.loop.ensemble.loop_ensemble import (
    EnsembleVibration,
    LoopEnsemble,
    Turbulence,
    turbulence_rows,
)
from lbt_synth.loop.ensemble.spectral_covariances import (
    power_within_frames,
    process_covariances,
    spectral_covariances,
)
from lbt_synth.loop.strehl import Imaging, jitter_spread_nm, jitter_strehls, widest_jitter_nm
from lbt_synth.models import ARModel, LoopHardware, ModalTurbulence
from lbt_synth.models.vibration import sampled_lines
from lbt_synth.validation import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    read_only,
    require_instance,
)

Process: TypeAlias = ARModel | ModalTurbulence

_AT_ONCE = 1024  # loops with vibrations
_TOGETHER = 2048  # loops with the same frequencies: as many as repay their panels
_RESIDUAL = 1e-9  # of a Lyapunov equation, relative
_ROUNDING = 1e-8  # of the terms of a variance, the least part that it is computed from


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EnsembleResiduals:
    """Stationary residuals of p loops; nan where a loop is unstable."""

    stable: BoolArray  # (p,): whether each loop is stable
    # (p, n, n): covariances over the modes [nm^2]
    turbulence_nm2: FloatArray
    noise_nm2: FloatArray
    random_vibration_nm2: FloatArray
    within_nm2: FloatArray  # of what moves within frames
    # (p, s, n): complex amplitude that each sinusoid leaves on each mode [nm]
    line_amplitudes_nm: ComplexArray

    @property
    def turbulence_nm(self) -> FloatArray:
        """Residual turbulence over all modes [nm rms], (p,)."""
        return np.sqrt(_power(self.turbulence_nm2))

    @property
    def noise_nm(self) -> FloatArray:
        """Propagated noise over all modes [nm rms], (p,)."""
        return np.sqrt(_power(self.noise_nm2))

    @property
    def vibration_nm(self) -> FloatArray:
        """Residual vibration over all modes, the sinusoids by their mean power [nm rms], (p,)."""
        return np.sqrt(self._vibration_nm2())

    @property
    def within_nm(self) -> FloatArray:
        """What moves within frames over all modes [nm rms], (p,)."""
        return np.sqrt(_power(self.within_nm2))

    @property
    def rms_nm(self) -> FloatArray:
        """Residual over all modes [nm rms], (p,)."""
        steady = self.turbulence_nm2 + self.noise_nm2 + self.within_nm2
        return np.sqrt(_power(steady) + self._vibration_nm2())

    def strehl(self, imaging: Imaging) -> FloatArray:
        """Strehl ratio of each loop."""
        gaussian = (
            self.turbulence_nm2 + self.noise_nm2 + self.random_vibration_nm2 + self.within_nm2
        )
        lines, out = self.line_amplitudes_nm, np.where(self.stable, 0.0, np.nan)
        spread = jitter_spread_nm(gaussian[self.stable], lines[self.stable])
        near = np.flatnonzero(self.stable)[spread <= widest_jitter_nm(imaging)]
        out[near] = jitter_strehls(gaussian[near], imaging=imaging, line_amplitudes_nm=lines[near])
        return out

    def _vibration_nm2(self) -> FloatArray:
        lines = np.sum(np.abs(self.line_amplitudes_nm) ** 2, axis=(1, 2)) / 2
        return np.asarray(_power(self.random_vibration_nm2) + lines)


def _power(covariances: FloatArray) -> FloatArray:
    return np.asarray(np.trace(covariances, axis1=1, axis2=2), dtype=np.float64)


def ensemble_residuals(
    controller: Any,
    hardware: LoopHardware,
    ensemble: LoopEnsemble,
    *,
    frame_means: bool = False,
) -> EnsembleResiduals:
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
    EnsembleResiduals
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
        require_matching_controller(hardware, one)
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
) -> EnsembleResiduals:
    """Evaluate controllers ``A, B, C, D`` in textbook form, (1 or p, ., .) each."""
    turbulence, lines = ensemble.groups(hardware), ensemble.lines(hardware)
    for spectrum, _ in turbulence:
        if isinstance(spectrum, Process):
            require_loop_rate(spectrum.frame_rate_hz, hardware)
    # loops that differ only in their vibrations are closed once
    points, which = ensemble.distinct(hardware, apart=len(matrices[0]) > 1)
    gains, delays = ensemble.gains()[points], ensemble.delays(hardware)[points]
    stable, groups = close_loops(matrices, hardware, gains, delays)
    distinct = [(turbulence_rows(spectrum, points), modes) for spectrum, modes in turbulence]
    noise_nm, n = ensemble.noise(hardware)[points], hardware.modes
    left = np.where(stable[:, None, None, None], 0.0, np.full((3, n, n), np.nan))
    resonances = [line for line in lines if line.damping is not None]
    sinusoids = [line for line in lines if line.damping is None]
    here = stable[which]
    shaken = np.where(here[:, None, None, None], 0.0, np.full((2, n, n), np.nan))
    amplitudes = np.where(here[:, None, None], 0j, np.full((len(sinusoids), n), np.nan))
    for stacks in groups:
        place = np.full(stable.size, -1)
        place[stacks[0].rows] = np.arange(stacks[0].rows.size)
        for rows in _batches(np.flatnonzero(stable & (place >= 0)), stacks, place):
            chosen = [stack.take(place[rows]) for stack in stacks]
            left[rows] += _turbulence_and_noise_nm2(
                chosen, distinct, noise_nm, hardware, in_image=in_image
            )
        met = np.flatnonzero(here & (place[which] >= 0))
        for rows in _split(met, _AT_ONCE):
            chosen = [stack.take(place[which[rows]]) for stack in stacks]
            for line in resonances:
                shaken[rows] += _resonance_nm2(chosen, line, rows, hardware, in_image=in_image)
            for i, line in enumerate(sinusoids):
                amplitudes[rows, i], within = _sinusoid_nm(
                    chosen, line, rows, hardware, in_image=in_image
                )
                shaken[rows, 1] += within
    return EnsembleResiduals(
        stable=read_only(here),
        turbulence_nm2=left[which, 0],
        noise_nm2=left[which, 1],
        random_vibration_nm2=shaken[:, 0],
        within_nm2=left[which, 2] + shaken[:, 1],
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


def _turbulence_and_noise_nm2(
    stacks: list[LoopStack],
    turbulence: list[tuple[Turbulence, tuple[int, ...]]],
    noise_nm: FloatArray,
    hardware: LoopHardware,
    *,
    in_image: bool,
) -> FloatArray:
    """Covariances (k, 3, n, n) from turbulence, from noise (p, q), and of what moves within.

    ``turbulence`` pairs each spectrum of the p loops with its modes.
    """
    n, rows = hardware.modes, stacks[0].rows
    total = np.zeros((rows.size, 3, n, n))
    met = [(turbulence_rows(spectrum, rows), modes) for spectrum, modes in turbulence]
    spectra = [pair for pair in met if not isinstance(pair[0], Process)]
    for stack in stacks:
        total += spectral_covariances(stack, spectra, noise_nm[rows], hardware, in_image=in_image)
    for spectrum, modes in met:
        if isinstance(spectrum, Process):
            for mode in modes:
                along = np.eye(n)[[mode]]
                left = _process_nm2(stacks, spectrum, along, hardware, in_image=in_image)
                total[:, [0, 2]] += left
    return total


def _resonance_nm2(
    stacks: list[LoopStack],
    line: EnsembleVibration,
    rows: IntArray,
    hardware: LoopHardware,
    *,
    in_image: bool,
) -> FloatArray:
    """Covariances (k, 2, n, n) of the residual from a damped vibration, of means and within."""
    rate, frequency_hz, rms_nm = hardware.frame_rate_hz, line.frequency_hz[rows], line.rms_nm[rows]
    if in_image:
        rms_nm = rms_nm * np.sinc(frequency_hz / rate)
    a, drive = sampled_lines(frequency_hz, line.damping[rows], rms_nm, rate)
    process = ModalTurbulence(coefficients=a, driving_rms_nm=drive, frame_rate_hz=rate)
    return _process_nm2(stacks, process, line.direction[rows], hardware, in_image=in_image)


def _sinusoid_nm(
    stacks: list[LoopStack],
    line: EnsembleVibration,
    rows: IntArray,
    hardware: LoopHardware,
    *,
    in_image: bool,
) -> tuple[ComplexArray, FloatArray]:
    """Complex amplitudes (k, n) that a sinusoid leaves, and covariances (k, n, n) within."""
    peak = line.direction[rows] * np.sqrt(2) * line.rms_nm[rows][:, None]
    f = line.frequency_hz[rows] / hardware.frame_rate_hz
    share = np.sinc(f)[:, None] if in_image else 1.0
    out, n = np.zeros(peak.shape, dtype=np.complex128), hardware.modes
    within = np.zeros((len(peak), n, n))
    if stacks[0].holds_are_frames or not in_image:
        for stack, modes in _reached(stacks, peak):
            rejected = stack.rejections(2 * np.pi * f) @ (share * peak)[:, modes, None]
            out[:, modes] = rejected[..., 0]
        rest = np.asarray(1 - share**2)[..., None] / 2
        return out, np.broadcast_to(rest * peak[:, :, None] * peak[:, None], within.shape)
    reached = [(stack.pieces_at(2 * np.pi * f), modes) for stack, modes in _reached(stacks, peak)]
    (_, weights, rest), _ = reached[0]
    left = np.zeros((len(peak), weights.size, n), dtype=np.complex128)
    for (pieces, *_), modes in reached:
        left[..., modes] = (pieces @ peak[:, None, modes, None])[..., 0]
    left *= np.exp(-2j * np.pi * f * stacks[0].start)[:, None, None]  # the phase in the own hold
    out = np.einsum("g,kgi->ki", weights, left)
    apart = left - out[:, None]
    within += np.real(np.einsum("g,kgi,kgj->kij", weights, apart, apart.conj())) / 2
    within += rest[:, None, None] * peak[:, :, None] * peak[:, None] / 2
    return out, within


def _reached(stacks: list[LoopStack], along: FloatArray) -> list[tuple[LoopStack, IntArray]]:
    """Return the stacks that directions (k, n) reach, and the modes that each stands for."""
    pairs = [(stack, modes) for stack in stacks for modes in stack.part.modes]
    return [(stack, modes) for stack, modes in pairs if np.any(along[:, modes])]


def _process_nm2(
    stacks: list[LoopStack],
    process: Process,
    along: FloatArray,
    hardware: LoopHardware,
    *,
    in_image: bool,
) -> FloatArray:
    """Covariances (k, 2, n, n) that a process leaves, or one per loop, of means and within.

    Its direction ``along`` is (1, n), or (k, n) with one per loop.
    """
    reached, coefficients = _reached(stacks, along), np.atleast_2d(process.coefficients)
    driving = np.atleast_1d(process.driving_rms_nm)
    if in_image and not stacks[0].holds_are_frames:
        return process_covariances(reached, coefficients, driving, along, hardware)
    left = np.zeros((len(stacks[0].A), 2, *2 * [hardware.modes]))
    left[:, 0] = _rejected_process_nm2(reached, coefficients, driving, along)
    if in_image:
        power = power_within_frames(coefficients, driving, process.frame_rate_hz)
        left[:, 1] = power[:, None, None] * along[:, :, None] * along[:, None]
    return left


def _rejected_process_nm2(
    reached: list[tuple[LoopStack, IntArray]],
    coefficients: FloatArray,
    driving_rms_nm: FloatArray,
    along: FloatArray,
) -> FloatArray:
    """Covariances (k, n, n) of the means over frames that processes leave."""
    places = np.concatenate([modes for _, modes in reached])
    s, order, k = (
        sum(stack.A.shape[1] for stack, _ in reached),
        coefficients.shape[1],
        len(reached[0][0].A),
    )
    A, Q = np.zeros((2, k, s + order, s + order))
    C = np.zeros((k, places.size, s + order))
    A[:, s, s:] = coefficients
    A[:, s + 1 :, s:-1] = np.eye(order - 1)
    Q[:, s, s] = np.square(driving_rms_nm)
    x = r = 0
    for stack, modes in reached:
        n, size, direction = modes.size, stack.A.shape[1], along[:, modes, None]
        own, seen = slice(x, x + size), slice(r, r + n)
        A[:, own, own], C[:, seen, own] = stack.A, stack.C
        # the newest sample acts on its frame
        A[:, own, s] = (stack.B[..., :n] @ direction)[..., 0]
        C[:, seen, s] = (stack.D[..., :n] @ direction)[..., 0]
        x, r = x + size, r + n
    X, residuals = stationary_covariances(A, Q)
    left = np.asarray(C @ X @ transpose(C))
    # digits that a small difference of large terms keeps; roots keep theirs
    terms = np.abs(C) @ np.abs(X) @ transpose(np.abs(C))
    poor = np.trace(terms, axis1=1, axis2=2) * _ROUNDING > np.trace(left, axis1=1, axis2=2)
    for i in np.flatnonzero(~((residuals < _RESIDUAL) & ~poor)):
        root = C[i] @ stationary_root(A[i], np.sqrt(Q[i]))
        left[i] = root @ root.T
    if not np.all(np.isfinite(left)):
        raise ProblemError(
            "the covariance of a process in a loop was not found. The process or the loop is "
            "nearly a random walk; damp it."
        )
    out = np.zeros((k, along.shape[1], along.shape[1]))
    out[:, places[:, None], places] = left
    return out
