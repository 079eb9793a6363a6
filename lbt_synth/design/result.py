"""Designs: the controller, its certificate, and how it was computed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from lbt_synth.design.certificate import (
    INFEASIBLE_TOLERANCE,
    LEVEL_SETS,
    NORM_TOLERANCE,
    Certificate,
    Check,
    certify_filter,
    certify_infeasible,
    certify_loop,
)
from lbt_synth.linear import Controller, EstimationProblem, StateSpace, Witness
from lbt_synth.loop import close_loop
from lbt_synth.models import FullStatePlant, LoopHardware, TipTiltPlant
from lbt_synth.validation import ComplexArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverReport:
    """How a design was computed; no evidence of its quality.

    Attributes
    ----------
    route : str
        "riccati", "sdp", "lmi" or "closed form".
    status : str
        What the solver said of itself.
    iterations : int
        Iterations it took.
    """

    route: str
    status: str
    iterations: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Design:
    """A certified controller.

    Attributes
    ----------
    method : str
        Name that the method of synthesis gives its designs.
    controller : Controller
        From y(k) to u(k), the known input included (new-state form).
    certificate : Certificate
        Checks that were passed.
    solver : SolverReport
        How it was computed.
    assumptions : tuple of str
        What the design rests on and no certificate shows, such as where a sensor gain is from.
    configuration : str
        The configuration that it was made from, as JSON; empty if there was none.
    """

    method: str
    controller: Controller
    certificate: Certificate
    solver: SolverReport
    assumptions: tuple[str, ...] = ()
    configuration: str = ""

    @property
    def hardware(self) -> LoopHardware | None:
        """Loop that the design is for; None for a bare estimation problem."""
        return None

    @property
    def knows_mirror(self) -> bool:
        """Whether the design counts on the mirror's dynamics, not on a mirror that settles."""
        return True

    @property
    def poles(self) -> ComplexArray:
        """Poles that the design places, (n,)."""
        return np.linalg.eigvals(self.controller.A).astype(np.complex128)

    def to_control(self) -> Any:
        """Return the controller as a ``control.StateSpace`` in the textbook form.

        Returns
        -------
        control.StateSpace
            ``u(k) = C x(k) + D y(k)``, the same input-output map.
        """
        return self.controller.to_statespace().to_control()

    def recertify(self) -> Certificate:
        """Compute the certificate again from the matrices.

        Returns
        -------
        Certificate
            Passed or not.
        """
        return self.certificate


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EstimatorDesign(Design, ABC):
    """A controller that applies an estimator of z.

    Attributes
    ----------
    problem : EstimationProblem
        The problem (a plant, for a telescope).
    """

    problem: EstimationProblem

    @property
    def gamma(self) -> float:
        """Achieved H-infinity norm of the estimation error, recomputed."""
        return self.certificate.gamma

    @property
    def rms(self) -> float:
        """Standard deviation of the estimation error over all outputs, recomputed."""
        return self.certificate.rms

    @property
    def hardware(self) -> LoopHardware | None:
        """Loop that the design is for; None for a bare estimation problem."""
        if isinstance(self.problem, TipTiltPlant | FullStatePlant):
            return self.problem.hardware
        return None

    @property
    def knows_mirror(self) -> bool:
        """Whether the design counts on the mirror's dynamics, not on a mirror that settles."""
        return False

    @abstractmethod
    def error_system(self, problem: EstimationProblem | None = None) -> StateSpace:
        """System from w to the estimation error.

        Parameters
        ----------
        problem : EstimationProblem, optional
            Problem with other disturbances; the design's own by default.
        """


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

    gain_predictor: FloatArray
    gain_filter: FloatArray
    gamma_requested: float | None = None
    gamma_least: float | None = None
    gamma_infeasible: float | None = None
    witness: Witness | None = None
    rms_requested: float | None = None

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
        checks = list(certificate.checks)
        if self.rms_requested is not None:
            limit = self.rms_requested * (1 + NORM_TOLERANCE)
            name = "standard deviation of the estimation error"
            checks.append(Check(name, certificate.rms, limit, "Lyapunov equation"))
        if self.gamma_infeasible is not None:
            name = "infeasible level over the norm achieved, less 1"
            value = self.gamma_infeasible / certificate.gamma - 1
            checks.append(Check(name, value, INFEASIBLE_TOLERANCE, LEVEL_SETS))
            # a claim without a witness is not believed
            proof = self.witness or Witness(
                states=np.zeros((problem.n_states, 1)),
                disturbances=np.zeros((problem.B.shape[1], 1)),
            )
            checks.append(certify_infeasible(problem, self.gamma_infeasible, proof))
        if self.hardware is not None:
            checks.append(certify_loop(self.hardware, self.controller))
        return replace(certificate, checks=tuple(checks))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IntegratorDesign(Design):
    """The classical controller ``u(k) = u(k-1) + gain R y(k)``.

    Attributes
    ----------
    loop_hardware : LoopHardware
        The loop.
    gain : float
        Integrator gain, per unit of sensor gain.
    """

    loop_hardware: LoopHardware
    gain: float

    @property
    def hardware(self) -> LoopHardware | None:
        """Loop that the design is for."""
        return self.loop_hardware

    @property
    def poles(self) -> ComplexArray:
        """Poles of the closed loop."""
        return close_loop(self.loop_hardware, self.controller).system.poles

    def recertify(self) -> Certificate:
        """Compute the certificate again from the matrices."""
        return replace(UNCERTIFIED, checks=(certify_loop(self.loop_hardware, self.controller),))


UNCERTIFIED = Certificate(checks=(), gamma=np.nan, rms_per_output=np.zeros(0))
AnyDesign = TypeVar("AnyDesign", bound=Design)


def with_certificate(design: AnyDesign, hint: str) -> AnyDesign:
    """Return a design with its certificate; raise CertificateError with a hint if it fails."""
    return replace(design, certificate=design.recertify().require(hint))


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
        controller=problem.controller(gain_predictor),
        certificate=UNCERTIFIED,
        solver=solver,
        problem=problem,
        gain_predictor=gain_predictor,
        gain_filter=gain_filter,
        **claims,
    )
    return with_certificate(design, "Try the other route, or scale the states to similar sizes.")
