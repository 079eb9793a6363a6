"""A controller made again for coarse arithmetic: as many coefficients as the computer has.

A direct form of poles close to z = 1 is fragile: its polynomials nearly vanish there, so an error
of one coefficient, or the rounding of a sum, moves the loop by much. A larger order than the
controller needs leaves freedom: a factor common to both polynomials, with roots far from z = 1,
makes them larger where they are small. From there all coefficients are moved until what the loop
leaves, rounding included, is least: a nonlinear least-squares problem.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from lbt_synth.interop.dao.mode_loop import DirectFormLoop, Scenario
from lbt_synth.validation import ComplexArray, FloatArray

_RADIUS = 0.92  # of the roots that are added
_ROOM = 2e-3  # of each limit
_ENOUGH = 1.006  # times what the design leaves
_EDGE = 3e-3  # weight of the loops at the ends of the sensor gains
_FAR = -1.7  # a section with a larger first coefficient is far from z = 1
# Weight of the rounding, weight of what exceeds a limit, largest squared modulus of the roots of
# sections far from z = 1: one search each.
_STEPS = (
    *((0.03, 3.0, 0.92), (0.1, 3.0, 0.92), (0.3, 3.0, 0.92), (1.0, 3.0, 0.92)),
    *((1.0, 3.0, 0.94), (1.0, 6.0, 0.96), (1.0, 10.0, 0.96)),
    *[(1.0, 15.0, 0.96)] * 12,
)
_LINE = 0.3  # weight of a vibration's mean power; its largest is a limit
_HASTE = 12  # power of its residual with which a scenario gains weight
_EVALUATIONS = 60  # of one search
_DAMPED = 0.5  # of the own loop's distance from instability, at least
_GAINS = 25  # sensor gains at which a step must be stable


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Targets:
    """What the controller of the design leaves, which another must not exceed."""

    residuals_nm: FloatArray  # (G,)
    peaks_nm: FloatArray  # (G,) of the vibration
    radius: float  # largest over the sensor gains
    sensitivity: float  # largest at unit sensor gain
    edges: tuple[float, float]  # largest at the lowest and the highest sensor gain


@dataclass(frozen=True, slots=True)
class _Weights:
    scenarios: FloatArray  # (G,)
    rounding: float
    limits: float
    modulus: float


def refit(loop: DirectFormLoop, exact: FloatArray) -> FloatArray:
    """Return coefficients (2 M + 1,), M even, whose loop leaves least, rounding included."""
    targets = _targets(loop, exact)
    theta = _sections(loop, _widened(loop, exact))
    weights = np.ones(len(loop.scenarios))
    for rounding, steepness, modulus in _STEPS:
        theta = _search(loop, targets, theta, _Weights(weights, rounding, steepness, modulus))
        c = _coefficients(loop, theta)
        left = np.hypot(loop.residuals_nm(c), loop.rounding_nm(c)) / targets.residuals_nm
        if np.max(left) < _ENOUGH and steepness == _STEPS[-1][1]:
            break
        if rounding == 1.0:
            weights *= left**_HASTE
            weights /= np.mean(weights)
    return c


def _widened(loop: DirectFormLoop, exact: FloatArray) -> FloatArray:
    """Multiply both polynomials by a factor with roots away from z = 1, up to the order."""
    M = loop.order
    b, a = np.trim_zeros(exact[: M + 1], "b"), np.r_[1.0, -np.trim_zeros(exact[M + 1 :], "b")]
    spare = M + 1 - max(b.size, a.size)
    angles = np.linspace(np.pi / 2, np.pi, spare // 2, endpoint=False)
    roots = np.concatenate([_RADIUS * np.exp(1j * angles), [-_RADIUS] * (spare % 2)])
    factor = np.poly(np.concatenate([roots, roots[: spare // 2].conj()])).real
    wide = np.zeros(2 * M + 1)
    b, a = np.convolve(b, factor), np.convolve(a, factor)
    wide[: b.size], wide[M + 1 : M + a.size] = b, -a[1:]
    return wide


def _targets(loop: DirectFormLoop, exact: FloatArray) -> _Targets:
    def sensitivity(gain: float) -> FloatArray:
        a, _, p = loop.polynomials(exact, gain)
        return np.abs(a / p)

    peaks = [np.max(s.line_nm * sensitivity(s.sensor_gain)) for s in loop.scenarios]
    return _Targets(
        residuals_nm=loop.residuals_nm(exact),
        peaks_nm=np.array(peaks),
        radius=loop.radius(exact, _gains(loop)),
        sensitivity=float(np.max(sensitivity(1.0))),
        edges=(float(np.max(sensitivity(loop.low))), float(np.max(sensitivity(loop.high)))),
    )


def _gains(loop: DirectFormLoop) -> FloatArray:
    return np.concatenate([np.geomspace(loop.low, loop.high, _GAINS), [1.0]])


def _search(
    loop: DirectFormLoop,
    targets: _Targets,
    theta: FloatArray,
    weights: _Weights,
) -> FloatArray:
    """Descend from theta; a step to a loop that is unstable at any sensor gain is not taken."""
    gains = _gains(loop)
    loop_limit = 1 - _DAMPED * (1 - targets.radius)
    latest: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def rows(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = x.tobytes()
        if key not in latest:
            latest.clear()
            latest[key] = _rows(loop, targets, x, weights)
        return latest[key]

    count = rows(theta)[0].size

    def errors(x: FloatArray) -> FloatArray:
        stable = loop.radius(_coefficients(loop, x), gains) < loop_limit
        return rows(x)[0] if stable else np.full(count, 1e3)

    def slopes(x: FloatArray) -> FloatArray:
        return rows(x)[1]

    found = least_squares(
        errors,
        theta,
        jac=slopes,
        x_scale="jac",
        max_nfev=_EVALUATIONS,
        ftol=1e-5,
        xtol=1e-12,
    )
    return np.asarray(found.x)


def _rows(
    loop: DirectFormLoop,
    targets: _Targets,
    theta: FloatArray,
    weights: _Weights,
) -> tuple[FloatArray, FloatArray]:
    """Return the errors whose squares are minimised, and their Jacobian."""
    a, b, da, db = _responses(loop, theta)
    c, dc = _coefficients(loop, theta), _coefficient_slopes(loop, theta)
    blocks: list[tuple[FloatArray | ComplexArray, FloatArray | ComplexArray]] = []

    def below(size: FloatArray, slope: FloatArray, limit: float) -> None:
        over = np.maximum(size / limit - 1 + _ROOM, 0.0)
        blocks.append((weights.limits * over, weights.limits / limit * slope * (over > 0)[:, None]))

    cases = list(
        zip(loop.scenarios, weights.scenarios, targets.residuals_nm, targets.peaks_nm, strict=True)
    )
    for s, weight, residual, peak in cases:
        S, dS, p, dp = _sensitivity(loop, s.sensor_gain, a, b, da, db)
        share = np.sqrt(weight) / residual
        size = share * np.sqrt(s.phase_nm2 + _LINE * s.spread_nm2)
        blocks.append((size * S, size[:, None] * dS))
        size = share * np.sqrt(s.noise_nm2) * loop.path
        blocks.append((size * b / p, size[:, None] * (db - (b / p)[:, None] * dp) / p[:, None]))
        blocks.append(_rounding_rows(loop, s, c, dc, p, dp, share * weights.rounding))
        inside = s.line_nm > 0
        if np.any(inside):
            line = s.line_nm[inside]
            modulus, slope = _modulus(S[inside], dS[inside])
            below(line * modulus, line[:, None] * slope, peak)
    S, dS, *_ = _sensitivity(loop, 1.0, a, b, da, db)
    below(*_modulus(S, dS), targets.sensitivity)
    for gain, edge in zip((loop.low, loop.high), targets.edges, strict=True):
        S_edge, dS_edge, *_ = _sensitivity(loop, gain, a, b, da, db)
        below(*_modulus(S_edge, dS_edge), edge)
        size = np.sqrt(_EDGE * loop.shares)
        blocks.append((size * S_edge, size[:, None] * dS_edge))
    if loop.low < 1:  # the loop at g is stable while Re T is below 1 / (1 - g)
        below(1 - S.real, -dS.real, 1 / (1 - loop.low))
    if loop.high > 1:
        below(S.real - 1, dS.real, 1 / (loop.high - 1))
    blocks.append(_root_rows(loop, theta, weights.modulus))
    errors = np.concatenate([np.asarray(error, dtype=np.complex128) for error, _ in blocks])
    slopes = np.concatenate([np.asarray(slope, dtype=np.complex128) for _, slope in blocks])
    return np.r_[errors.real, errors.imag], np.r_[slopes.real, slopes.imag]


def _sensitivity(
    loop: DirectFormLoop,
    gain: float,
    a: ComplexArray,
    b: ComplexArray,
    da: ComplexArray,
    db: ComplexArray,
) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
    """Return S, its slopes, p and its slopes."""
    p, dp = a + gain * loop.path * b, da + gain * loop.path[:, None] * db
    S = a / p
    return S, (da - S[:, None] * dp) / p[:, None], p, dp


def _modulus(values: ComplexArray, slopes: ComplexArray) -> tuple[FloatArray, FloatArray]:
    modulus = np.abs(values)
    turned = (values.conj() / np.maximum(modulus, 1e-300))[:, None] * slopes
    return modulus, turned.real


def _rounding_rows(
    loop: DirectFormLoop,
    scenario: Scenario,
    c: FloatArray,
    dc: FloatArray,
    p: ComplexArray,
    dp: ComplexArray,
    share: float,
) -> tuple[ComplexArray, ComplexArray]:
    """Return what the rounding leaves; the memory's size counts as constant in the slopes."""
    V = loop.rounding_matrix(c, scenario)
    sums = np.sqrt(c @ V @ c)
    size = share * np.sqrt(loop.shares) * loop.path / p
    return size * sums, size[:, None] * ((c @ V @ dc / sums)[None] - sums * dp / p[:, None])


