"""Designs: the controller, its certificate, and how it was computed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

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
from lbt_synth.design.facts import FilterFacts, model_facts, summarise_design
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.linear import Controller, EstimationProblem, StateSpace
from lbt_synth.linear.estimation_problem import decorrelate
from lbt_synth.linear.infeasibility_proof import Witness
from lbt_synth.linear.matrix_functions import relative_distance
from lbt_synth.linear.riccati.filtering import (
    FilterRiccati,
    GammaEquation,
    gamma_riccati,
    kalman_riccati,
)
from lbt_synth.loop import close_loop
from lbt_synth.models import FullStatePlant, LoopHardware, TipTiltPlant
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.storage.words import count_text
from lbt_synth.validation import ComplexArray, FloatArray, set_fields

if TYPE_CHECKING:
    from lbt_synth.design.shaping import VibrationBand
    from lbt_synth.loop.fusion.fused_loop import AnyLoop

ORIGIN = "distance from its Riccati filter"


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
class Design(Summarised):
    """A certified controller.

    Attributes
    ----------
    method : str
        Name that the method of synthesis gives its designs.
    controller : Controller
        From y(k) to u(k), the known input included (new-state form). The designs of this package
        make it of their loop and gains; it cannot be given to them.
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
    def several_sensors(self) -> bool:
        """Whether the design reads other sensors beside the loop's own, by a periodic filter."""
        return False

    @property
    def expected_residual_nm(self) -> float | None:
        """Residual that the design expects, rms of all modes; None if it was made for none."""
        return None

    @property
    def vibration_bands(self) -> tuple[VibrationBand, ...]:
        """Bands in which the design expects a vibration anywhere."""
        return ()

    def violated_demands(self, controller: Controller) -> tuple[str, ...] | None:
        """Return the demands on the design that a controller violates; None if it has none."""
        return None

    def facts(self) -> Any:
        """Return the numbers that this kind of design has, a row; None if there are none."""
        return None

    def close(self, hardware: LoopHardware, *, sensor_gain: float = 1.0) -> AnyLoop:
        """Close a loop around the design, which is stable or not.

        Parameters
        ----------
        hardware : LoopHardware
            Sensor, mirror and delay.
        sensor_gain : float, optional
            Real sensor gain relative to the sensor matrix.
        """
        return close_loop(hardware, self, sensor_gain=sensor_gain)

    def _brief(self) -> str:
        loop = "" if self.hardware is None else f", {self.hardware._brief()}"
        route = "" if self.solver.route in self.method else f" by {self.solver.route}"
        return f"{self.method}{route}, {count_text(self.controller.n_states, 'state')}{loop}"

    def _summarise(self) -> Summary:
        return summarise_design(self)

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

    @property
    def expected_residual_nm(self) -> float | None:
        """Standard deviation of the estimation error; None for a bare estimation problem."""
        return None if self.hardware is None else self.rms

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
        return model_facts(FilterFacts, self)

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
        certificate=UNCERTIFIED,
        solver=solver,
        problem=problem,
        gain_predictor=gain_predictor,
        gain_filter=gain_filter,
        **claims,
    )
    return with_certificate(design, "Try the other route, or scale the states to similar sizes.")


def require_hardware(design: Design, what: str) -> LoopHardware:
    """Return the loop of a design; refuse one of a bare estimation problem."""
    if design.hardware is not None:
        return design.hardware
    got = "one of a bare estimation problem. Design for the plant of a loop"
    raise ProblemError(f"{what} needs the design of a loop; got {got}.")
