"""The target dao: the matrix that Durham's dao real-time computers load, one column per mode.

Per mode ``u(k) = b_0 y(k) + .. + b_M y(k-M) + a_1 u(k-1) + .. + a_M u(k-M)``, in rows b, then a.

Poles close to z = 1 make both polynomials nearly vanish there, so that each rounding moves the loop
by much. A common factor with roots far from there makes them larger and leaves the controller as it
is. A robust design that this does not save is made again: from the factor the coefficients move
until what the loop leaves, rounding included, is least, and last they are rounded one by one.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.signal import sos2tf, tf2sos

from lbt_synth.design import Design
from lbt_synth.design.result import require_hardware
from lbt_synth.design.shaping.channel import Channel, laguerre_basis
from lbt_synth.design.shaping.specification import Specification
from lbt_synth.design.shaping.terms import ResidualVariance, spectrum_of
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.interop.pipeline import ModeDesign, Target
from lbt_synth.interop.proof import (
    LOSS,
    ROUNDOFF,
    Written,
    demanded_gains,
    prove_written,
    sums_variance,
)
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.models import LoopHardware
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, frozen_copy, integer

# Mean square of the relative error of an operation. The error is uniform within half a step, and a
# step is 2^-24 to 2^-23 of the number: of normal numbers of any size the mean square is at most
# 0.544 of what it would be if all steps were the widest, of a sinusoid 0.66.
ROUNDING = 2 / 3 * ROUNDOFF["single"] ** 2 / 3
_USUAL = 20  # M of the computers that we know; a design of a higher order needs that order
_WIDEST = 20  # roots of a common factor: with more, its sums round by more than it saves
_RADIUS = 0.92  # of the roots that are added, and largest square of one that the search moves
_ROOM = 2e-3  # of each limit, for what lies between the nodes
_SEARCHES = 19  # at most, each with other weights of the scenarios
_EVALUATIONS = 60  # of one search
_HASTE = 12  # power of its residual with which a scenario gains weight
_STEEP = 5.0  # weight of what exceeds a limit
_LINE = 0.3  # weight of a vibration's mean power; its largest is a limit
_GAINS = 25  # sensor gains at which a step must be stable
_NOTHING = 1e-14  # of the largest coefficient of a numerator; less counts as zero
_COUPLED = 1e-9  # of the largest entry of a matrix; less is what a solver leaves of a zero
_NEGLIGIBLE = 1e-13  # of the largest coefficient; single precision has no use for less
_SIGN = "actuators = -M2V u; y and u in the units of the mode, with the mirror's sign"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DirectFormLoop:
    """One mode, whose controller is ``c = (b_0 .. b_M, a_1 .. a_M)``, in S scenarios.

    With the path L and ``b = sum b_j z^-j``, ``a = 1 - sum a_i z^-i``, ``p = a + g L b`` at the
    sensor gain g, the loop leaves ``a / p`` of the phase and ``L b / p`` of the noise.
    """

    powers: ComplexArray  # (F, M + 1), z^-j at each node
    path: ComplexArray  # (F,)
    path_taps: FloatArray  # of the path, in powers of z^-1
    shares: FloatArray  # (F,) of the frequencies that a node stands for; their sum is 1
    gains: tuple[float, ...]  # (S,) sensor gain of each scenario
    phase_nm2: FloatArray  # (S, F) power of turbulence and skirts at each node
    noise_nm2: FloatArray  # (S, F)
    line_nm: FloatArray  # (S, F) rms of the vibration that may be there, or 0
    spread_nm2: FloatArray  # (S, F) its power, spread evenly over its band
    low: float  # ends of the sensor gains for which the loop is to be stable
    high: float

    def polynomials(self, c: FloatArray, sensor_gain: float) -> tuple[ComplexArray, ...]:
        """Return a, b and p at the nodes, (F,) each."""
        M = c.size // 2
        b, a = self.powers @ c[: M + 1], 1 - self.powers[:, 1:] @ c[M + 1 :]
        return a, b, a + sensor_gain * self.path * b

    def slopes(self) -> tuple[ComplexArray, ComplexArray]:
        """Return the slopes of a and of L b, (F, 2 M + 1) each."""
        of_a = np.hstack([np.zeros_like(self.powers), -self.powers[:, 1:]])
        of_b = np.hstack([self.path[:, None] * self.powers, np.zeros_like(self.powers[:, 1:])])
        return of_a, of_b

    def residuals_nm(self, c: FloatArray, *, rounding: bool = False) -> FloatArray:
        """Return the rms of the residual in each scenario, in exact or in rounded arithmetic."""
        variances = []
        for s, gain in enumerate(self.gains):
            a, b, p = self.polynomials(c, gain)
            variance = self.phase_nm2[s] @ np.abs(a / p) ** 2
            variance += self.noise_nm2[s] @ np.abs(self.path * b / p) ** 2
            variance += np.max(self.line_nm[s] * np.abs(a / p)) ** 2
            if rounding:
                variance += self.sums_nm2(c, gain) * (self.shares @ np.abs(self.path / p) ** 2)
            variances.append(variance)
        return np.sqrt(variances)

    def rounding_matrix(self, c: FloatArray, s: int) -> FloatArray:
        """Return V: ``c' V c`` is the variance of the rounding of products and sums [nm^2]."""
        gain = self.gains[s]
        a, b, p = self.polynomials(c, gain)
        memory = np.hstack([self.powers * (a / p)[:, None], self.powers[:, 1:] * (b / p)[:, None]])
        phase = self.phase_nm2[s] + self.spread_nm2[s]
        size = np.sqrt(gain**2 * phase + self.noise_nm2[s])[:, None] * memory
        moments = (size.conj().T @ size).real
        index = np.arange(c.size)
        after = c.size - np.maximum(np.maximum.outer(index, index), 1)  # sums that hold both terms
        variance: FloatArray = ROUNDING * (moments * after + np.diag(np.diag(moments)))
        return variance

    def sums_nm2(self, c: FloatArray, sensor_gain: float) -> float:
        """Return the variance of the sums' rounding at a sensor gain, in units of measurements."""
        return float(c @ self.rounding_matrix(c, self.gains.index(sensor_gain)) @ c)

    def radius(self, c: FloatArray) -> float:
        """Return the largest spectral radius over the sensor gains."""
        M, extra = c.size // 2, self.path_taps.size - 1
        gains = np.append(np.geomspace(self.low, self.high, _GAINS), 1.0)
        a = np.concatenate([[1.0], -c[M + 1 :], np.zeros(extra)])
        p = a + gains[:, None] * np.convolve(self.path_taps, c[: M + 1])
        companion = np.tile(np.eye(M + extra, k=-1), (gains.size, 1, 1))
        companion[:, 0] = -p[:, 1:] / p[:, :1]
        return float(np.max(np.abs(np.linalg.eigvals(companion))))

    @property
    def bounded_gains(self) -> list[float]:
        """Sensor gains at which the sensitivity has limits."""
        return sorted({1.0, self.low, self.high, *self.gains})


