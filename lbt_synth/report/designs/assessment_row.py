"""The row of one design in a report, which the terminal, JSON and the page print."""

from __future__ import annotations

from lbt_synth.report.designs.assessment import DesignAssessment
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.storage.rows import column, fill_row, nm_column, percent_column, table_row
from lbt_synth.studies import LimitRow


@table_row
class AssessmentRow:
    """One design in the loop of the configuration; the page prints each column's help."""

    design: str = column("design", help="design")
    method: str = column("method", help="method")
    route: str = column(help="computed by")
    n_states: int = column(help="states of the controller")
    multiplications: int = column(help="multiplications per frame")
    gamma: float = column(
        unit="nm",
        format=".5g",
        help="achieved gamma, norm of the error in its own model",
    )
    estimation_rms: float = nm_column("", unit="nm rms", help="error in its own model")
    stable: bool = column("stable", help="closed loop")
    certified: bool = column("certified", help="certificate, recomputed")
    spectral_radius: float = column(format=".6g", help="largest modulus of its poles")
    residual_nm: float = nm_column("residual", unit="nm rms", help="residual, exact")
    turbulence_nm: float | None = nm_column(
        "", unit="nm rms", help="of that turbulence", default=None
    )
    vibration_nm: float | None = nm_column(
        "", unit="nm rms", help="of that vibration", default=None
    )
    noise_nm: float | None = nm_column("", unit="nm rms", help="of that noise", default=None)
    strehl: float = percent_column("Strehl", help="Strehl ratio, exact")
    strehl_simulated: float | None = percent_column("", help="Strehl ratio, simulated")
    worst_strehl: float = percent_column("worst Strehl", help="worst Strehl ratio")
    worst_nm: float = nm_column("", unit="nm rms", help="worst residual")
    above_limit_percent: float = column(unit="%", format=".0f")
    above_band_limit_percent: float = column(unit="%", format=".0f")
    modulus: float | None = column(
        "modulus margin", format=".3f", help="modulus margin", default=None
    )
    phase_deg: float | None = column(unit="deg", format=".3g", help="phase margin", default=None)
    delay_frames: float | None = column(
        unit="frames", format=".3g", help="delay margin", default=None
    )
    crossover_hz: float | None = column(
        unit="Hz", format=".3g", help="highest crossover", default=None
    )


def assessment_row(report: DesignReport, one: DesignAssessment, limits: LimitRow) -> AssessmentRow:
    """Return the row of a design; numbers that an unstable loop lacks are None or nan."""
    simulation = report.simulations.get(one.name)
    return fill_row(
        AssessmentRow,
        *(one, one.budget, one.margins, one.cost, limits, one.design, one.design.solver),
        design=one.name,
        n_states=one.design.controller.n_states,
        strehl_simulated=None if simulation is None else simulation.strehl,
        worst_strehl=float(one.curve.strehl.min()) if one.stable else float("nan"),
    )
