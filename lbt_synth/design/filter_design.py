"""The design of a filter: gains, what is claimed of bounds, and their checks."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lbt_synth.design.certificate import (
    GAIN_TOLERANCE,
    INFEASIBLE_TOLERANCE,
    LEVEL_SETS,
    NORM_TOLERANCE,
    ORIGIN_TOLERANCE,
    Certificate,
    Check,
    certify_filter,
    certify_infeasible,
    certify_loop,
)
from lbt_synth.design.result import (
    UNCERTIFIED,
    EstimatorDesign,
    FilterFacts,
    SolverReport,
    with_certificate,
)
from lbt_synth.errors import NumericalError
from lbt_synth.linear import Controller, EstimationProblem, StateSpace, Witness
from lbt_synth.linear.estimation_problem import decorrelate
from lbt_synth.linear.matrix_functions import relative_distance
from lbt_synth.linear.riccati.filtering import (
    FilterRiccati,
    GammaEquation,
    gamma_riccati,
    kalman_riccati,
)
from lbt_synth.validation import ComplexArray, FloatArray, set_fields

ORIGIN = "distance from its Riccati filter"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterDesign(EstimatorDesign):
    """A Kalman or H-infinity filter, and the controller made of it.

    Attributes
    ----------
    problem : EstimationProblem
        The problem (a plant, for a telescope).
    gain_predictor : (n, q) ndarray
        ``(A P C' + S) (C P C' + R)^-1``: of ``x(k+1|k) = A x(k|k-1) + gain (y(k) - C x(k|k-1))``.
    gain_filter : (n, q) ndarray
        ``P C' (C P C' + R)^-1``: of ``x(k|k) = x(k|k-1) + gain (y(k) - C x(k|k-1))``.
    gamma_requested : float or None
        Bound that the H-infinity design was given.
    rms_requested : float or None
        Bound on the standard deviation that the design was given.
    gamma_least : float or None
        Norm that a filter of the problem achieves, with the least gamma.
    gamma_infeasible : float or None
        Level that no filter reaches: the least gamma is not below it.
    witness : Witness or None
        The proof of that level: disturbances that no measurement shows.
    """

    controller: Controller = field(init=False)
    gain_predictor: FloatArray
    gain_filter: FloatArray
    gamma_requested: float | None = None
    gamma_least: float | None = None
    gamma_infeasible: float | None = None
    witness: Witness | None = None
    rms_requested: float | None = None

    def __post_init__(self) -> None:
        set_fields(self, controller=self.problem.controller(self.gain_predictor))

    def error_system(self, problem: EstimationProblem | None = None) -> StateSpace:
        """System from w to the estimation error.

        Parameters
        ----------
        problem : EstimationProblem, optional
            Problem with other disturbances; the design's own by default.

        Returns
        -------
        StateSpace
            The system.
        """
        return (problem or self.problem).error_system(self.gain_predictor)

    def facts(self) -> FilterFacts:
        """Return what the filter achieves, beside what it was asked for and what is possible."""
        return self.model_facts(FilterFacts)

    @property
    def is_bounded(self) -> bool:
        """Whether the design was given a bound; without one its variance is the least."""
        return self.gamma_requested is not None or self.rms_requested is not None

    @property
    def estimator(self) -> Controller:
        """Estimator of z whatever the commands are, from [y(k), u(k-1)] for a plant."""
        return self.problem.estimator(self.gain_predictor)

    @property
    def poles(self) -> ComplexArray:
        """Poles of the estimation error, (n,)."""
        return self.error_system().poles

    def recertify(self) -> Certificate:
        """Compute the certificate again: the filter, its claims, and its loop if it has one."""
        problem = self.problem
        certificate = certify_filter(
            problem,
            self.gain_predictor,
            gamma=self.gamma_requested,
            least_variance=not self.is_bounded,
        )
        checks = [*certificate.checks, *self._claim_checks(certificate)]
        if self.hardware is not None:
            checks.append(certify_loop(self.hardware, self.controller))
        return replace(certificate, checks=tuple(checks))

    def _claim_checks(self, certificate: Certificate) -> list[Check]:
        """Check the gains against each other, and what is said of bounds."""
        problem, start = self.problem, kalman_riccati(self.problem)
        checks = [self._gain_check(), *self._origin_checks(start)]
        if self.rms_requested is not None:
            above = certificate.rms / self.rms_requested - 1
            name = "standard deviation of the estimation error over its bound, less 1"
            checks.append(Check(name, above, NORM_TOLERANCE, "Lyapunov equation"))
        if self.gamma_least is not None:
            equation = GammaEquation(problem, start)
            meets = [
                equation.trial(self.gamma_least * (1 + side * NORM_TOLERANCE)).P is not None
                for side in (-1, 1)
            ]
            name, how = "least norm of any filter, error", "gamma-Riccati equation on both sides"
            off = 0.0 if meets == [False, True] else np.inf
            checks.append(Check(name, off, NORM_TOLERANCE, how))
        if self.gamma_infeasible is not None:
            name = "infeasible level over the norm achieved, less 1"
            value = self.gamma_infeasible / certificate.gamma - 1
            checks.append(Check(name, value, INFEASIBLE_TOLERANCE, LEVEL_SETS))
            # a claim without a witness is not believed
            proof = self.witness or Witness(
                states=np.zeros((problem.n_states, 1)),
                disturbances=np.zeros((problem.B.shape[1], 1)),
            )
            proved = certify_infeasible(problem, self.gamma_infeasible, proof)
            below = -proved.value / (1 + proved.value)
            name = "level proved over the infeasible level, less 1"
            checks += [proved, Check(name, below, NORM_TOLERANCE, proved.computed_by)]
        return checks

    def _gain_check(self) -> Check:
        """Check that the two gains are of one filter, in the states that go on."""
        A, _, injection = decorrelate(self.problem)
        goes_on = np.any(A != 0, axis=1)  # not so the newest innovation of a mixed filter
        apart = (A @ self.gain_filter + injection - self.gain_predictor)[goes_on]
        size = max(float(np.max(np.abs(self.gain_predictor), initial=0.0)), 1e-300)
        value = float(np.max(np.abs(apart), initial=0.0)) / size
        how = "A times the filter gain, relative"
        return Check("predictor gain against the filter gain", value, GAIN_TOLERANCE, how)

    def _origin_checks(self, start: FilterRiccati) -> list[Check]:
        """Check both gains of Kalman's filter and of the central filter of a bound.

        A filter of a bound that is neither has its bound and norms as its proof.
        """
        origins = [start]
        if self.gamma_requested is not None:
            with suppress(NumericalError):
                central = gamma_riccati(self.problem, self.gamma_requested, start=start)
                origins += [] if central is None else [central]
        own = np.vstack([self.gain_predictor, self.gain_filter])
        value = min(
            relative_distance(own, np.vstack([origin.gain_predictor, origin.gain_filter]))
            for origin in origins
        )
        if self.is_bounded and value > ORIGIN_TOLERANCE:
            return []
        return [Check(ORIGIN, value, ORIGIN_TOLERANCE, "relative")]


def filter_design(
    problem: EstimationProblem,
    gain_predictor: FloatArray,
    gain_filter: FloatArray,
    *,
    method: str,
    solver: SolverReport,
    **claims: Any,
) -> FilterDesign:
    """Make a design and certify it; raise CertificateError if it fails."""
    design = FilterDesign(
        method=method,
        certificate=UNCERTIFIED,
        solver=solver,
        problem=problem,
        gain_predictor=gain_predictor,
        gain_filter=gain_filter,
        **claims,
    )
    return with_certificate(design, "Try the other route, or scale the states to similar sizes.")
