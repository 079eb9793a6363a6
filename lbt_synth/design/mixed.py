"""The mixed filter: least variance under a bound on the norm.

It completes a central H-infinity filter, chosen by the norm that it achieves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import brentq

from lbt_synth.design.certificate import proved_level
from lbt_synth.design.filter_design import FilterDesign, filter_design
from lbt_synth.design.hinf import hinf, require_reachable
from lbt_synth.design.kalman import kalman
from lbt_synth.design.result import SolverReport
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.linear import EstimationProblem, StateSpace, hinf_norm
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.linear.riccati.filtering import FilterRiccati, gamma_riccati, kalman_riccati
from lbt_synth.validation import FloatArray, frozen_copy, integer, number, require_instance

_DECADES = 4.0  # of gamma, over which a central filter is searched
_ROUNDS = 20
_FIRST_GRID = 48
_FINE_GRID = 1024
_EXCESS = 4e-7  # by which a norm may exceed its bound; the certificate allows 1e-6
_TAPS = 16
_EDGE = 1e-5  # this close to the least gamma, its own filter is returned


def mixed(
    problem: EstimationProblem,
    *,
    gamma: float | None = None,
    gamma_ratio: float | None = None,
    taps: int = _TAPS,
) -> FilterDesign:
    """Design the filter of least variance under a bound on its norm.

    A base, the central H-infinity filter that just meets the bound, is completed with an
    impulse response on its innovations. All stable filters are of this kind, and the
    best impulse response is a convex programme: more taps come closer to the best of all
    linear filters. Where sensors have a longer common period than a frame, it is the base alone:
    the best among central filters, not among all. The norm is bounded on frequencies that are added
    to until it holds between them too.

    Parameters
    ----------
    problem : EstimationProblem
        The problem; a plant gives a controller.
    gamma : float, optional
        Bound on the H-infinity norm; the variance is made least.
    gamma_ratio : float, optional
        The same bound as a multiple, at least 1, of the least gamma.
    taps : int, optional
        Length of the impulse response, at most 64: states that the filter gets for each
        measurement.

    Returns
    -------
    FilterDesign
        Certified design; its problem has the past innovations as further states. A bound
        that the Kalman filter meets gives the Kalman filter; one that only the filter of
        the least gamma meets (within 1e-5) gives that one.

    Raises
    ------
    ProblemError
        If not exactly one bound is given, or a value is out of its range.
    InfeasibleError
        If no filter meets the bound.
    DetectabilityError, NumericalError, CertificateError
        As :func:`kalman`.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> A, B, C = [[1.9, -0.99], [1.0, 0.0]], [[1.0, 0.0], [0.0, 0.0]], [[0.0, 1.0]]
    >>> line = lbt.EstimationProblem(A=A, B=B, C=C, D=[[0.0, 3.0]], L=[[1.0, 0.0]])
    >>> central = lbt.hinf(line, gamma_ratio=1.1, route="riccati")
    >>> best = lbt.mixed(line, gamma=central.gamma)
    >>> best.gamma <= central.gamma * (1 + 1e-6) and best.rms < central.rms
    True
    """
    require_instance(problem, EstimationProblem)
    if (gamma is None) == (gamma_ratio is None):
        raise ProblemError(
            f"give one of gamma and gamma_ratio; got gamma={gamma!r}, gamma_ratio={gamma_ratio!r}."
        )
    length = require_taps(taps)
    if length != _TAPS:
        problem.require_one_phase("an impulse response on the innovations", "to leave out taps")
    least, best = hinf(problem, route="riccati"), kalman(problem)
    if gamma_ratio is not None:
        gamma = least.gamma_least * number(gamma_ratio, "gamma_ratio", at_least=1)
    bound = number(gamma, "gamma", above=0)
    require_reachable(bound, least.gamma_least)
    if bound >= best.gamma:  # the least variance of all is within the bound
        return best
    if bound <= least.gamma_least * (1 + _EDGE):  # there is no room for anything else
        return least
    base = _central_member(problem, least, bound)
    if not problem.reads_all:  # no impulse response: the least variance among central filters
        return _central_design(base, least, method="mixed", bound=bound)
    taps_of_base, solver = _complete_base(problem, base, length, bound)
    extended, witness = problem.with_memory(taps_of_base), least.witness
    if witness is not None:  # the further states are zero
        padding = (0, extended.n_states - problem.n_states), (0, 0)
        witness = replace(witness, states=frozen_copy(np.pad(witness.states, padding)))
    return filter_design(
        extended,
        _extend_gain(base.gain_predictor, length),
        method="mixed",
        solver=solver,
        gamma_least=least.gamma_least,
        gamma_infeasible=min(least.gamma_infeasible, proved_level(extended, witness)),
        gamma_requested=bound,
        witness=witness,
    )


def require_taps(taps: int) -> int:
    """Return the length of the impulse response, checked."""
    return integer(taps, "taps", at_least=1, at_most=64)


def _complete_base(
    problem: EstimationProblem,
    base: FilterDesign | FilterRiccati,
    length: int,
    bound: float,
) -> tuple[FloatArray, SolverReport]:
    """Find the taps on the innovations of a base filter, and say how."""
    from lbt_synth.linear.lmi.mixed import InnovationProgramme

    programme = InnovationProgramme.from_predictor(problem, base.gain_predictor, taps=length)
    even = np.linspace(0, 0.5 / problem.dt_s, _FIRST_GRID)
    grid = np.unique(np.concatenate([even, _frequencies_near_poles(programme.error)]))
    excess, level = np.inf, bound * (1 - _EXCESS / 2)
    for _ in range(_ROUNDS):
        taps, status = programme.minimize_variance(level, grid)
        error = problem.with_memory(taps).error_system(_extend_gain(base.gain_predictor, length))
        peak = hinf_norm(error)
        excess = peak.value / level - 1
        if excess <= _EXCESS:
            return taps, SolverReport(route="youla", status=status)
        fine = np.linspace(0, 0.5 / error.dt_s, _FINE_GRID)
        fine = np.unique(np.concatenate([fine, _frequencies_near_poles(error)]))
        sigma = spectral_norms(error.frequency_response(fine))
        inner = np.r_[True, sigma[1:] >= sigma[:-1]] & np.r_[sigma[:-1] >= sigma[1:], True]
        high = fine[inner & (sigma > level * (1 + _EXCESS / 4))]
        grid = np.unique(np.concatenate([grid, high, [peak.peak_frequency_hz]]))
    raise NumericalError(
        f"the mixed filter exceeds its bound by {excess:.3g} between the {len(grid)} frequencies "
        f"of its programme; expected {_EXCESS:g}. Try another number of taps.",
        status="frequencies",
        residual=excess,
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


def central_filter(problem: EstimationProblem, *, gamma: float) -> FilterDesign:
    """Design the central H-infinity filter that has a given norm; above its own, the Kalman filter.

    The filter that :func:`hinf` makes for a bound stays below it; this one has less variance.
    """
    least = hinf(problem, route="riccati")
    require_reachable(gamma, least.gamma_least)
    gains = _central_member(problem, least, gamma)
    return _central_design(gains, least, method="hinf", bound=gamma * (1 + _EXCESS))


def _central_design(
    gains: FilterDesign | FilterRiccati, least: FilterDesign, *, method: str, bound: float
) -> FilterDesign:
    """Make the design of a central filter that reaches its bound."""
    return filter_design(
        least.problem,
        gains.gain_predictor,
        method=method,
        solver=SolverReport(route="riccati", status="norm reached"),
        gamma_requested=bound,
        gamma_least=least.gamma_least,
        gamma_infeasible=least.gamma_infeasible,
        witness=least.witness,
    )


def _central_member(
    problem: EstimationProblem, least: FilterDesign, bound: float
) -> FilterDesign | FilterRiccati:
    """Return the central filter whose norm just meets a bound; norms rise to that of Kalman."""
    start = kalman_riccati(problem)
    filters: dict[float, FilterDesign | FilterRiccati] = {0.0: least}
    excesses = {0.0: least.gamma - bound}

    def excess(decades: float) -> float:
        level = least.gamma * 10**decades
        solution = gamma_riccati(problem, level, start=start) if decades else None
        if solution is not None:
            filters[decades] = solution
            error = problem.error_system(solution.gain_predictor)
            excesses[decades] = float(hinf_norm(error)) - bound
        return excesses.get(decades, excesses[0.0])

    if excesses[0.0] >= 0:
        return least
    if excess(_DECADES) <= 0:
        return start
    brentq(excess, 0.0, _DECADES, xtol=1e-9)
    # the closest on the side of smaller norms
    return filters[max(decades for decades, value in excesses.items() if value <= 0)]
