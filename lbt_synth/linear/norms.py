"""H-infinity norms of discrete-time systems, by level sets of a symplectic pencil.

N. A. Bruinsma, M. Steinbuch, Syst. Control Lett. 14, 287 (1990),
doi:10.1016/0167-6911(90)90049-Z, in its discrete form: sigma is a singular
value of G(exp(j theta)) if and only if exp(j theta) is a generalised eigenvalue
of a pencil. No eigenvalue is discarded for lying off the unit circle: each one
only proposes an angle at which G is evaluated, so a rounding error cannot hide
a peak, and a spurious angle does no harm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import eigvals

from lbt_synth.errors import DimensionError, NumericalError, UnstableLoopError
from lbt_synth.linear.matrix_functions import part_labels
from lbt_synth.linear.state_space import (
    SchurForm,
    StateSpace,
    pointwise_response,
    schur_form,
    schur_response,
    split_into_parts,
)
from lbt_synth.validation import ComplexArray, FloatArray

_TOLERANCE = 2e-11  # relative, of a level above the peak: some times the rounding of a response
_CAREFUL = 8  # highest points that are solved one by one, which is more accurate next to a pole


@dataclass(frozen=True, slots=True, kw_only=True)
class HinfNorm:
    """Norm with its bracket; ``float(norm)`` is the value."""

    value: float  # largest singular value found, attained at ``peak_frequency_hz``
    # two-sided bracket by the level sets. Near a pole on the unit circle the evaluation itself is
    # only as good as the distance to it: some 1e-7 with a pole at 1 - 1e-9
    lower: float
    upper: float
    # frequency of the peak [Hz] (cycles per sample when the system has no period)
    peak_frequency_hz: float

    def __float__(self) -> float:
        return self.value


def hinf_norm(system: Any) -> HinfNorm:
    """Largest singular value of a stable discrete-time system over all frequencies.

    The norm of a system with a longer period is that of the system over a period, and the
    frequency of its peak is at most half of one per period.

    Parameters
    ----------
    system : StateSpace, control.StateSpace or tuple (A, B, C, D)
        The system; C and D need not be square, D may be non-zero.

    Returns
    -------
    HinfNorm
        Value, bracket and peak frequency.

    Raises
    ------
    ProblemError
        If the system is not one, is in continuous time, or has no input or no output.
    UnstableLoopError
        If it is not stable: the norm is then infinite.
    NumericalError
        If the level sets do not close.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lag = lbt.hinf_norm(([[0.5]], [[1.0]], [[1.0]], [[0.0]]))
    >>> round(float(lag), 9), lag.peak_frequency_hz
    (2.0, 0.0)
    """
    G = StateSpace.of(system)
    if not (G.B.shape[-1] and G.C.shape[-2]):
        raise DimensionError(
            "a norm needs a system with at least one input and one output; got "
            f"{G.B.shape[-1]} inputs and {G.C.shape[-2]} outputs."
        )
    _require_stable(G)
    G = G if G.period == 1 else G.lifted_compactly()
    return max((_peak(part.balanced(), 0.0, np.pi) for part in independent_parts(G)), key=float)


def _require_stable(G: StateSpace) -> None:
    """Require all poles inside the unit circle."""
    radius = G.spectral_radius
    if not radius < 1:
        raise UnstableLoopError(
            f"the system must be stable, all poles inside the unit circle; got a pole of modulus "
            f"{radius:.9g}. An unstable system has no finite norm.",
            spectral_radius=radius,
        )


def independent_parts(G: StateSpace) -> list[StateSpace]:
    """Return the parts of a system that share no state, input or output, equal ones once."""
    parts = [part for *_, part in split_into_parts(G)]
    if not all(part.n_states for part in parts):
        return [G]
    different = {tuple(getattr(part, name).tobytes() for name in "ABCD"): part for part in parts}
    return list(different.values()) or [G]


def square_parts(G: StateSpace) -> list[StateSpace]:
    """Return the parts of a square system that share nothing, each of the same channels."""
    _, inputs, outputs = part_labels(G.A, G.B, G.C, G.D)
    return independent_parts(G) if np.array_equal(inputs, outputs) else [G]


def band_norm(system: StateSpace, low_hz: float, high_hz: float) -> HinfNorm:
    """Largest singular value over a band of frequencies; poles outside the band do no harm."""
    low, high = (2 * np.pi * f * system.dt_s for f in (low_hz, high_hz))
    norm = _peak(system.balanced(), low, high)
    # rounding must not move an end of the band outside the band
    return replace(norm, peak_frequency_hz=min(max(norm.peak_frequency_hz, low_hz), high_hz))


def _peak(G: StateSpace, low: float, high: float) -> HinfNorm:
    """Largest singular value of a balanced system between two angles, by level sets."""
    largest = partial(_largest, G, schur_form(G), spectral_norms)
    seeds = _seeds(G, low, high)

    def pencil(level: float) -> FloatArray:
        # one scaling of states serves both x and p; levels are scaled to one
        B, C, D = G.B / np.sqrt(level), G.C / np.sqrt(level), G.D / level
        return popov_angles(G.A, B, C.T @ C, D.T @ C, D.T @ D - np.eye(D.shape[1]))

    peak, angle = _climb(G, seeds, largest, pencil)
    return HinfNorm(
        value=peak,
        lower=peak,
        upper=peak * (1 + 2 * _TOLERANCE),
        peak_frequency_hz=angle / (2 * np.pi * G.dt_s),
    )


def largest_real_part(system: StateSpace, *, least: float = -np.inf) -> float:
    """Largest real part of a stable square system's response over all frequencies, or ``least``.

    It is the largest eigenvalue of ``(G + G*) / 2``, found as the norm, by the level sets of
    ``G(z) + G(1/z)' = 2 level``. One level is enough where nothing exceeds ``least``.
    """
    _require_stable(system)
    return max(_largest_real_part(part.balanced(), least) for part in square_parts(system))


def _largest_real_part(G: StateSpace, least: float) -> float:
    """Largest real part of a balanced system's response, or ``least``."""
    form = schur_form(G)
    seeds = _seeds(G, 0.0, np.pi)
    size = float(np.max(np.abs(schur_response(form, np.exp(1j * seeds)))))

    def hermitian(response: ComplexArray) -> FloatArray:
        values = np.linalg.eigvalsh(response + response.conj().transpose(0, 2, 1))[:, -1] / 2
        return np.asarray(values, dtype=np.float64)

    def pencil(level: float) -> FloatArray:
        R = G.D + G.D.T - 2 * level * np.eye(len(G.D))
        return popov_angles(G.A, G.B, np.zeros_like(G.A), G.C, R)

    largest = partial(_largest, G, form, hermitian)
    peak, _ = _climb(G, seeds, largest, pencil, size=size, least=least)
    return peak + 2 * _TOLERANCE * max(size, abs(peak))


