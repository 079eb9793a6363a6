"""Designs: the controller, its certificate, and how it was computed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from lbt_synth.design.certificate import Certificate
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, EstimationProblem, StateSpace
from lbt_synth.linear.state_space import sigma_sparkline
from lbt_synth.loop import close_loop, loop_margins, model_budget
from lbt_synth.loop.closed_loop import REJECTION
from lbt_synth.loop.least_residuals.residual_limit import (
    above_percent,
    least_model_residual,
    limit_or_nan,
)
from lbt_synth.models import FullStatePlant, LoopHardware, TipTiltPlant
from lbt_synth.storage.rows import column, fact_table, fill_row, table_row
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.storage.tables import Table
from lbt_synth.storage.words import count_text
from lbt_synth.validation import ComplexArray

if TYPE_CHECKING:
    from lbt_synth.design.shaping import VibrationBand
    from lbt_synth.loop.fusion.fused_loop import AnyLoop

Facts = TypeVar("Facts")

_LIMIT = "least residual of any linear controller in it"  # heading, below the residual
_BRIEFLY = (
    *("certificate", "gain", "residual_nm", "limit_nm", "gamma"),
    *("modulus", "gain_low", "gain_high", "phase_deg"),
)


@table_row
class DesignFacts:
    """What every design has."""

    method: str = column("method")
    route: str = column("route")
    n_states: int = column("states of the controller")


@table_row
class CertificateFacts:
    """Whether a design passed its checks."""

    certificate: str = column("certificate")


@table_row
class FilterFacts:
    """What a filter achieves, beside what it was asked for and what is possible."""

    rms: float = column("estimation error, rms", unit="nm")
    gamma: float = column("estimation error, H-infinity norm", unit="nm")
    residual_nm: float | None = column("residual in its model, rms", unit="nm")
    limit_nm: float | None = column(_LIMIT, unit="nm")
    above_limit_percent: float | None = column("residual above it", unit="%", format=".5f")
    rms_requested: float | None = column("rms asked for", unit="nm")
    gamma_requested: float | None = column("bound asked for", unit="nm")
    gamma_least: float | None = column(
        "least norm of any filter, upper bound", unit="nm", format=".9g"
    )
    gamma_infeasible: float | None = column(
        "least norm of any filter, lower bound", unit="nm", format=".9g"
    )


@table_row
class LqgFacts:
    """What an LQG controller leaves, beside what is possible."""

    residual_nm: float = column("residual in its model, rms", unit="nm", key="rms")
    gamma: float = column("residual, H-infinity norm", unit="nm")
    limit_nm: float | None = column(_LIMIT, unit="nm")
    above_limit_percent: float | None = column("residual above it", unit="%", format=".5f")
    command_weight: float = column("weight of the command")


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
        rows = self.facts(), CertificateFacts(certificate=self.certificate._brief())
        notes = [f"assumes: {assumption}." for assumption in self.assumptions]
        if self.hardware is None:
            return Summary(tables=[without_units(fact_table("Design", *rows))], notes=notes)
        loop = close_loop(self.hardware, self)
        margins = [loop_margins(loop)] if loop.is_stable else []
        return Summary(
            tables=[fact_table("Design", rows[0], *margins, rows[1], only=_BRIEFLY)],
            notes=notes,
            curve=sigma_sparkline(loop.rejection(), REJECTION),
        )

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
    """A controller that applies an estimator of z."""

    problem: EstimationProblem  # the problem (a plant, for a telescope)

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

    def model_facts(self, kind: type[Facts]) -> Facts:
        """Return a row with residual and limit of the own model, None without a loop."""
        names = ("residual_nm", "limit_nm", "above_limit_percent")
        values = (None, None, None) if self.hardware is None else model_limit(self)
        return fill_row(kind, self, **dict(zip(names, values, strict=True)))

    @abstractmethod
    def error_system(self, problem: EstimationProblem | None = None) -> StateSpace:
        """System from w to the estimation error."""


UNCERTIFIED = Certificate(checks=(), gamma=np.nan, rms_per_output=np.zeros(0))
AnyDesign = TypeVar("AnyDesign", bound=Design)


def with_certificate(design: AnyDesign, hint: str) -> AnyDesign:
    """Return a design with its certificate; raise CertificateError with a hint if it fails."""
    return replace(design, certificate=design.recertify().require(hint))


def require_hardware(design: Design, what: str) -> LoopHardware:
    """Return the loop of a design; refuse one of a bare estimation problem."""
    if design.hardware is not None:
        return design.hardware
    got = "one of a bare estimation problem. Design for the plant of a loop"
    raise ProblemError(f"{what} needs the design of a loop; got {got}.")


def model_limit(design: EstimatorDesign) -> tuple[float, float, float]:
    """Return a filter's residual in its own model, the limit there [nm rms], and how far above [%].

    What cannot be computed is nan. The residual is the estimation error where the mirror reaches
    every command at once, or the design commands for its dynamics.
    """
    plant = design.problem
    if not isinstance(plant, TipTiltPlant | FullStatePlant):
        return np.nan, np.nan, np.nan
    hardware, residual_nm = plant.hardware, design.rms
    settled = hardware.delay_frames % 1 == 0 and hardware.mirror is None
    if not (settled or design.knows_mirror):
        residual_nm = np.nan
        if isinstance(plant, TipTiltPlant):
            loop = close_loop(hardware, design.controller)
            residual_nm = model_budget(loop, plant).rms_nm if loop.is_stable else np.nan
    limit_nm = limit_or_nan(lambda: least_model_residual(plant))
    return residual_nm, limit_nm, above_percent(residual_nm, limit_nm)


def without_units(table: Table) -> Table:
    """Return the facts of a bare estimation problem, whose signals have no units."""
    return replace(table, rows=tuple((*row[:2], "") for row in table.rows))
