"""Few poles for the response of a long parameter, by weighted least squares.

Functions with few poles fit the response over frequency, with the cost as the weight; their
coefficients are eliminated, so that only the poles are searched (variable projection: G. H. Golub,
V. Pereyra, SIAM J. Numer. Anal. 10, 413 (1973), doi:10.1137/0710036).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from lbt_synth.validation import ComplexArray, FloatArray

_EVALUATIONS = 60
_STEEPEST = 9.0  # largest log(r / (1 - r)) of a modulus r: 1 - 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WeightedResponse:
    """A response over frequency, and the weight of an error of it."""

    angles: FloatArray  # (f,) [radians per frame]
    target: ComplexArray  # (f,)
    weight: FloatArray  # (f,)

    @property
    def goal(self) -> ComplexArray:
        """The weighted response, (f,)."""
        return self.weight * self.target

    def coefficients(self, rows: ComplexArray) -> FloatArray:
        """Return the coefficients (n,) of functions (f, n) that fit the response best."""
        columns = _real_rows(self.weight[:, None] * rows)
        return np.asarray(np.linalg.lstsq(columns, _real_rows(self.goal), rcond=None)[0])

    def residual(self, upper: ComplexArray, single: FloatArray) -> FloatArray:
        """Weighted error of the best fit with poles, real parts first, (2 f,)."""
        functions = _basis_responses(np.exp(1j * self.angles), upper, single)
        q, _ = np.linalg.qr(_real_rows(self.weight[:, None] * functions))
        goal = _real_rows(self.goal)
        return np.asarray(goal - q @ (q.T @ goal))


def fit_poles(response: WeightedResponse, start: ComplexArray) -> tuple[ComplexArray, float]:
    """Fit the poles (n,) of functions ``z (z I - A)^-1 B`` to a response; return the misfit too."""
    pairs, real = start[start.imag > 0], start[start.imag == 0].real
    size = float(np.linalg.norm(response.goal))
    x0 = [np.log(np.abs(pairs) / (1 - np.abs(pairs))), np.angle(pairs), np.arctanh(real)]

    def each(modulus: float, angle: float, single: float) -> FloatArray:
        return np.repeat([modulus, angle, single], [pairs.size, pairs.size, real.size])

    low, high = each(-3.0, 0.0, -4.0), each(_STEEPEST, np.pi, 4.0)

    def misfit(x: FloatArray) -> FloatArray:
        return response.residual(*_poles_from_vector(x, pairs.size)) / size

    found = least_squares(
        misfit,
        np.clip(np.concatenate(x0), low + 1e-6, high - 1e-6),
        bounds=(low, high),
        max_nfev=_EVALUATIONS,
        x_scale=each(1.0, 0.02, 1.0),
    )
    upper, single = _poles_from_vector(found.x, pairs.size)
    return np.concatenate([upper, upper.conj(), single]), float(np.linalg.norm(found.fun))


def starting_poles(count: int, *, bands: FloatArray, noise_rad: float) -> ComplexArray:
    """Poles to start the fit from: some in each band (low, high), some below and above."""
    slow = (1 - 0.8 * noise_rad) * np.exp(1j * noise_rad)
    pairs: list[complex] = [slow, 0.62 * np.exp(0.5j), 0.8 * np.exp(1.0j)]
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


def drop_cheapest_pair(response: WeightedResponse, poles: ComplexArray) -> ComplexArray:
    """Return the poles without the pair whose loss costs the fit least."""
    upper, single = poles[poles.imag > 0], poles[poles.imag == 0]
    fewer = [np.delete(upper, i) for i in range(upper.size)]
    costs = [np.linalg.norm(response.residual(each, single.real)) for each in fewer]
    kept = fewer[int(np.argmin(costs))]
    return np.concatenate([kept, kept.conj(), single])


def _real_rows(rows: ComplexArray) -> FloatArray:
    """Stack the real parts upon the imaginary parts."""
    return np.concatenate([rows.real, rows.imag])


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
        columns.append(passed * z * size / denominator)
        columns.append(passed * z * (z - pole.real) * size / denominator)
        passed = passed * (1 - pole * z) * (1 - pole.conjugate() * z) / denominator
    for pole in single:
        columns.append(passed * z / (z - pole))
        passed = passed * (1 - pole * z) / (z - pole)
    return np.stack(columns, axis=1)
