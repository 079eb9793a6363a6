"""The mixed filter: least variance under a bound on the norm, and the reverse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from lbt_synth.design.central_filters import CentralFilters
from lbt_synth.design.hinf import hinf, require_reachable
from lbt_synth.design.kalman import kalman
from lbt_synth.design.result import FilterDesign, SolverReport, filter_design
from lbt_synth.errors import InfeasibleError, NumericalError, ProblemError
from lbt_synth.linear import (
    EstimationProblem,
    StateSpace,
    Witness,
    hinf_norm,
    infeasible_level,
    largest_singular_values,
)
from lbt_synth.linear.estimation_problem import require_problem
from lbt_synth.linear.riccati.filtering import FilterRiccati, kalman_riccati
from lbt_synth.validation import FloatArray, frozen_copy, integer, number

if TYPE_CHECKING:
    from lbt_synth.linear.lmi.mixed import InnovationProgramme

_Answer: TypeAlias = tuple[FloatArray, float, str]  # taps, level, what the solver said

_ROUNDS = 20
_FIRST_GRID = 48
_FINE_GRID = 1024
_EXCESS = 4e-7  # by which the norm may exceed its bound; the certificate allows 1e-6
_ROOM = 2e-7  # by which the bound at the frequencies is tightened
_SAME = 1e-9
_MOST_TAPS = 64
_EDGE = 1e-5  # this close to the least gamma, its own filter is returned


def mixed(
    problem: EstimationProblem,
    *,
    gamma: float | None = None,
    gamma_ratio: float | None = None,
    rms: float | None = None,
    taps: int = 16,
    horizon: int = 1,
) -> FilterDesign:
    """Design the filter of least variance under a bound on its norm, or the reverse.

    A base, the central H-infinity filter that just meets the bound, is completed with an
    impulse response on its innovations. All stable filters are of this kind, and the
    best impulse response is a convex programme: more taps come closer to the best of all
    linear filters. The norm is bounded on frequencies that are added to until it holds
    between them too.

    Parameters
    ----------
    problem : EstimationProblem
        The problem; a plant gives a controller.
    gamma : float, optional
        Bound on the H-infinity norm; the variance is made least.
    gamma_ratio : float, optional
        The same bound as a multiple, at least 1, of the least gamma.
    rms : float, optional
        Bound on the standard deviation of the error; the norm is made least.
    taps : int, optional
        Length of the impulse response, at most 64: states that the filter gets for each
        measurement.
    horizon : int, optional
        Frames from the newest measurement to the estimate, as ``problem.ahead``.

    Returns
    -------
    FilterDesign
        Certified design; its problem has the past innovations as further states. A bound
        that the Kalman filter meets gives the Kalman filter; one that only the filter of
        the least gamma meets (within 1e-5), or that lets it in, gives that one.

    Raises
    ------
    ProblemError
        If not exactly one bound is given, or a value is out of its range.
    InfeasibleError
        If no filter meets the bound.
    NumericalError
        If the programme fails.
    CertificateError
        If the design does not pass its checks.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> line = lbt.EstimationProblem(
    ...     A=[[1.9, -0.99], [1.0, 0.0]],
    ...     B=[[1.0, 0.0], [0.0, 0.0]],
    ...     C=[[0.0, 1.0]],
    ...     D=[[0.0, 3.0]],
    ...     L=[[1.0, 0.0]],
    ... )
    >>> central = lbt.hinf(line, gamma_ratio=1.1, route="riccati")
    >>> best = lbt.mixed(line, gamma=central.gamma)
    >>> best.gamma <= central.gamma * (1 + 1e-6) and best.rms < central.rms
    True
    """
    require_problem(problem)
    if sum(bound is not None for bound in (gamma, gamma_ratio, rms)) != 1:
        raise ProblemError(
            "give one of gamma, gamma_ratio and rms; "
            f"got gamma={gamma!r}, gamma_ratio={gamma_ratio!r}, rms={rms!r}."
        )
    length = require_taps(taps)
    problem = problem.ahead(horizon)
    least, best = hinf(problem, route="riccati"), kalman(problem)
    assert least.gamma_least is not None  # of an H-infinity design
    if rms is not None:
        bound = number(rms, "rms", above=0)
        if bound < best.rms * (1 - _SAME):
            raise InfeasibleError(
                f"rms must be at least {best.rms:.9g}, that of the Kalman filter; got {bound:.9g}."
            )
        if bound >= least.rms:  # the least norm of all is within the bound
            return least

        def measure(norm: float, deviation: float) -> float:
            return bound - deviation

        def solve(programme: InnovationProgramme, grid: FloatArray) -> _Answer:
            return programme.minimize_level((bound * (1 - _ROOM)) ** 2, grid)
    else:
        if gamma_ratio is not None:
            gamma = least.gamma_least * number(gamma_ratio, "gamma_ratio", at_least=1)
        bound = number(gamma, "gamma", above=0)
        require_reachable(bound, least.gamma_least)
        if bound >= best.gamma:  # the least variance of all is within the bound
            return best
        if bound <= least.gamma_least * (1 + _EDGE):  # there is no room for anything else
            return least

        def measure(norm: float, deviation: float) -> float:
            return norm - bound

        def solve(programme: InnovationProgramme, grid: FloatArray) -> _Answer:
            return programme.minimize_variance(bound * (1 - _ROOM), grid)

    base = CentralFilters(problem, least).member(measure)
    response = _complete_base(problem, base, length, solve)
    return _mixed_design(problem, base, response, least, gamma=gamma, rms=rms)


def require_taps(taps: int) -> int:
    """Return the length of the impulse response, checked."""
    length = integer(taps, "taps", at_least=1)
    if length > _MOST_TAPS:
        raise ProblemError(f"taps must be at most {_MOST_TAPS}; got {length}.")
    return length


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ImpulseResponse:
    """Impulse response on the innovations of a base filter, and how it was found."""

    taps: FloatArray
    status: str
    rounds: int


def _complete_base(
    problem: EstimationProblem,
    base: FilterDesign | FilterRiccati,
    length: int,
    solve: Callable[[InnovationProgramme, FloatArray], _Answer],
) -> _ImpulseResponse:
    """Solve on a set of frequencies, and add to it until the norm holds between them, too."""
    from lbt_synth.linear.lmi.mixed import InnovationProgramme

    programme = InnovationProgramme.from_predictor(problem, base.gain_predictor, taps=length)
    even = np.linspace(0, 0.5 / problem.dt_s, _FIRST_GRID)
    grid = np.unique(np.concatenate([even, _frequencies_near_poles(programme.error)]))
    excess = np.inf
    for rounds in range(1, _ROUNDS + 1):
        taps, level, status = solve(programme, grid)
        error = problem.with_memory(taps).error_system(_extend_gain(base.gain_predictor, length))
        peak = hinf_norm(error)
        excess = peak.value / level - 1
        if excess <= _EXCESS:
            return _ImpulseResponse(taps=taps, status=status, rounds=rounds)
        fine = np.linspace(0, 0.5 / error.dt_s, _FINE_GRID)
        fine = np.unique(np.concatenate([fine, _frequencies_near_poles(error)]))
        sigma = largest_singular_values(error, fine)
        inner = np.r_[True, sigma[1:] >= sigma[:-1]] & np.r_[sigma[:-1] >= sigma[1:], True]
        high = fine[inner & (sigma > level * (1 + _EXCESS / 4))]
        grid = np.unique(np.concatenate([grid, high, [peak.peak_frequency_hz]]))
    raise NumericalError(
        f"the mixed filter exceeds its bound by {excess:.3g} between the {len(grid)} frequencies "
        f"of its programme; expected {_EXCESS:g}. Try another number of taps.",
        status="frequencies",
        residual=excess,
    )


def _mixed_design(
    problem: EstimationProblem,
    base: FilterDesign | FilterRiccati,
    response: _ImpulseResponse,
    least: FilterDesign,
    *,
    gamma: float | None,
    rms: float | None,
) -> FilterDesign:
    """Make the design of a completed base and certify it."""
    extended = problem.with_memory(response.taps)
    size, q = response.taps.shape[1], base.gain_predictor.shape[1]
    gain = _extend_gain(base.gain_predictor, size // q)
    assert least.witness is not None
    assert least.gamma_infeasible is not None
    padding = np.zeros((size, least.witness.states.shape[1]))
    witness = Witness(
        states=frozen_copy(np.vstack([least.witness.states, padding])),
        disturbances=least.witness.disturbances,
    )
    proved = infeasible_level(extended, witness, kalman_riccati(extended).P)
    innovation_gain = np.vstack([base.gain_filter, np.zeros((size, q))])
    return filter_design(
        extended,
        gain,
        innovation_gain,
        method="mixed",
        solver=SolverReport(route="youla", status=response.status, iterations=response.rounds),
        gamma_requested=gamma,
        rms_requested=rms,
        gamma_least=least.gamma_least,
        gamma_infeasible=min(least.gamma_infeasible, proved),
        witness=witness,
    )


def _extend_gain(gain_predictor: FloatArray, length: int) -> FloatArray:
    """Return the gain that feeds the innovations into the memory, too."""
    q = gain_predictor.shape[1]
    return frozen_copy(np.vstack([gain_predictor, np.eye(q), np.zeros(((length - 1) * q, q))]))


def _frequencies_near_poles(error: StateSpace) -> FloatArray:
    """Frequencies at and around the poles of a system [Hz]."""
    centres, widths = np.abs(np.angle(error.poles)), 1 - np.abs(error.poles)
    offsets = np.array([0.0, 0.3, 1.0, 3.0])
    angles = centres[:, None] + widths[:, None] * np.concatenate([-offsets[1:], offsets])
    return np.asarray(np.clip(angles.ravel(), 0, np.pi) / (2 * np.pi * error.dt_s))
