"""Few poles for the response of a long parameter, by weighted least squares.

Functions with few poles fit the response over frequency, with the cost as the weight; their
coefficients are eliminated, so that only the poles are searched (variable projection: G. H. Golub,
V. Pereyra, SIAM J. Numer. Anal. 10, 413 (1973), doi:10.1137/0710036).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from lbt_synth.validation import ComplexArray, FloatArray

_EVALUATIONS = 60
_STEEPEST = 9.0  # largest log(r / (1 - r)) of a modulus r: 1 - 1e-4


def fit_poles(
    angles: FloatArray, target: ComplexArray, weight: FloatArray, start: ComplexArray
) -> tuple[ComplexArray, float]:
    """Fit the poles (n,) of functions ``z (z I - A)^-1 B`` to a response, and its misfit.

    Shapes: angles, target, weight (f,), start (n,).
    """
    z = np.exp(1j * angles)
    pairs = start[start.imag > 0]
    real = start[start.imag == 0].real
    goal = weight * target
    size = float(np.linalg.norm(goal))

    def misfit(x: FloatArray) -> FloatArray:
        upper, single = _poles_from_vector(x, pairs.size)
        return _fit_residual(goal, weight, _basis_responses(z, upper, single)) / size

    x0 = np.concatenate(
        [np.log(np.abs(pairs) / (1 - np.abs(pairs))), np.angle(pairs), np.arctanh(real)]
    )
    bound = np.concatenate(
        [np.full(pairs.size, _STEEPEST), np.full(pairs.size, np.pi), np.full(real.size, 4.0)]
    )
    lower = np.concatenate(
        [np.full(pairs.size, -3.0), np.zeros(pairs.size), -bound[2 * pairs.size :]]
    )
    found = least_squares(
        misfit,
        np.clip(x0, lower + 1e-6, bound - 1e-6),
        bounds=(lower, bound),
        max_nfev=_EVALUATIONS,
        x_scale=np.concatenate(
            [np.ones(pairs.size), np.full(pairs.size, 0.02), np.ones(real.size)]
        ),
    )
    upper, single = _poles_from_vector(found.x, pairs.size)
    poles = np.concatenate([upper, upper.conj(), single.astype(np.complex128)])
    return poles, float(np.linalg.norm(found.fun))


def starting_poles(
    count: int, *, bands: tuple[tuple[float, float], ...], noise_rad: float
) -> ComplexArray:
    """Poles to start the fit from: some in each band (low, high), some below and above."""
    pairs: list[complex] = [
        (1 - 0.8 * noise_rad) * np.exp(1j * noise_rad),
        0.62 * np.exp(0.5j),
        0.8 * np.exp(1.0j),
    ]
    number = count // 2
    each = max((number - 3) // max(len(bands), 1), 1)
    for low, high in bands:
        width = (high - low) / (2 * each)
        centres = low + width * (2 * np.arange(each) + 1)
        pairs = [*pairs[:1], *((1 - 0.8 * width) * np.exp(1j * centres)), *pairs[1:]]
    spare = 0.5 * np.exp(1j * np.linspace(1.5, 3.0, max(number - len(pairs), 0)))
    pairs = [*pairs, *spare][:number]
    upper = np.array(pairs, dtype=np.complex128)
    single = np.full(count - 2 * upper.size, 0.3, dtype=np.complex128)
    return np.concatenate([upper, upper.conj(), single])


def drop_cheapest_pair(poles: ComplexArray, costs: FloatArray) -> ComplexArray:
    """Return the poles without the pair that costs least to drop."""
    upper = poles[poles.imag > 0]
    kept = np.delete(upper, int(np.argmin(costs)))
    return np.concatenate([kept, kept.conj(), poles[poles.imag == 0]])


def misfit_without_each_pair(
    angles: FloatArray, target: ComplexArray, weight: FloatArray, poles: ComplexArray
) -> FloatArray:
    """Misfit of the response when each pair of poles is dropped, (pairs,)."""
    z = np.exp(1j * angles)
    upper, single = poles[poles.imag > 0], poles[poles.imag == 0].real
    goal = weight * target
    functions = (_basis_responses(z, np.delete(upper, i), single) for i in range(upper.size))
    return np.array([np.linalg.norm(_fit_residual(goal, weight, each)) for each in functions])


def _fit_residual(goal: ComplexArray, weight: FloatArray, functions: ComplexArray) -> FloatArray:
    """Rest of a goal beside real multiples of weighted functions, real parts first."""
    columns = weight[:, None] * functions
    q, _ = np.linalg.qr(np.vstack([columns.real, columns.imag]))
    stacked = np.concatenate([goal.real, goal.imag])
    return np.asarray(stacked - q @ (q.T @ stacked))


def _poles_from_vector(x: FloatArray, pairs: int) -> tuple[ComplexArray, FloatArray]:
    modulus = 1 / (1 + np.exp(-x[:pairs]))
    upper = modulus * np.exp(1j * x[pairs : 2 * pairs])
    return upper.astype(np.complex128), np.tanh(x[2 * pairs :])


def _basis_responses(z: ComplexArray, upper: ComplexArray, single: FloatArray) -> ComplexArray:
    """Responses that span the orthonormal functions of the poles, well conditioned."""
    columns = []
    passed = np.ones(z.size, dtype=np.complex128)
    for pole in upper:
        denominator = (z - pole) * (z - pole.conjugate())
        size = abs(1 - abs(pole))
        columns += [
            passed * z * size / denominator,
            passed * z * (z - pole.real) * size / denominator,
        ]
        passed = passed * (1 - pole * z) * (1 - pole.conjugate() * z) / denominator
    for pole in single:
        columns.append(passed * z / (z - pole))
        passed = passed * (1 - pole * z) / (z - pole)
    return np.stack(columns, axis=1)
