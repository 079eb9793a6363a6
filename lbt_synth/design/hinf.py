"""The H-infinity filter: least energy gain from disturbances to the estimation error."""

from __future__ import annotations

import numpy as np

from lbt_synth.design.filter_design import FilterDesign, filter_design
from lbt_synth.design.kalman import error_scale
from lbt_synth.design.result import SolverReport
from lbt_synth.errors import CertificateError, InfeasibleError, NumericalError, ProblemError
from lbt_synth.linear import EstimationProblem, hinf_norm
from lbt_synth.linear.infeasibility_proof import (
    Witness,
    infeasible_level,
    worst_invisible_disturbance,
)
from lbt_synth.linear.riccati.filtering import (
    FilterRiccati,
    gamma_riccati,
    kalman_riccati,
    least_gamma,
)
from lbt_synth.validation import choice, number, require_instance

AT_LEAST = 1e-9  # a level this close to the least one counts as the least one itself
LARGEST_LMI = 20  # states; the inequality takes minutes beyond


def hinf(
    problem: EstimationProblem,
    *,
    gamma: float | None = None,
    gamma_ratio: float | None = None,
    route: str | None = None,
) -> FilterDesign:
    """Design an H-infinity filter of an estimation problem.

    With neither ``gamma`` nor ``gamma_ratio`` the least gamma is found, and the
    filter at it is returned. At the least gamma the error is all-pass and every
    other property suffers: ratios from 1.05 to 1.5 are for use.

    Parameters
    ----------
    problem : EstimationProblem
        The problem; a plant gives a controller.
    gamma : float, optional
        Bound on the H-infinity norm from w to the estimation error.
    gamma_ratio : float, optional
        The same bound as a multiple, at least 1, of the least gamma.
    route : {"lmi", "riccati"}, optional
        How the least gamma is found: linear matrix inequality, or gamma-Riccati equation, of which
        the filter of a larger bound is the central one. By default the inequality up to 20 states,
        and the equation beyond, where the inequality takes minutes, or where the inequality fails.

    Returns
    -------
    FilterDesign
        Certified design. ``gamma`` is the norm achieved, ``gamma_requested`` the
        bound. ``gamma_least`` is the norm that a filter achieves,
        ``gamma_infeasible`` a level that no filter reaches, proved by ``witness``:
        the least gamma lies between the two.

    Raises
    ------
    ProblemError
        If both bounds are given, or a value is out of its range.
    InfeasibleError
        If the bound is below the least gamma; the message names the least.
    DetectabilityError, NumericalError, CertificateError
        As :func:`kalman`.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> design = lbt.hinf(walk, gamma_ratio=1.2, route="riccati")
    >>> design.gamma <= design.gamma_requested
    True
    """
    require_instance(problem, EstimationProblem)
    if route is not None:
        choice(route, "route", ("lmi", "riccati"))
    gamma, gamma_ratio = checked_bounds(
        gamma, gamma_ratio, far_above="the filter is the Kalman filter"
    )
    start = kalman_riccati(problem)
    if route == "lmi":
        problem.require_one_phase("the inequality", "route='riccati'")
    if route is None and problem.n_states <= LARGEST_LMI and problem.reads_all:
        try:
            return _design(problem, start, "lmi", gamma, gamma_ratio)
        except (NumericalError, CertificateError):  # noise far below the signal
            pass
    return _design(problem, start, route or "riccati", gamma, gamma_ratio)


def checked_bounds(
    gamma: float | None, gamma_ratio: float | None, *, far_above: str
) -> tuple[float | None, float | None]:
    """Check the two ways to bound the norm, of which at most one may be given."""
    if gamma is not None and gamma_ratio is not None:
        raise ProblemError(
            "give gamma or gamma_ratio, not both; "
            f"got gamma={gamma!r} and gamma_ratio={gamma_ratio!r}."
        )
    if gamma is not None:
        gamma = number(gamma, "gamma", above=0, at_most=1e100)
    if gamma_ratio is not None:
        gamma_ratio = number(
            gamma_ratio,
            "gamma_ratio",
            at_least=1,
            at_most=1e6,
            hint=f"At 1 the bound is the least one; far above it {far_above}.",
        )
    return gamma, gamma_ratio


def _design(
    problem: EstimationProblem,
    start: FilterRiccati,
    route: str,
    gamma: float | None,
    gamma_ratio: float | None,
) -> FilterDesign:
    """Find the least gamma by one route, and the filter of the level asked for."""
    if not np.any(problem.L @ start.P @ problem.L.T > 0):
        raise ProblemError(
            "z = L x must have an estimation error; got one that is known exactly. "
            "Drive it with noise (B), or choose another L."
        )
    # the deviation of the Kalman error, and its norm
    lower = error_scale(problem, start.P)
    upper = hinf_norm(problem.error_system(start.gain_predictor)).upper
    if route == "lmi":
        from lbt_synth.linear.lmi.filters import least_gamma_lmi

        gains, witness = least_gamma_lmi(problem, coordinates=start.P, scale=upper)
    else:
        _, level, gains = least_gamma(problem, lower=lower, upper=upper, start=start)
        witness = worst_invisible_disturbance(problem, gains.P, level, start.P)
    least, infeasible = _verified_bracket(problem, start, gains, witness)
    requested = gamma if gamma is not None else least * (gamma_ratio or 1)
    require_reachable(requested, least)
    if requested > least * (1 + AT_LEAST):
        central = gamma_riccati(problem, requested, start=start)
        if central is None:
            raise InfeasibleError(
                "the gamma-Riccati equation has no stabilising solution at gamma = "
                f"{requested:.9g}. Try a larger gamma.",
                gamma=requested,
            )
        gains = central
    return filter_design(
        problem,
        gains.gain_predictor,
        method="hinf",
        solver=SolverReport(route=route, status=gains.status),
        gamma_requested=max(requested, least),
        gamma_least=least,
        gamma_infeasible=infeasible,
        witness=witness,
    )


def require_reachable(gamma: float, least: float) -> None:
    """Refuse a level below the least one."""
    if gamma < least * (1 - AT_LEAST):
        raise InfeasibleError(
            f"gamma must be at least {least:.12g}, the least of this problem; got {gamma:.12g}. "
            "Try gamma_ratio=1.2.",
            gamma=gamma,
            gamma_least=least,
        )


def _verified_bracket(
    problem: EstimationProblem, start: FilterRiccati, gains: FilterRiccati, witness: Witness
) -> tuple[float, float]:
    """Bounds of the least gamma: the norm of a filter, and a level that a witness refutes."""
    error = problem.error_system(gains.gain_predictor)
    if not error.spectral_radius < 1:
        raise NumericalError(
            "the filter of the least gamma is not stable; expected a spectral radius below 1, got "
            f"{error.spectral_radius:.9g}. Try the other route, or scale the states.",
            status=gains.status,
        )
    least = hinf_norm(error).upper
    infeasible = infeasible_level(problem, witness, start.P)
    if infeasible > least * (1 + AT_LEAST):
        raise NumericalError(
            f"no filter should have a norm below {infeasible:.9g}, yet one achieves {least:.9g}. "
            "Try the other route, or scale the states to similar sizes.",
            status="contradiction",
        )
    return least, min(infeasible, least)
