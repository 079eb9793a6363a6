"""Reduction of a long Youla parameter to few poles, with its programme solved again.

Functions with few poles fit the response over frequency, with the cost as the weight; their
coefficients are eliminated, so that only the poles are searched (variable projection: G. H. Golub,
V. Pereyra, SIAM J. Numer. Anal. 10, 413 (1973), doi:10.1137/0710036).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from lbt_synth.design.shaping.channel import Channel, mode_loop, orthonormal_basis
from lbt_synth.design.shaping.frequencies import distinct_bands
from lbt_synth.design.shaping.objectives import frequency_costs, leaves, noise_level
from lbt_synth.design.shaping.programme_sequence import SequenceSolution, solve_sequence
from lbt_synth.design.shaping.specification import Specification
from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.linear import Controller
from lbt_synth.validation import ComplexArray, FloatArray

_FLAT = 0.3  # weight of the whole response in the fit of poles, beside the spectra
_INTEGRAL = 2e-3  # by which the objective over the grid may miss that of the real loop
_SLOW_HZ = (0.002, 0.004, 0.008)  # where turbulence meets the noise, of the frame rate: starts
_EVALUATIONS = 300
_DROPPED = 3  # pairs of poles, each of which is tried without
_SETTLED = 1e-10  # relative change of poles and misfit
_STEEPEST = 9.0  # largest log(r / (1 - r)) of a modulus r: 1 - 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModeSolution:
    """A specification solved in one basis."""

    sequence: SequenceSolution
    objective_nm: float  # root of the objective in the real loop

    @property
    def parameter(self) -> Controller:
        """The Youla parameter."""
        return self.sequence.channel.basis.parameter(self.sequence.coefficients)


def solve_mode(
    spec: Specification, channel: Channel, *, start: FloatArray | None = None
) -> ModeSolution:
    """Solve a specification in a basis, on a grid that is fine enough for its objective."""
    miss = np.inf
    for fineness in (1, 2, 4):
        sequence = solve_sequence(spec, channel, start=start, fineness=fineness)
        parameter = channel.basis.parameter(sequence.coefficients)
        loop = mode_loop(channel.hardware, parameter)
        exact = spec.objective.measured_nm2(loop)
        miss = abs(sequence.objective_nm2 / exact - 1)
        if miss < _INTEGRAL and all(check.passed for check in spec.checks(loop)):
            return ModeSolution(sequence=sequence, objective_nm=float(np.sqrt(exact)))
    raise NumericalError(
        f"the objective over the frequencies of the programme misses that of the real loop by "
        f"{miss:.2g}, expected {_INTEGRAL:g}, or a bound is exceeded between them. Try "
        "fewer functions, a smoother spectrum, or wider bands.",
        status="quadrature",
    )


def reduce_poles(
    spec: Specification, long: ModeSolution, order: int, tolerance: float, *, fewest: bool = True
) -> ModeSolution:
    """Find the fewest poles whose programme keeps the objective within a tolerance."""
    hardware, response = long.sequence.channel.hardware, response_to_fit(spec, long.sequence)
    bands = (
        2 * np.pi * np.array(distinct_bands(leaves(spec.objective))).reshape(-1, 2) * hardware.dt_s
    )
    starts = [starting_poles(order, bands=bands, noise_rad=2 * np.pi * slow) for slow in _SLOW_HZ]
    fits = [fit_poles(response, start) for start in starts]
    poles = min(fits, key=lambda fit: fit[1])[0]

    def attempt(poles: ComplexArray) -> tuple[ModeSolution | None, float]:
        """Solve with given poles from the fit of the response, and return the relative loss."""
        channel = Channel(hardware=hardware, basis=orthonormal_basis(poles, dt_s=hardware.dt_s))
        start = response.coefficients(channel.command_rows(long.sequence.grid.nodes_hz))
        try:
            found = solve_mode(spec, channel, start=start)
        except (InfeasibleError, NumericalError):
            return None, np.inf
        return found, found.objective_nm / long.objective_nm - 1

    accepted, loss = attempt(poles)
    if accepted is None or loss > tolerance:
        states = order + hardware.mirror_system.whole.n_states
        best, advice = "none was feasible", f"Try states={2 * states}."
        if np.isfinite(loss):
            best = f"the best lost {100 * loss:.3g} %"
            advice = f"Try states={2 * states} or loss={1.1 * loss:.2g}."
        raise InfeasibleError(
            f"no controller of {states} states per mode came within {100 * tolerance:.3g} % of the "
            f"long parameter's {long.objective_nm:.4g} nm (root of the whole objective): {best}. "
            f"{advice}"
        )
    while fewest and poles.size > 2 and np.any(poles.imag):
        poles = fit_without_pair(response, poles)
        found, loss = attempt(poles)
        if found is None or loss > tolerance:
            break
        accepted = found
    return accepted


def response_to_fit(spec: Specification, long: SequenceSolution) -> WeightedResponse:
    """Response of the long parameter at the nodes, weighted by the spectra and a constant."""
    f, w, nyquist = long.grid.nodes_hz, long.grid.weights_hz, long.channel.nyquist_hz
    noise = noise_level(spec.objective) ** 2 / nyquist
    cost = w * (frequency_costs(spec.objective, f, 2 * nyquist) + noise)
    weight = np.sqrt(cost / np.sum(cost) + _FLAT**2 * w / nyquist)
    target = long.channel.command_rows(f) @ long.coefficients
    z = np.exp(1j * (2 * np.pi * f * long.channel.hardware.dt_s))
    return WeightedResponse(z, weight * target, weight)


@dataclass(frozen=True, slots=True, eq=False)
class WeightedResponse:
    """A response over frequency, and the weight of an error of it."""

    z: ComplexArray  # (f,), on the unit circle
    goal: ComplexArray  # the weighted response, (f,)
    weight: FloatArray  # (f,)

    def coefficients(self, rows: ComplexArray) -> FloatArray:
        """Return the coefficients (n,) of functions (f, n) that fit the response best."""
        columns = _real_rows(self.weight[:, None] * rows)
        return np.asarray(np.linalg.lstsq(columns, _real_rows(self.goal), rcond=None)[0])

    def residual(self, upper: ComplexArray, single: FloatArray) -> FloatArray:
        """Weighted error of the best fit with poles, real parts first, (2 f,)."""
        return self._goal - self._fitted(upper, single)[1]

    def slopes(self, upper: ComplexArray, single: FloatArray) -> FloatArray:
        """Slopes of that error as the poles move, (2 f, k), without those of the coefficients.

        Of a fit N / D only D moves: all changes of N are within the span of the functions (L.
        Kaufman, BIT Numer. Math. 15, 49 (1975), doi:10.1007/BF01932995).
        """
        q, fit = self._fitted(upper, single)
        each = fit[: self.z.size] + 1j * fit[self.z.size :]
        changes = _real_rows(each[:, None] * log_slopes(self.z, upper, single))
        return np.asarray(q @ (q.T @ changes) - changes)

    @property
    def _goal(self) -> FloatArray:
        return _real_rows(self.goal)

    def _fitted(self, upper: ComplexArray, single: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Orthonormal columns that span the fits with poles, and the best fit, (2 f,)."""
        functions = _basis_responses(self.z, upper, single)
        q, _ = np.linalg.qr(_real_rows(self.weight[:, None] * functions))
        return q, q @ (q.T @ self._goal)


