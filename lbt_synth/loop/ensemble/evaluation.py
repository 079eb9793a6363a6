"""Evaluates controllers in an ensemble of loops: exact residuals by origin.

Spectra and noise go through quadrature, auto-regressive processes through Lyapunov equations,
sinusoids through the loops' responses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear import Controller
from lbt_synth.linear.held_controller import as_controller
from lbt_synth.linear.lyapunov import stationary_covariances, stationary_root
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.loop.closed_loop import require_loop_rate, require_matching_controller
from lbt_synth.loop.ensemble.closed_loops import ClosedLoops, LoopGroup, LoopPoints
from lbt_synth.loop.ensemble.loop_ensemble import (
    EnsembleVibration,
    LoopEnsemble,
    Turbulence,
    turbulence_rows,
)
from lbt_synth.loop.ensemble.spectral_covariances import spectral_covariances
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
    def rms_nm(self) -> FloatArray:
        """Residual over all modes [nm rms], (p,)."""
        return np.sqrt(_power(self.turbulence_nm2) + _power(self.noise_nm2) + self._vibration_nm2())

    def strehl(self, imaging: Imaging) -> FloatArray:
        """Strehl ratio of each loop."""
        gaussian = self.turbulence_nm2 + self.noise_nm2 + self.random_vibration_nm2
        lines = self.line_amplitudes_nm
        out = np.full(self.stable.shape, np.nan)
        found = np.flatnonzero(self.stable)
        out[found] = 0.0
        spread = jitter_spread_nm(gaussian[found], lines[found])
        near = found[spread <= widest_jitter_nm(imaging)]
        out[near] = jitter_strehls(gaussian[near], imaging=imaging, line_amplitudes_nm=lines[near])
        return out

    def _vibration_nm2(self) -> FloatArray:
        lines = np.sum(np.abs(self.line_amplitudes_nm) ** 2, axis=(1, 2)) / 2
        return np.asarray(_power(self.random_vibration_nm2) + lines)


def _power(covariances: FloatArray) -> FloatArray:
    return np.asarray(np.trace(covariances, axis1=1, axis2=2), dtype=np.float64)


def ensemble_residuals(
    controller: Any, hardware: LoopHardware, ensemble: LoopEnsemble
) -> EnsembleResiduals:
    """Evaluate a controller exactly in many loops, or many controllers in one loop each.

    The answers are those of :func:`residual_budget`, loop by loop: stability by eigenvalues,
    spectra and noise by quadrature refined around the closed loops' poles, auto-regressive
    processes by Lyapunov equations, sinusoids by the closed loops' response. Independent tip and
    tilt are evaluated separately, and only once if they are equal.

    Parameters
    ----------
    controller : Controller, Design, or sequence of these
        One controller for all loops, or one per loop, all with as many states.
    hardware : LoopHardware
        Sensor and mirror of all loops; the ensemble may have other delays.
    ensemble : LoopEnsemble
        What the loops meet, p of them.

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
    [195.4, 181.9, nan]
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
    return residuals_from_matrices(textbook_matrices(each), hardware, ensemble)


def residuals_from_matrices(
    matrices: tuple[FloatArray, ...], hardware: LoopHardware, ensemble: LoopEnsemble
) -> EnsembleResiduals:
    """Evaluate controllers ``A, B, C, D`` in textbook form, (1 or p, ., .) each."""
    turbulence, lines = ensemble.groups(hardware), ensemble.lines(hardware)
    # loops that differ only in their vibrations are closed once
    points, which = ensemble.distinct(hardware, apart=len(matrices[0]) > 1)
    gains, delays = ensemble.gains()[points], ensemble.delays(hardware)[points]
    loops = ClosedLoops.of(matrices, hardware, gains, delays)
    distinct = [(turbulence_rows(spectrum, points), modes) for spectrum, modes in turbulence]
    noise_nm = ensemble.noise(hardware)[points]
    turbulence_nm2, noise_nm2 = turbulence_and_noise_nm2(loops, distinct, noise_nm)
    random_nm2, amplitudes = vibration_residuals(loops, which, lines)
    return EnsembleResiduals(
        stable=read_only(loops.stable[which]),
        turbulence_nm2=turbulence_nm2[which],
        noise_nm2=noise_nm2[which],
        random_vibration_nm2=random_nm2,
        line_amplitudes_nm=amplitudes,
    )


def textbook_matrices(controllers: Sequence[Controller]) -> tuple[FloatArray, ...]:
    """Return controllers with equal numbers of states as balanced ``A, B, C, D``, textbook form.

    Only in states of comparable units does an entry that is tiny beside the others do nothing.
    """
    systems = [controller.to_statespace() for controller in controllers]
    systems = [system.balanced() if system.n_states else system for system in systems]
    return tuple(np.stack([getattr(system, name) for system in systems]) for name in "ABCD")