def mode_loops(design: Design, order: int) -> list[DirectFormLoop]:
    """Return the loop of each mode of a shaped design, the same for equal ones; none of others."""
    if not design.mode_specifications:
        return []
    hardware = require_hardware(design, "dao")
    keys = list(zip(design.first_equal_modes, np.diag(hardware.sensor).tolist(), strict=True))
    loops = {
        (mode, sensor): mode_loop(hardware, design.mode_specifications[mode], order, sensor)
        for mode, sensor in set(keys)
    }
    return [loops[key] for key in keys]


def mode_loop(
    hardware: LoopHardware, specification: Specification, order: int, sensor: float = 1.0
) -> DirectFormLoop:
    """Return the loop of one mode of a shaped design, at the frequencies that it was shaped at."""
    single = hardware.single_mode()
    channel = Channel(hardware=single, basis=laguerre_basis(1, 0.0, dt_s=single.dt_s))
    grid = specification.grid(channel, fineness=2)
    more = [grid.points_hz, *(grid.within(*band) for band in specification.bands_hz)]
    f = np.concatenate([grid.nodes_hz, *more])
    width = np.concatenate([grid.weights_hz, np.zeros(f.size - grid.nodes_hz.size)])
    terms = specification.terms
    gains = tuple(sorted({term.sensor_gain for term in terms}, reverse=True))
    phase, noise, line, spread = np.zeros((4, len(gains), f.size))
    for term in terms:
        s, spectrum = gains.index(term.sensor_gain), spectrum_of(term, single.frame_rate_hz)
        phase[s] += 0.0 if spectrum is None else width * spectrum.psd(f)
        if isinstance(term, ResidualVariance):
            noise[s] += width / channel.nyquist_hz * term.noise_nm**2
        else:
            covered = (f >= term.low_hz) & (f <= term.high_hz)
            line[s] = np.hypot(line[s], np.where(covered, term.rms_nm, 0.0))
            evenly = np.where(covered, width, 0.0)
            spread[s] += term.rms_nm**2 * evenly / np.sum(evenly)
    low, high = demanded_gains([specification])
    taps = sensor * np.concatenate([[0.0], single.mirror_taps])
    powers = np.exp(-2j * np.pi * np.outer(f * single.dt_s, np.arange(max(order + 1, taps.size))))
    return DirectFormLoop(
        powers=powers[:, : order + 1],
        path=powers[:, : taps.size] @ taps,
        path_taps=taps,
        shares=width / channel.nyquist_hz,
        gains=gains,
        phase_nm2=phase,
        noise_nm2=noise,
        line_nm=line,
        spread_nm2=spread,
        low=low,
        high=high,
    )