def fit_poles(response: WeightedResponse, start: ComplexArray) -> tuple[ComplexArray, float]:
    """Fit the poles (n,) of functions ``z (z I - A)^-1 B`` to a response, with the misfit."""
    x0, count = vector_from_poles(start)
    size = float(np.linalg.norm(response.goal))

    def each(modulus: float, angle: float, single: float) -> FloatArray:
        return np.repeat([modulus, angle, single], [count, count, start.size - 2 * count])

    low, high = each(-3.0, 0.0, -4.0), each(_STEEPEST, np.pi, 4.0)

    def misfit(x: FloatArray) -> FloatArray:
        return response.residual(*poles_from_vector(x, count)) / size

    def slopes(x: FloatArray) -> FloatArray:
        return response.slopes(*poles_from_vector(x, count)) / size

    found = least_squares(
        misfit,
        np.clip(x0, low + 1e-6, high - 1e-6),
        jac=slopes,
        bounds=(low, high),
        xtol=_SETTLED,
        ftol=_SETTLED,
        max_nfev=_EVALUATIONS,
        x_scale=each(1.0, 0.02, 1.0),
    )
    upper, single = poles_from_vector(found.x, count)
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


def fit_without_pair(response: WeightedResponse, poles: ComplexArray) -> ComplexArray:
    """Fit the poles without a pair: the best of the fits without each of the cheapest pairs.

    One start alone may end at a local minimum, and rounding would choose which.
    """
    upper, single = poles[poles.imag > 0], poles[poles.imag == 0]
    fewer = [np.delete(upper, i) for i in range(upper.size)]
    costs = [np.linalg.norm(response.residual(each, single.real)) for each in fewer]
    starts = [fewer[int(i)] for i in np.argsort(costs)[:_DROPPED]]
    fits = [fit_poles(response, np.concatenate([p, p.conj(), single])) for p in starts]
    return min(fits, key=lambda fit: fit[1])[0]


def _real_rows(rows: ComplexArray) -> FloatArray:
    """Stack the real parts above the imaginary parts."""
    return np.concatenate([rows.real, rows.imag])


def vector_from_poles(poles: ComplexArray) -> tuple[FloatArray, int]:
    """Return log-odds of the moduli and angles of the pairs, and of real poles; count the pairs."""
    upper, real = poles[poles.imag > 0], poles[poles.imag == 0].real
    modulus = np.abs(upper)
    x = [np.log(modulus / (1 - modulus)), np.angle(upper), np.arctanh(real)]
    return np.concatenate(x), upper.size


def poles_from_vector(x: FloatArray, pairs: int) -> tuple[ComplexArray, FloatArray]:
    """Return the upper poles of the pairs, and the real poles."""
    modulus = 1 / (1 + np.exp(-x[:pairs]))
    upper = modulus * np.exp(1j * x[pairs : 2 * pairs])
    return upper.astype(np.complex128), np.tanh(x[2 * pairs :])


def log_slopes(z: ComplexArray, upper: ComplexArray, single: FloatArray) -> ComplexArray:
    """Slopes of minus the log of ``prod (z - p)`` in the vector of poles, (f, k)."""
    modulus, at = np.abs(upper), z[:, None]
    above, below = upper / (at - upper), upper.conj() / (at - upper.conj())
    return np.hstack(
        [
            (1 - modulus) * (above + below),
            1j * (above - below),
            (1 - single**2) / (at - single),
        ]
    )


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