def _seeds(G: StateSpace, low: float, high: float) -> FloatArray:
    """Return the angles at which peaks are sought first."""
    return fold_angles(np.concatenate([np.angle(G.poles), np.linspace(low, high, 33)]), low, high)


def _climb(
    G: StateSpace,
    seeds: FloatArray,
    largest: Callable[[FloatArray], tuple[float, float]],
    level_angles: Callable[[float], FloatArray],
    *,
    size: float = 0.0,
    least: float = -np.inf,
) -> tuple[float, float]:
    """Find the peak between the outer seeds by raising a level until nothing lies above it.

    ``largest`` returns the largest value at some angles and its angle. ``level_angles`` returns the
    angles between which values may lie above a level. Levels rise relative to the peak, or to the
    size of what the values are parts of; the first is ``least`` if that is above the seeds.
    """
    low, high = float(seeds[0]), float(seeds[-1])
    peak, angle = largest(seeds)
    if peak == size == 0:
        return max(peak, least), angle
    peak = max(peak, least)
    if not np.isfinite(peak):
        raise NumericalError(
            f"the response at {angle / (2 * np.pi * G.dt_s):.6g} Hz is not finite to working "
            "accuracy, so it has no norm. Scale states and signals to similar sizes.",
            status="level sets",
        )
    for _ in range(100):
        level = peak + _TOLERANCE * max(size, abs(peak))
        angles = fold_angles(level_angles(level), low, high)
        new_peak, new_angle = largest(np.concatenate([angles, (angles[1:] + angles[:-1]) / 2]))
        if new_peak > peak:
            peak, angle = new_peak, new_angle
        if new_peak <= level:
            return peak, angle
    raise NumericalError(
        f"the largest value over frequency was not bracketed: it is at least {peak:.9g}. "
        "Balance the system's states.",
        status="level sets",
    )


