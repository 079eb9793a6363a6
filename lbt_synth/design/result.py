"""Designs: the controller, its claims and its certificate, and how it was computed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from lbt_synth.design.certificate import Certificate, Claim, Evidence, stability_check
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.loop import (
    ClosedLoop,
    close_loop,
    loop_margins,
    residual_budget,
    stable_sensor_gains,
)
from lbt_synth.loop.closed_loop import reads_others
from lbt_synth.loop.least_residual import above_percent, least_residual, limit_or_none
from lbt_synth.models import LoopHardware, TipTiltPlant
from lbt_synth.storage.display_unit import require_unit
from lbt_synth.storage.rows import Column, Facts, fact_table
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.storage.tables import Table
from lbt_synth.storage.words import count_text
from lbt_synth.validation import ComplexArray, FloatArray, number, set_fields

if TYPE_CHECKING:
    from lbt_synth.design.shaping import Specification

_WHAT = (
    Column(name="method", heading="method"),
    Column(name="route", heading="route"),
    Column(name="n_states", heading="states of the controller"),
)
_CERTIFICATE = Column(name="certificate", heading="certificate")
_BRIEFLY = (
    *("certificate", "gain", "residual_nm", "limit_nm", "gamma"),
    *("modulus", "gain_low", "gain_high", "phase_deg"),
)
SENSOR_FACTS = (
    Column(name="sensors", heading="sensors and channels"),
    Column(name="loop_radius", heading="spectral radius of the loop, over a period"),
    Column(name="gain_low", heading="stable gain factors, from", format=".4g"),
    Column(name="gain_high", heading="stable gain factors, to", format=".4g"),
)
MODEL_LIMITS = (
    Column(name="residual_nm", heading="residual in its model, rms", unit="nm"),
    Column(name="limit_nm", heading="least residual of any linear controller in it", unit="nm"),
    Column(name="above_limit_percent", heading="residual above it", unit="%", format=".5f"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverReport:
    """How a design was computed; no evidence of its quality.

    Attributes
    ----------
    route : str
        "riccati", "sdp", "lmi" or "closed form".
    status : str
        What the solver said of itself.
    """

    route: str
    status: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RowTable:
    """A table that ``show`` prints of a design."""

    key: str  # in JSON
    title: str
    rows: Sequence[Any]  # made with :func:`lbt_synth.storage.rows.table_row`, all of one type
    notes: Sequence[str] = ()  # what the rows mean, and what they warn of


UNCERTIFIED = Certificate(checks=(), gamma=np.nan, rms_per_output=np.zeros(0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Design(Summarised, ABC):
    """A certified controller, with what it claims.

    Attributes
    ----------
    method : str
        Name that the method of synthesis gives its designs.
    problem : EstimationProblem or LoopHardware
        What the controller is for: a plant, a bare estimation problem, or a loop alone.
    controller : Controller
        From y(k) to u(k), the known input included (new-state form). The designs of this package
        make it of their loop and gains; it cannot be given to them.
    claims : mapping of str to number
        What the design says of itself, by the names of its ``CLAIMS``.
    certificate : Certificate
        Checks that were passed.
    solver : SolverReport
        How it was computed.
    assumptions : tuple of str
        What the design rests on and no certificate shows, such as where a sensor gain is from.
    configuration : str
        The configuration that it was made from, as JSON; empty if there was none.
    diameter_m, shown_unit : float or None, str or None
        Telescope diameter [m], and the unit in which people see the wavefront: nm, um, mas or urad.
    """

    CLAIMS: ClassVar[tuple[Claim, ...]] = ()  # what a design of this kind may claim
    DERIVED: ClassVar[tuple[Column, ...]] = ()  # numbers that follow, printed below the claims
    is_estimator: ClassVar[bool] = False  # whether it has an estimation error
    knows_mirror: ClassVar[bool] = True  # whether it counts on dynamics of the mirror

    method: str
    problem: Any
    controller: Controller = field(init=False)
    claims: Mapping[str, Any] = field(default_factory=dict)
    certificate: Certificate = UNCERTIFIED
    solver: SolverReport
    assumptions: tuple[str, ...] = ()
    configuration: str = ""
    diameter_m: float | None = None
    shown_unit: str | None = None

    def __post_init__(self) -> None:
        if unknown := self.claims.keys() - {claim.name for claim in self.CLAIMS}:
            raise ProblemError(f"a design of {self.method} does not claim {min(unknown)}.")
        if self.diameter_m is not None:
            number(self.diameter_m, "diameter_m", above=0)
        require_unit(self.shown_unit)
        set_fields(self, claims=dict(self.claims), controller=self.make_controller())

    @abstractmethod
    def make_controller(self) -> Controller:
        """Return the controller of the problem, the arrays and the claims."""

    def examine(self) -> Evidence:
        """Compute what rests on no claim: stability first, then norms and gains.

        The stability of a loop is checked of every design; by default there is nothing else.
        """
        return Evidence(design=self, certificate=UNCERTIFIED)

    @property
    def hardware(self) -> LoopHardware | None:
        """Loop that the design is for; None for a bare estimation problem."""
        return getattr(self.problem, "hardware", None)

    @property
    def plant(self) -> TipTiltPlant | None:
        """Plant that the design is for, with its models; None for one that is made of less."""
        return self.problem if isinstance(self.problem, TipTiltPlant) else None

    @property
    def gamma(self) -> float:
        """H-infinity norm of the estimation error; nan for a design without one."""
        return float(self.claims.get("gamma", np.nan))

    @property
    def rms(self) -> float:
        """Standard deviation of the estimation error over all outputs; nan without one."""
        return float(self.claims.get("rms", np.nan))

    @property
    def gamma_requested(self) -> float:
        """Bound that the H-infinity design was given; nan without one."""
        return float(self.claims.get("gamma_requested", np.nan))

    @property
    def gamma_least(self) -> float:
        """Norm that a filter of the problem achieves, with the least gamma; nan if not computed."""
        return float(self.claims.get("gamma_least", np.nan))

    @property
    def gamma_infeasible(self) -> float:
        """Level that no filter reaches: the least gamma is not below it; nan if not computed."""
        return float(self.claims.get("gamma_infeasible", np.nan))

    @property
    def controllers(self) -> Mapping[frozenset[str], Controller]:
        """The controller for each set of sensors and channels that are not read, none included."""
        return {frozenset(): self.controller}

    @property
    def expected_residual_nm(self) -> float | None:
        """Residual that the design expects, rms of all modes; None if it was made for none."""
        return None if self.hardware is None or np.isnan(self.rms) else self.rms

    @property
    def integrator_gain(self) -> float | None:
        """Gain of a pure integrator; None for any other design."""
        return None

    @property
    def mode_specifications(self) -> tuple[Specification, ...]:
        """What each mode was shaped for; empty for a design that was not shaped."""
        return ()

    @property
    def first_equal_modes(self) -> list[int]:
        """For each mode that was shaped, the first one that is equal to it."""
        return []

    def violated_demands(self, controller: Controller) -> tuple[str, ...] | None:
        """Return the demands on the design that a controller violates; None if it has none."""
        return None

    def error_system(self) -> StateSpace:
        """System from w to the estimation error; ProblemError for a design that is no estimator."""
        raise ProblemError(f"a design of {self.method} has no estimation error.")

    def derived(self) -> Mapping[str, Any]:
        """Return the numbers of ``DERIVED``."""
        return {}

    def arrays(self) -> dict[str, FloatArray]:
        """Return the arrays that the controller is made of, such as gains, by their names."""
        named = {part.name: getattr(self, part.name) for part in fields(self)}
        return {name: value for name, value in named.items() if isinstance(value, np.ndarray)}

    def tables(self) -> tuple[RowTable, ...]:
        """Return the tables that ``show`` prints below the facts."""
        return ()

    def notes(self) -> list[str]:
        """Return warnings that belong to no table."""
        return []

    def facts(self) -> Facts:
        """Return what the design is, what it claims, and the numbers that follow: a row."""
        route = f"{self.solver.route} ({self.solver.status})"
        what = {"method": self.method, "route": route, "n_states": self.controller.n_states}
        what["certificate"] = self.certificate._brief()
        columns = (*_WHAT, *self.CLAIMS, *self.DERIVED)
        return Facts(columns, {**what, **self.claims, **self.derived()})

    def close(self, hardware: LoopHardware, *, sensor_gain: float = 1.0) -> ClosedLoop:
        """Close a loop around the design, stable or not, with the sensors that it reads."""
        if self.hardware is not None and self.other_sensors:
            hardware = replace(hardware, suite=self.hardware.suite)
        return close_loop(hardware, self, sensor_gain=sensor_gain)

    @property
    def other_sensors(self) -> tuple[str, ...]:
        """Sensors and channels that the design reads beside the loop's own sensor."""
        if self.hardware is None or not reads_others(self.hardware, self.controller):
            return ()
        return self.hardware.suite.units[1:]

    def _brief(self) -> str:
        loop = "" if self.hardware is None else f", {self.hardware._brief()}"
        route = "" if self.solver.route in self.method else f" by {self.solver.route}"
        return f"{self.method}{route}, {count_text(self.controller.n_states, 'state')}{loop}"

    def _summarise(self) -> Summary:
        facts = self.facts()
        passed = Facts((_CERTIFICATE,), facts.values)
        notes = [f"assumes: {assumption}." for assumption in self.assumptions]
        if self.hardware is None:
            said = Facts((*self.CLAIMS, *self.DERIVED), facts.values)
            table = without_units(fact_table("Design", said, passed))
            return Summary(tables=[table], notes=[*notes, *self.notes()])
        loop = close_loop(self.hardware, self)
        alone = not loop.feedback().reads_others
        margins = [loop_margins(loop)] if loop.is_stable and alone else []
        return Summary(
            tables=[fact_table("Design", facts, *margins, passed, only=_BRIEFLY)],
            notes=notes,
        )

    @property
    def poles(self) -> ComplexArray:
        """Poles that the design places, (n,)."""
        return np.linalg.eigvals(self.controller.A).astype(np.complex128)

    def recertify(self) -> Certificate:
        """Compute the certificate again from the matrices, and check each claim; passed or not."""
        return self._conclude(self.examine())

    def _conclude(self, evidence: Evidence) -> Certificate:
        checks = list(evidence.certificate.checks)
        if self.hardware is not None:
            loop = self.close(self.hardware)
            checks.append(stability_check("spectral radius of the closed loop", loop))
        if checks and checks[0].passed and checks[-1].passed:
            for claim in self.CLAIMS:
                if claim.name in self.claims:
                    checks += claim.checks(evidence, self.claims[claim.name])
        return replace(evidence.certificate, checks=tuple(checks))