def make_again(design: Design, exact: FloatArray) -> NDArray[np.float32]:
    """Return a shaped design's matrix made again; without b_0 or at odd order the rounded one."""
    order, rounded = len(exact) // 2, exact.astype(np.float32)
    if order % 2 or not exact[0].all():
        return rounded
    made: dict[DirectFormLoop, NDArray[np.float32]] = {}
    for mode, loop in enumerate(mode_loops(design, order)):
        if loop not in made:
            made[loop] = round_together(loop, refit(loop, exact[:, mode]))
        rounded[:, mode] = made[loop]
    return rounded


def refit(loop: DirectFormLoop, exact: FloatArray) -> FloatArray:
    """Return coefficients (2 M + 1,), M even, whose loop leaves least, rounding included."""
    allowed_nm, limits = loop.residuals_nm(exact), _limits(loop, exact)
    theta, weights = _sections(_widened(exact)), np.ones(len(loop.gains))
    for _ in range(_SEARCHES):
        theta = _search(loop, theta, np.sqrt(weights) / allowed_nm, limits)
        lost = loop.residuals_nm(_coefficients(theta), rounding=True) / allowed_nm
        if np.max(lost) < 1 + LOSS / 4:  # the rest is for the rounded coefficients
            break
        weights *= lost**_HASTE
        weights /= np.mean(weights)
    return _coefficients(theta)


def round_together(loop: DirectFormLoop, exact: FloatArray) -> NDArray[np.float32]:
    """Round coefficients one by one, the most sensitive first; the rest makes up for each in p."""
    of_a, of_b = loop.slopes()
    seen = np.concatenate(
        [(of_a + g * of_b) / loop.polynomials(exact, g)[2][:, None] for g in loop.bounded_gains]
    )
    used = np.flatnonzero(exact)
    step = np.spacing(np.abs(exact[used]).astype(np.float32)).astype(np.float64)
    moved = np.concatenate([seen.real, seen.imag])[:, used] * step
    order = np.argsort(np.linalg.norm(moved, axis=0))
    R, used, step = np.linalg.qr(moved[:, order])[1], used[order], step[order]
    wanted, nearest = exact[used] / step, np.zeros(used.size)
    for k in range(used.size - 1, -1, -1):
        made_up = R[k, k + 1 :] @ (wanted[k + 1 :] - nearest[k + 1 :]) / R[k, k]
        nearest[k] = np.round(wanted[k] + made_up)
    rounded = np.zeros(exact.size, dtype=np.float32)
    rounded[used] = nearest * step
    return rounded