def spectral_norms(matrices: ComplexArray) -> FloatArray:
    """Largest singular value of each matrix of a stack, (N,); nan where one is not finite.

    By the Gram matrix of the smaller side, which costs the largest one no accuracy.
    """
    if matrices.shape[-2] > matrices.shape[-1]:
        matrices = matrices.swapaxes(-1, -2)
    size = np.abs(matrices).max(axis=(-2, -1), initial=0.0)
    size = np.maximum(size, np.finfo(np.float64).tiny)  # by less, a quotient may overflow
    with np.errstate(invalid="ignore"):
        scaled = matrices / size[:, None, None]
        scaled = np.where(np.isfinite(size)[:, None, None], scaled, 0.0)
        largest = np.linalg.eigvalsh(scaled @ scaled.conj().swapaxes(-1, -2))[:, -1]
        return np.asarray(size * np.sqrt(np.maximum(largest, 0.0)), dtype=np.float64)


def fold_angles(angles: FloatArray, low: float, high: float) -> FloatArray:
    """Fold angles into [low, high] within [0, pi]; return them sorted, with both ends."""
    inside = np.abs(np.mod(angles + np.pi, 2 * np.pi) - np.pi)
    return np.unique(np.concatenate([np.clip(inside, low, high), [low, high]]))


def _largest(
    G: StateSpace,
    form: SchurForm,
    measure: Callable[[ComplexArray], FloatArray],
    angles: FloatArray,
) -> tuple[float, float]:
    """Largest measure of the response and its angle; the highest few are computed with care."""
    z = np.exp(1j * angles)
    high = np.argsort(measure(schur_response(form, z)))[-_CAREFUL:]
    careful = measure(pointwise_response(G, z[high]))
    best = int(np.argmax(careful))
    return float(careful[best]), float(angles[high[best]])


def popov_angles(
    A: FloatArray, B: FloatArray, Q: FloatArray, S: FloatArray, R: FloatArray, *, sign: float = 1.0
) -> FloatArray:
    """Angles of the generalised eigenvalues of a symplectic pencil; no matrix is inverted.

    ``z [x; A'p + Q x + S'w; 0] = [A x + B w; p; S x + B'p + R w]`` with the adjoint state p. For
    a singular value sigma, ``Q = C'C``, ``S = D'C`` and ``R = D'D - sigma^2 I``; for a level of
    the real part of a response, ``Q = 0``, ``S = C`` and ``R = D + D' - 2 level I``. With the sign
    -1 the term ``B'p`` is subtracted: for the imaginary part, ``R = D - D'``.
    """
    (n, m), zero = B.shape, np.zeros
    E = np.block([[np.eye(n), zero((n, n + m))], [Q, A.T, S.T], [zero((m, 2 * n + m))]])
    F = np.block(
        [[A, zero((n, n)), B], [zero((n, n)), np.eye(n), zero((n, m))], [S, sign * B.T, R]]
    )
    with np.errstate(all="ignore"):
        try:
            values = eigvals(F, E)
        except np.linalg.LinAlgError as error:
            raise NumericalError(
                "the eigenvalues of a symplectic pencil were not found. Try to scale the states to "
                "similar sizes.",
                status="eigenvalues",
            ) from error
    return np.asarray(np.angle(values[np.isfinite(values) & (values != 0)]))