AnyDesign = TypeVar("AnyDesign", bound=Design)


def with_certificate(
    design: AnyDesign, hint: str, *, evidence: Evidence | None = None
) -> AnyDesign:
    """Return a design with its certificate; raise CertificateError with a hint if it fails.

    It claims the norms of its error as they are computed. The evidence is at hand, or computed.
    """
    evidence = evidence or design.examine()
    norms = {name: float(getattr(evidence.certificate, name)) for name in ("rms", "gamma")}
    named = {claim.name for claim in design.CLAIMS}
    claims = {name: norm for name, norm in norms.items() if name in named}
    claiming = replace(design, claims={**claims, **design.claims})
    set_fields(claiming, certificate=claiming._conclude(evidence).require(hint))
    return claiming


def require_hardware(design: Design, what: str) -> LoopHardware:
    """Return the loop of a design; refuse one of a bare estimation problem."""
    if design.hardware is not None:
        return design.hardware
    got = "one of a bare estimation problem. Design for the plant of a loop"
    raise ProblemError(f"{what} needs the design of a loop; got {got}.")


def model_limits(design: Design) -> Mapping[str, float | None]:
    """Return residual and limit in the image of the own model, and how far above it is."""
    plant = design.plant
    if plant is None:
        return {}
    loop = close_loop(plant.hardware, design.controller)
    residual_nm = residual_budget(loop, plant).rms_nm if loop.is_stable else np.nan
    limit = limit_or_none(lambda: least_residual(plant.hardware, plant))
    limit_nm = np.nan if limit is None else limit.rms_nm
    values = residual_nm, limit_nm, above_percent(residual_nm, limit_nm)
    return {column.name: value for column, value in zip(MODEL_LIMITS, values, strict=True)}


def sensor_facts(design: Design, hardware: LoopHardware) -> Mapping[str, Any]:
    """Return the sensors of a design, and where its loop is stable."""
    radius = design.close(hardware).spectral_radius
    gains = stable_sensor_gains(hardware, design.controller)
    values = ", ".join(hardware.suite.units), radius, *gains
    return {column.name: value for column, value in zip(SENSOR_FACTS, values, strict=True)}


def without_units(table: Table) -> Table:
    """Return the facts of a bare estimation problem, whose signals have no units."""
    return replace(table, rows=tuple((*row[:2], "") for row in table.rows))