def _root_rows(
    loop: DirectFormLoop, theta: FloatArray, modulus: float
) -> tuple[FloatArray, FloatArray]:
    """Keep the roots far from z = 1 well inside the circle: the loop does not see them."""
    first = _first_coefficients(loop)
    over = np.where(theta[first] > _FAR, np.maximum(theta[first + 1] - modulus, 0.0), 0.0)
    slopes = np.zeros((first.size, theta.size))
    slopes[np.arange(first.size), first + 1] = 30.0 * (over > 0)
    return 30.0 * over, slopes


def _first_coefficients(loop: DirectFormLoop) -> np.ndarray:
    """Return where in theta each section's coefficient of z^-1 stands."""
    M = loop.order
    return np.concatenate([np.arange(0, M, 2), np.arange(M + 1, 2 * M + 1, 2)])


def _sections(loop: DirectFormLoop, c: FloatArray) -> FloatArray:
    """Return theta: the quadratic sections of a, the factor of b, the sections of b."""
    M = loop.order
    parts = []
    for polynomial in (np.r_[1.0, -c[M + 1 :]], c[: M + 1] / c[0]):
        roots = np.roots(polynomial[: M + 1])
        roots = np.concatenate([roots, np.zeros(M - roots.size)])
        pairs = roots[roots.imag > 0]
        real = np.sort(roots[roots.imag == 0].real)
        quadratic = [np.stack([-2 * pairs.real, np.abs(pairs) ** 2], axis=1)]
        quadratic.append(np.stack([-(real[::2] + real[1::2]), real[::2] * real[1::2]], axis=1))
        parts.append(np.concatenate(quadratic).ravel())
    return np.concatenate([parts[0], c[:1], parts[1]])


