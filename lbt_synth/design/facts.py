"""The facts of designs, as ``print``, ``lbt-synth show`` and notebooks show them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

from lbt_synth.linear.state_space import sigma_sparkline
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.loop.closed_loop import REJECTION
from lbt_synth.storage.rows import column, fact_table, fill_row, table_row
from lbt_synth.storage.summaries import Summary
from lbt_synth.storage.tables import Table

if TYPE_CHECKING:
    from lbt_synth.design.result import Design, EstimatorDesign

Facts = TypeVar("Facts")
_BRIEFLY = (
    *("certificate", "gain", "residual_nm", "limit_nm", "gamma"),
    *("modulus", "gain_low", "gain_high", "phase_deg"),
)

LIMIT_IN_MODEL = "least residual of any linear controller in it"  # heading, below the residual


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
class IntegratorFacts:
    """Gain and law of an integrator."""

    gain: float = column("gain")
    leak: float | None = column("left of a command after a frame")
    integrators: int | None = column("integrators")
    zero_hz: float | None = column("corner of the zero", unit="Hz")
    phase_margin_demand_deg: float | None = column("phase margin demanded", unit="deg")
    modulus_margin_demand: float | None = column("modulus margin demanded")


@table_row
class FilterFacts:
    """What a filter achieves, beside what it was asked for and what is possible."""

    rms: float = column("estimation error, rms", unit="nm")
    gamma: float = column("estimation error, H-infinity norm", unit="nm")
    residual_nm: float | None = column("residual in its model, rms", unit="nm")
    limit_nm: float | None = column(LIMIT_IN_MODEL, unit="nm")
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
    limit_nm: float | None = column(LIMIT_IN_MODEL, unit="nm")
    above_limit_percent: float | None = column("residual above it", unit="%", format=".5f")
    command_weight: float = column("weight of the command")


@table_row
class RobustFacts:
    """What a robust controller is, beside the limits over its bands."""

    states_per_mode: int = column("states of one mode, past commands included")
    loss: float = column("objective above the long parameter's", unit="%", scale=100)
    limit_nm: float = column("least worst residual over its bands, all modes", unit="nm")
    above_limit_percent: float = column("residual at unit sensor gain above it", unit="%")
    objective_nm: tuple[float, ...] = column(unit="nm")
    long_objective_nm: tuple[float, ...] = column(unit="nm")


def model_facts(kind: type[Facts], design: EstimatorDesign) -> Facts:
    """Return a row of a design with residual and limit of its own model, None without a loop."""
    from lbt_synth.design.model_limits import model_limit

    names = ("residual_nm", "limit_nm", "above_limit_percent")
    found = (None, None, None) if design.hardware is None else model_limit(design)
    limits = dict(zip(names, found, strict=True))
    return fill_row(kind, design, **limits)


def summarise_design(design: Design) -> Summary:
    """Return what a design shows when it is printed."""
    own, certificate = design.facts(), CertificateFacts(certificate=design.certificate._brief())
    notes = [f"assumes: {assumption}." for assumption in design.assumptions]
    if design.hardware is None:
        printed = without_units(fact_table("Design", own, certificate))
        return Summary(tables=[printed], notes=notes)
    loop = close_loop(design.hardware, design)
    margins = [loop_margins(loop)] if loop.is_stable else []
    return Summary(
        tables=[fact_table("Design", own, *margins, certificate, only=_BRIEFLY)],
        notes=notes,
        curve=sigma_sparkline(loop.rejection(), REJECTION),
    )


def without_units(table: Table) -> Table:
    """Return the facts of a bare estimation problem, whose signals have no units."""
    return replace(table, rows=tuple((*row[:2], "") for row in table.rows))