def turbulence_and_noise_nm2(
    loops: ClosedLoops, turbulence: list[tuple[Turbulence, tuple[int, ...]]], noise_nm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariances (p, n, n) of the residual from turbulence, and from noise (p, q).

    ``turbulence`` pairs each spectrum with its modes. Unstable loops have nan.
    """
    hardware, stable = loops.hardware, loops.stable
    for spectrum, _ in turbulence:
        if isinstance(spectrum, Process):
            require_loop_rate(spectrum.frame_rate_hz, hardware)
    n, rate = hardware.modes, hardware.frame_rate_hz
    both = np.full((2, stable.size, n, n), np.nan)
    both[:, stable] = 0.0
    turbulence_nm2, noise_nm2 = both
    spectra = [pair for pair in turbulence if not isinstance(pair[0], Process)]
    for same_delay in zip(*loops.subloops, strict=True):
        done: list[_SpectralPart] = []
        for group in same_delay:
            part = _SpectralPart.of(group, spectra, noise_nm)
            rows, twin = group.rows[:, None, None], next(filter(part.equals, done), None)
            if twin is None:
                for batch, turbulence_left, noise_left in part.covariances(stable, rate):
                    at = (batch.rows[:, None, None], *np.ix_(part.modes, part.modes))
                    turbulence_nm2[at], noise_nm2[at] = turbulence_left, noise_left
                done.append(part)
            else:
                own, other = np.ix_(part.modes, part.modes), np.ix_(twin.modes, twin.modes)
                both[:, rows, *own] = both[:, rows, *other]
    for spectrum, modes in turbulence:
        if not isinstance(spectrum, Process):
            continue
        for same_delay in zip(*loops.subloops, strict=True):
            found = np.flatnonzero(stable[same_delay[0].rows])
            if found.size:
                chosen = [group.take(found) for group in same_delay]
                process = turbulence_rows(spectrum, chosen[0].rows)
                assert isinstance(process, Process)
                for mode in modes:
                    axis = np.eye(n)[mode]
                    _add_process(turbulence_nm2, chosen[0].rows, chosen, process, axis, {})
    return turbulence_nm2, noise_nm2


@dataclass(frozen=True, slots=True, eq=False)
class _SpectralPart:
    """The loops of a subloop with the same whole delay, and the spectra and noise they meet."""

    group: LoopGroup
    spectra: list[tuple[Turbulence, list[int]]]  # with their places among the modes
    noise_nm: FloatArray  # (p, q)

    @classmethod
    def of(
        cls,
        group: LoopGroup,
        spectra: list[tuple[Turbulence, tuple[int, ...]]],
        noise_nm: FloatArray,
    ) -> _SpectralPart:
        """Choose what reaches a subloop of all spectra, with their modes, and all noise."""
        own = group.subloop.modes
        places = [(s, np.flatnonzero(np.isin(own, modes)).tolist()) for s, modes in spectra]
        reached = [(spectrum, place) for spectrum, place in places if place]
        return cls(group, reached, noise_nm[:, group.subloop.measurements])

    @property
    def modes(self) -> IntArray:
        """Modes of the subloop."""
        return self.group.subloop.modes

    def equals(self, other: _SpectralPart) -> bool:
        """Whether another part is left the same: equal subloops are closed only once."""
        own, others = ([(id(s), places) for s, places in each.spectra] for each in (self, other))
        return (
            self.group.poles is other.group.poles
            and own == others
            and np.array_equal(self.noise_nm, other.noise_nm)
        )

    def covariances(
        self, stable: BoolArray, frame_rate_hz: float
    ) -> Iterator[tuple[LoopPoints, FloatArray, FloatArray]]:
        """Yield batches of the stable loops, and the covariances (k, n, n) that both leave."""
        for batch in self.group.batches(stable):
            own = [(turbulence_rows(s, batch.rows), places) for s, places in self.spectra]
            noise = self.noise_nm[batch.rows]
            yield batch, *spectral_covariances(batch, own, noise, frame_rate_hz)


def vibration_residuals(
    loops: ClosedLoops, which: IntArray, lines: list[EnsembleVibration]
) -> tuple[FloatArray, ComplexArray]:
    """Covariances (p, n, n) from resonances, and amplitudes (p, s, n) that sinusoids leave.

    ``which`` (p,) is the closed loop of each row of the vibrations.
    """
    n, count, rate = loops.hardware.modes, which.size, loops.hardware.frame_rate_hz
    stable = loops.stable[which]
    random = [line for line in lines if line.damping is not None]
    sinusoids = [line for line in lines if line.damping is None]
    random_nm2 = np.full((count, n, n), np.nan)
    amplitudes_nm = np.full((count, len(sinusoids), n), np.nan + 0j)
    random_nm2[stable], amplitudes_nm[stable] = 0.0, 0.0
    for groups in zip(*loops.subloops, strict=True):
        place = np.full(loops.stable.size, -1)
        place[groups[0].rows] = np.arange(groups[0].rows.size)
        found = np.flatnonzero(stable & (place[which] >= 0))
        for rows in (found[i : i + _AT_ONCE] for i in range(0, found.size, _AT_ONCE)):
            chosen = [group.take(place[which[rows]]) for group in groups]
            for i, line in enumerate(sinusoids):
                peak = line.direction[rows] * np.sqrt(2) * line.rms_nm[rows][:, None]
                turn = 2 * np.pi * line.frequency_hz[rows] / rate
                for group in chosen:
                    modes = group.subloop.modes
                    if not np.any(peak[:, modes]):
                        continue
                    left = group.rejections(turn) @ peak[:, modes, None]
                    amplitudes_nm[rows[:, None], i, modes] = left[..., 0]
            alike: dict[tuple[bool, ...], list[EnsembleVibration]] = {}  # by the subloops reached
            for line in random:
                reached = (bool(np.any(line.direction[rows][:, g.subloop.modes])) for g in chosen)
                alike.setdefault(tuple(reached), []).append(line)
            known: dict[tuple[bytes, ...], FloatArray] = {}  # equal axes are computed once
            for same in alike.values():
                frequency_hz, damping, rms_nm, along = (
                    np.concatenate([getattr(line, name)[rows] for line in same])
                    for name in ("frequency_hz", "damping", "rms_nm", "direction")
                )
                a, drive = sampled_lines(frequency_hz, damping, rms_nm, rate)
                process = ModalTurbulence(coefficients=a, driving_rms_nm=drive, frame_rate_hz=rate)
                _add_process(random_nm2, rows, chosen, process, along, known)
    return random_nm2, amplitudes_nm


def _add_process(
    total: FloatArray,
    rows: IntArray,
    groups: list[LoopGroup],
    process: Process,
    along: FloatArray,
    known: dict[tuple[bytes, ...], FloatArray],
) -> None:
    """Add to ``total[rows]`` (p, n, n) what a process leaves in all subloops that it reaches.

    The direction ``along`` is (n,), or (l k, n) for l processes of all loops in turn.
    """
    reached = [group for group in groups if np.any(along[..., group.subloop.modes])]
    if reached:
        modes = np.concatenate([group.subloop.modes for group in reached])
        at = (rows[:, None, None], *np.ix_(modes, modes))
        turns = len(along) // rows.size if along.ndim == 2 else 1
        loops = tuple(np.tile(part, (turns, 1, 1)) for part in _join(reached))
        own = along[..., modes]
        numbers = (*loops, process.coefficients, process.driving_rms_nm, own)
        key = tuple(np.asarray(part).tobytes() for part in numbers)
        if key not in known:
            known[key] = _process_covariances(loops, process, own)
        found = known[key].reshape(turns, rows.size, modes.size, modes.size)
        total[at] += np.sum(found, axis=0)


def _join(groups: list[LoopGroup]) -> tuple[FloatArray, ...]:
    """Matrices ``A, B, C, D`` of independent subloops as one, driven by the total phase only."""
    n = [group.C.shape[1] for group in groups]
    parts = [(g.A, g.B[..., :m], g.C, g.D[..., :m]) for g, m in zip(groups, n, strict=True)]
    if len(parts) == 1:
        return parts[0]
    states = np.cumsum([0] + [group.A.shape[1] for group in groups])
    modes, count = np.cumsum([0, *n]), len(groups[0].A)
    A, B = np.zeros((count, states[-1], states[-1])), np.zeros((count, states[-1], modes[-1]))
    C, D = np.zeros((count, modes[-1], states[-1])), np.zeros((count, modes[-1], modes[-1]))
    for i, part in enumerate(parts):
        x, r = slice(*states[i : i + 2]), slice(*modes[i : i + 2])
        A[:, x, x], B[:, x, r], C[:, r, x], D[:, r, r] = part
    return A, B, C, D


def _process_covariances(
    loops: tuple[FloatArray, ...], process: Process, directions: FloatArray
) -> FloatArray:
    """Covariance (k, n, n) of the residual that a process, or one per loop, leaves.

    ``directions`` is (n,), or (k, n) with one per loop.
    """
    if isinstance(process, ARModel):
        coefficients, drive = process.coefficients[None], np.array([process.driving_rms_nm])
    else:
        coefficients, drive = process.coefficients, process.driving_rms_nm
    entry, through = loops[1], loops[3]
    order, (k, s, n) = coefficients.shape[1], entry.shape
    along = np.broadcast_to(directions, (k, n))[:, :, None]
    A, Q = np.zeros((2, k, s + order, s + order))
    A[:, :s, :s] = loops[0]
    A[:, :s, s : s + 1] = entry @ along  # the newest sample acts on its frame
    A[:, s, s:] = coefficients
    A[:, s + 1 :, s:-1] = np.eye(order - 1)
    Q[:, s, s] = drive**2
    C = np.zeros((k, n, s + order))
    C[..., :s], C[..., s : s + 1] = loops[2], through @ along
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
    return left