def _expand(sections: FloatArray) -> FloatArray:
    polynomial = np.ones(1)
    for first, second in sections.reshape(-1, 2):
        polynomial = np.convolve(polynomial, [1.0, first, second])
    return polynomial


def _coefficients(loop: DirectFormLoop, theta: FloatArray) -> FloatArray:
    M = loop.order
    c = np.zeros(2 * M + 1)
    c[: M + 1] = theta[M] * _expand(theta[M + 1 :])
    c[M + 1 :] = -_expand(theta[:M])[1:]
    return c


def _coefficient_slopes(loop: DirectFormLoop, theta: FloatArray) -> FloatArray:
    """Return the slopes (2 M + 1, theta) of the coefficients."""
    M = loop.order
    slopes = np.zeros((2 * M + 1, theta.size))
    slopes[: M + 1, M] = _expand(theta[M + 1 :])
    for k in range(0, M, 2):
        rest = -_expand(np.delete(theta[:M], [k, k + 1]))
        slopes[M + 1 : 2 * M, k] = rest
        slopes[M + 2 :, k + 1] = rest
        rest = theta[M] * _expand(np.delete(theta[M + 1 :], [k, k + 1]))
        slopes[1:M, M + 1 + k] = rest
        slopes[2 : M + 1, M + 2 + k] = rest
    return slopes


def _responses(loop: DirectFormLoop, theta: FloatArray) -> tuple[ComplexArray, ...]:
    """Return a and b at the nodes, and their slopes (F, theta)."""
    M, late = loop.order, loop.powers[:, 1:3]
    a_sections = 1 + theta[:M].reshape(-1, 2) @ late.T  # (sections, F)
    b_sections = 1 + theta[M + 1 :].reshape(-1, 2) @ late.T
    a, unit = np.prod(a_sections, axis=0), np.prod(b_sections, axis=0)
    b = theta[M] * unit
    da, db = np.zeros((2, a.size, theta.size), dtype=np.complex128)
    db[:, M] = unit
    for k in range(2):
        da[:, k:M:2] = (a * late[:, k] / a_sections).T
        db[:, M + 1 + k :: 2] = (b * late[:, k] / b_sections).T
    return a, b, da, db
