"""The central H-infinity filters of a problem, chosen by the norm that they achieve."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from lbt_synth.design.hinf import hinf, require_reachable
from lbt_synth.design.result import FilterDesign, SolverReport, filter_design
from lbt_synth.linear import EstimationProblem, hinf_norm
from lbt_synth.linear.estimation_problem import require_problem
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.linear.riccati.filtering import FilterRiccati, kalman_riccati
from lbt_synth.linear.riccati.gamma import gamma_riccati
from lbt_synth.validation import number

_DECADES = 4.0  # of gamma, over which a member is searched
_SLACK = 4e-7  # by which a member may miss its norm


def central_filter(problem: EstimationProblem, *, gamma: float) -> FilterDesign:
    """Design the central H-infinity filter that has a given norm.

    The filter that :func:`hinf` makes for a bound stays below it; this one reaches it, and
    has less variance.

    Parameters
    ----------
    problem : EstimationProblem
        The problem; a plant gives a controller.
    gamma : float
        Norm to reach. From that of the Kalman filter up, the Kalman filter is returned.

    Returns
    -------
    FilterDesign
        Certified design.

    Raises
    ------
    InfeasibleError
        If the norm is below the least gamma.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> round(lbt.design.central_filter(walk, gamma=1.5).gamma, 6)
    1.5
    """
    require_problem(problem)
    bound = number(gamma, "gamma", above=0)
    least = hinf(problem, route="riccati")
    assert least.gamma_least is not None  # of an H-infinity design
    require_reachable(bound, least.gamma_least)
    gains = CentralFilters(problem, least).member(lambda norm, _: norm - bound)
    return filter_design(
        problem,
        gains.gain_predictor,
        gains.gain_filter,
        method="hinf",
        solver=SolverReport(route="riccati", status="norm reached", iterations=0),
        gamma_requested=bound * (1 + _SLACK),
        gamma_least=least.gamma_least,
        gamma_infeasible=least.gamma_infeasible,
        witness=least.witness,
    )


class CentralFilters:
    """The central filters of a problem, from that of the least gamma to the Kalman filter."""

    def __init__(self, problem: EstimationProblem, least: FilterDesign) -> None:
        self.problem, self.least = problem, least
        self.start = kalman_riccati(problem)

    def member(self, measure: Callable[[float, float], float]) -> FilterDesign | FilterRiccati:
        """Return the filter at which a rising measure of norm and deviation is zero.

        Where the measure does not change its sign it is one end of the family.
        """
        gains: dict[float, FilterDesign | FilterRiccati] = {0.0: self.least}
        found = {0.0: measure(self.least.gamma, self.least.rms)}

        def value(decades: float) -> float:
            level = self.least.gamma * 10**decades
            solution = gamma_riccati(self.problem, level, start=self.start) if decades else None
            if solution is not None:
                error = self.problem.error_system(solution.gain_predictor)
                covariance = stationary_covariance(error.A, error.B @ error.B.T)
                variance = float(np.trace(error.C @ covariance @ error.C.T))
                gains[decades] = solution
                found[decades] = measure(float(hinf_norm(error)), float(np.sqrt(variance)))
            return found.get(decades, found[0.0])

        if found[0.0] >= 0:
            return gains[0.0]
        if value(_DECADES) <= 0:
            return self.start
        brentq(value, 0.0, _DECADES, xtol=1e-9)
        # the closest on the side of smaller norms
        return gains[max(decades for decades, size in found.items() if size <= 0)]