def _widened(exact: FloatArray, width: int | None = None) -> FloatArray:
    """Multiply both polynomials by a factor with roots away from z = 1, at most up to the order.

    With a width, they are at roots of unity, whose places next to z = 1 the poles take.
    """
    M = exact.size // 2
    b, a = np.trim_zeros(exact[: M + 1], "b"), np.r_[1.0, -np.trim_zeros(exact[M + 1 :], "b")]
    longer = max(b.size, a.size)
    spare = M + 1 - longer if width is None else min(width, M + 1 - longer)
    gap = np.pi / 2 if width is None else np.pi * longer / (longer - 1 + spare)
    angles = np.linspace(gap, np.pi, spare // 2, endpoint=False)
    roots = _RADIUS * np.concatenate(
        [np.exp(1j * angles), np.exp(-1j * angles), [-1] * (spare % 2)]
    )
    factor, wide = np.poly(roots).real, np.zeros(2 * M + 1)
    b, a = np.convolve(b, factor), np.convolve(a, factor)
    wide[: b.size], wide[M + 1 : M + a.size] = b, -a[1:]
    return wide


def _limits(loop: DirectFormLoop, exact: FloatArray) -> dict[float, FloatArray]:
    """Return what the sensitivity of the design does not exceed: in the bands, and everywhere."""
    limits = {}
    for gain in loop.bounded_gains:
        a, _, p = loop.polynomials(exact, gain)
        S = np.abs(a / p)
        limits[gain] = np.full(S.size, np.max(S) if gain in (1.0, loop.low, loop.high) else np.inf)
        for line in (loop.line_nm[s] for s, g in enumerate(loop.gains) if g == gain):
            if np.any(band := line > 0):
                limits[gain][band] = np.max((line * S)[band]) / line[band]
    return limits


def _search(
    loop: DirectFormLoop,
    theta: FloatArray,
    shares: FloatArray,
    limits: dict[float, FloatArray],
) -> FloatArray:
    """Descend from theta; a step to a loop that is unstable at any sensor gain is not taken."""
    M, upper = theta.size // 2, np.full(theta.size, np.inf)
    second = np.r_[1:M:2, M + 2 : 2 * M + 1 : 2]
    upper[second] = np.maximum(_RADIUS, theta[second] + _ROOM)

    def errors(x: FloatArray) -> FloatArray:
        stable = loop.radius(_coefficients(x)) < 1
        return _rows(loop, shares, limits, x)[0] + (0.0 if stable else np.inf)

    def slopes(x: FloatArray) -> FloatArray:
        return _rows(loop, shares, limits, x)[1]

    return np.asarray(
        least_squares(
            errors,
            theta,
            jac=slopes,
            bounds=(-np.inf, upper),
            x_scale="jac",
            max_nfev=_EVALUATIONS,
            ftol=1e-5,
            xtol=1e-12,
        ).x
    )


def _rows(
    loop: DirectFormLoop, shares: FloatArray, limits: dict[float, FloatArray], theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the errors, by the weights of a nanometre and limits of S, and their Jacobian."""
    c, (of_a, of_b) = _coefficients(theta), loop.slopes()
    blocks: list[tuple[FloatArray | ComplexArray, FloatArray | ComplexArray]] = []

    def below(size: FloatArray, slope: FloatArray) -> None:
        over = np.maximum(size - 1 + _ROOM, 0.0)
        blocks.append((_STEEP * over, _STEEP * (over > 0)[:, None] * slope))

    for gain, limit in limits.items():
        a, b, p = loop.polynomials(c, gain)
        S, T, dp = a / p, loop.path * b / p, of_a + gain * of_b
        dS, dT = (of_a - S[:, None] * dp) / p[:, None], (of_b - T[:, None] * dp) / p[:, None]
        below(np.abs(S) / limit, ((S.conj() / np.abs(S) / limit)[:, None] * dS).real)
        for end in (loop.low, loop.high) if gain == 1 else ():
            below((1 - end) * T.real, (1 - end) * dT.real)  # or the loop at it is unstable
        for s in (s for s, g in enumerate(loop.gains) if g == gain):
            size = shares[s] * np.sqrt(loop.phase_nm2[s] + _LINE * loop.spread_nm2[s])
            blocks.append((size * S, size[:, None] * dS))
            size = shares[s] * np.sqrt(loop.noise_nm2[s])
            blocks.append((size * T, size[:, None] * dT))
            V = loop.rounding_matrix(c, s)  # its own slopes are left out
            sums = np.sqrt(c @ V @ c)
            entry = shares[s] * np.sqrt(loop.shares) * loop.path / p
            blocks.append((entry * sums, entry[:, None] * (V @ c / sums - sums * dp / p[:, None])))
    # slopes in theta: each coefficient is linear in each number of theta
    moved = np.array([_coefficients(theta + unit) - c for unit in np.eye(theta.size)]).T
    errors, slopes = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    return np.concatenate([errors.real, errors.imag]), np.vstack([slopes.real, slopes.imag]) @ moved


def _sections(c: FloatArray) -> FloatArray:
    """Return theta: the quadratic sections of a, the factor of b, the sections of b."""
    M = c.size // 2
    sections = tf2sos(c[: M + 1], np.r_[1.0, -c[M + 1 :]])
    b = sections[:, 1:3] / sections[:, :1]
    return np.concatenate([sections[:, 4:].ravel(), c[:1], b.ravel()])


def _coefficients(theta: FloatArray) -> FloatArray:
    M = theta.size // 2
    ones, sections_b = np.ones((M // 2, 1)), theta[M + 1 :].reshape(-1, 2)
    b, a = sos2tf(np.hstack([ones, sections_b, ones, theta[:M].reshape(-1, 2)]))
    return np.concatenate([theta[M] * b, -a[1:]])


_Matrix: TypeAlias = NDArray[np.float32]


def direct_form_rows(controller: Controller, order: int | None = None) -> FloatArray:
    """Return the matrix (2 M + 1, modes) of a controller of order M or, by default, of its own."""
    polynomials = mode_polynomials(controller)
    if order is None:
        order = max(_USUAL, *(len(den) // 2 * 2 for _, den in polynomials))  # even
    rows = np.zeros((2 * order + 1, len(polynomials)))
    for mode, (num, den) in enumerate(polynomials):
        needed = len(den) - 1
        if needed > order:
            raise ProblemError(
                f"order must be at least {needed}, that of the controller of mode {mode + 1}; got "
                f"{order}. Raise it there and in the RTC's configuration, or design with fewer "
                "states."
            )
        rows[: needed + 1, mode] = num
        rows[order + 1 : order + 1 + needed, mode] = -den[1:]
    return rows


def mode_polynomials(controller: Controller) -> list[tuple[FloatArray, FloatArray]]:
    """Return numerator and denominator (k,) of each mode in the powers of ``z^-1`` it needs."""
    system, size = controller.to_statespace().balanced(), controller.n_states
    m, q = system.D.shape
    if m != q:
        raise ProblemError(
            f"a filter per mode needs as many commands as measurements; got {m} commands and {q} "
            "measurements. Use a target of matrices, such as c."
        )
    A, B, C, D = (_is_significant(getattr(system, name)) for name in "ABCD")
    linked = np.linalg.matrix_power(A | np.eye(size, dtype=np.bool_), size)
    coupled = np.argwhere((D | (C @ linked @ B)) & ~np.eye(m, dtype=np.bool_))
    if coupled.size:
        raise ProblemError(
            f"the modes must decouple; here measurement {coupled[0, 1] + 1} moves command "
            f"{coupled[0, 0] + 1}. For a configuration, try the method robust, which controls each "
            "axis alone, or a target of matrices, such as c.",
            in_python="For a record, try design_from_record(record, separate_axes=True).",
            at_terminal="For a record, try lbt-synth auto --separate-axes.",
        )
    return [_mode_filter(system, mode, linked) for mode in range(m)]


def _mode_filter(system: StateSpace, mode: int, linked: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the polynomials of a mode, without states that it does not drive or does not show.

    Powers of ``z^-1`` that neither has are left out. What overflows is not a number.
    """
    b, c, d = system.B[:, mode], system.C[mode], system.D[mode, mode]
    inside = (linked @ _is_significant(b)) & (_is_significant(c) @ linked)
    A = system.A[np.ix_(inside, inside)]
    with np.errstate(all="ignore"):
        entry = np.outer(b[inside], c[inside])
        scale = 1 / (np.max(np.abs(entry), initial=0.0) or 1.0)
        # det(zI - A + b c) = det(zI - A) + c adj(zI - A) b
        den, moved = _characteristic(A), _characteristic(A - scale * entry)
        num = d * den + (moved - den) / scale
        num[np.abs(num) <= _NOTHING * np.max(np.abs(num))] = 0.0
        shares = [np.abs(values) / (np.max(np.abs(values)) or 1.0) for values in (num, den)]
    used = ~(np.max(shares, axis=0) <= _NEGLIGIBLE)  # what is no number is used, and refused
    count = 1 + int(np.flatnonzero(used)[-1])
    return num[:count], den[:count]


def _characteristic(A: FloatArray) -> FloatArray:
    """Return the characteristic polynomial, highest power first."""
    if not A.size or not np.all(np.isfinite(A)):
        return np.full(len(A) + 1, np.nan if A.size else 1.0)
    return np.asarray(np.real(np.poly(A)))


def _is_significant(entries: FloatArray) -> BoolArray:
    """Return which entries are more than what a solver leaves of a zero."""
    return np.asarray(np.abs(entries) > _COUPLED * np.max(np.abs(entries), initial=0.0))


def direct_form(rows: FloatArray, dt_s: float) -> Controller:
    """Return the controller of a matrix (2 M + 1, modes), whose first states are the commands."""
    if not np.all(np.isfinite(rows)):
        raise NumericalError(
            "the coefficients must be numbers of single precision; some are beyond its range. "
            "Try a target that keeps the states (c, matlab), or a design with fewer states.",
            status="overflow",
        )
    order, modes = len(rows) // 2, rows.shape[1]
    step = np.eye(order + 1, k=1)  # x_j(k) = x_{j+1}(k-1) + b_j y(k) + a_j u(k-1)
    feedback = np.vstack([rows[order + 1 :], np.zeros((1, modes))])
    return Controller(
        A=block_diag(*(step + np.outer(a, np.eye(1, order + 1)) for a in feedback.T)),
        B=block_diag(*rows[: order + 1].T[:, :, None]),
        C=frozen_copy(np.kron(np.eye(modes), np.eye(1, order + 1))),
        D=np.zeros((modes, modes)),
        dt_s=dt_s,
    )


class InnerLoop:
    """The sums of a frame in single precision, product by product, clipped at the limit."""

    def __init__(self, matrix: ArrayLike, limit: float = np.inf) -> None:
        self._rows = np.asarray(matrix, dtype=np.float32)
        self._limit, self._past = np.float32(limit), len(self._rows) // 2  # M
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._memory: _Matrix = np.zeros_like(self._rows)

    def step(self, y: ArrayLike) -> FloatArray:
        """Take y(k), (modes,), return the commands that were applied, (modes,)."""
        memory, first = self._memory, self._past + 1
        memory[1:first] = memory[: first - 1].copy()
        memory[0] = y
        u = np.add.accumulate(self._rows * memory, axis=0)[-1]
        u = np.clip(u, -self._limit, self._limit)
        memory[first + 1 :] = memory[first:-1].copy()
        memory[first : first + 1] = u  # nothing to write at M = 0
        return np.asarray(u, dtype=np.float64)


def _round(designs: Sequence[Design], *, order: int | None = None, **_: Any) -> list[_Matrix]:
    """Return the columns (2 M + 1, n) of each design, of a higher order where 20 is too low."""
    if order is not None:
        integer(order, "order", at_least=1)
    least = max(len(direct_form_rows(design.controller, order)) // 2 for design in designs)
    shaped = any(design.mode_specifications for design in designs)
    for M in (least,) if order or shaped else (least, least + _WIDEST):
        pairs = [_columns(design, direct_form_rows(design.controller, M)) for design in designs]
        if all(loss < LOSS for loss, _ in pairs):
            break
    ages = np.r_[0 : M + 1, 1 : M + 1]  # of what each row multiplies
    used = max(np.max(ages[columns.any(axis=1)], initial=least) for _, columns in pairs)
    return [columns[ages <= used] for _, columns in pairs]


def _columns(design: Design, exact: FloatArray) -> tuple[float, _Matrix]:
    """Return rounded columns and what they lose, with a factor where they lose too much alone."""
    with np.errstate(over="ignore"):  # what is beyond the range becomes infinite, and refused
        best = _loss(design, exact.astype(np.float32)), exact.astype(np.float32)
        if design.mode_specifications and best[0] >= LOSS:
            columns = make_again(design, exact)
            return _loss(design, columns), columns
        spare = min(_WIDEST, len(exact) // 2 - np.min(np.count_nonzero(exact, axis=0)) // 2)
        for width in range(2, spare + 1) if best[0] >= LOSS else ():
            wide = np.stack([_widened(column, width) for column in exact.T], axis=1)
            columns = wide.astype(np.float32)
            best = min(best, (_loss(design, columns), columns), key=itemgetter(0))
            if best[0] < LOSS / 10:
                break
    return best


def _loss(design: Design, columns: _Matrix) -> float:
    """Return the largest loss in the proof of columns, infinite where it fails otherwise."""
    if not np.all(np.isfinite(columns)):
        return np.inf
    checks = prove_written(design, _as_computed(design, columns))
    if any(not check.passed for check in checks if check.limit != LOSS):
        return np.inf
    losses = [check.value for check in checks if check.limit == LOSS]
    return float(np.nan_to_num(np.max(losses, initial=-np.inf), nan=np.inf))


def _as_computed(design: Design, rounded: _Matrix) -> Written:
    """Return the controller with the matrix's numbers, and what its arithmetic adds."""
    rows, dt_s = rounded.astype(np.float64), design.controller.dt_s
    order, added = len(rows) // 2, rows.copy()
    added[: order + 1] = np.eye(order + 1, 1)  # an error of the sum enters as b_0 y(k) does
    controller, entry = (direct_form(matrix, dt_s) for matrix in (rows, added))
    loops: list[DirectFormLoop] = mode_loops(design, order)
    sensors = np.diag(require_hardware(design, "dao").sensor)

    def variance(sensor_gain: float, measured: FloatArray, commands: FloatArray) -> FloatArray:
        """Add up the rounding of each product and of each partial sum."""
        if loops:
            sums = [loop.sums_nm2(c, sensor_gain) for loop, c in zip(loops, rows.T, strict=True)]
            return np.array(sums) * sensors**2
        sizes = np.where(np.arange(len(rows))[:, None] <= order, measured, commands)
        # a bound: signs and correlations are not used
        bound = sums_variance((rows * sizes).T, 0, ROUNDOFF["single"])
        return bound(sensor_gain, np.ones(len(rows)), np.zeros(0))

    return Written(controllers={frozenset(): controller}, entry=entry, variance=variance)


def _join(numbers: Sequence[_Matrix], parts: Sequence[ModeDesign], count: int) -> _Matrix:
    """Return the matrix of all modes; further columns are zero."""
    matrix = np.zeros((len(numbers[0]), count), dtype=np.float32)
    for columns, part in zip(numbers, parts, strict=True):
        matrix[:, list(part.modes)] = columns
    return matrix


def _write(
    place: Path, matrix: _Matrix, _design: Design, _origin: Sequence[str], **_: Any
) -> dict[Path, bytes]:
    """Return the matrix as a file of numpy."""
    buffer = io.BytesIO()
    np.save(buffer, matrix, allow_pickle=False)
    return {place: buffer.getvalue()}


def _read(files: Mapping[Path, bytes], _: _Matrix) -> _Matrix:
    """Return the matrix that a file holds."""
    (content,) = files.values()
    return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))


def _remark(design: Design, columns: _Matrix) -> str:
    """Return that coefficients are not those of the gain file, and an order that is unusual."""
    M, remarks = len(columns) // 2, []
    if M > _USUAL:
        remarks.append(f"the matrix is for M = {M} in the configuration of the RTC")
    if not np.array_equal(columns, direct_form_rows(design.controller, M).astype(np.float32)):
        remarks.append(
            "made again for single precision; the loop keeps what the gain file promises"
            if design.mode_specifications
            else "both polynomials have a factor more, for single precision; it cancels"
        )
    return "; ".join(remarks)


TARGET = Target(
    precision="single",
    options={"order": None, "modes": None, "other_gain": None},
    round=_round,
    write=_write,
    read=_read,
    computed=_as_computed,
    start=InnerLoop,
    join=_join,
    facts=lambda matrix, **_: {"sign": _SIGN, "order": len(matrix) // 2},
    remark=_remark,
    hint="Give a higher, even order, design with fewer states or less accurate models, or use a "
    "target in double precision.",
    endings=(".npy",),
)
