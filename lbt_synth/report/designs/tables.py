"""Tables of a report of designs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lbt_synth.loop import BandLimit, ResidualLimit
from lbt_synth.report.designs.assessment import DesignAssessment
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.number_text import DASH, MINUS, fixed_text, interval_text, number_text
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.studies import LimitRow

Value = Callable[[DesignAssessment, LimitRow], str | Cell]


def summary_table(report: DesignReport) -> Table:
    """All designs side by side."""
    rows: list[tuple[str, Value] | str] = [
        "Design",
        ("method", lambda one, _: one.design.method),
        ("computed by", lambda one, _: one.design.solver.route),
        ("states of the controller", lambda one, _: str(one.design.controller.n_states)),
        ("multiplications per frame", lambda one, _: str(one.cost.multiplications)),
        (
            "achieved gamma, H-infinity norm of the error in its own model [nm]",
            lambda one, _: number_text(one.gamma, 5),
        ),
        ("error in its own model [nm rms]", lambda one, _: fixed_text(one.estimation_rms, 1)),
        ("certificate, recomputed", lambda one, _: _certificate_cell(one)),
        "In the loop of the configuration",
        ("closed loop", lambda one, _: _stability_cell(one)),
        ("largest modulus of its poles", lambda one, _: number_text(one.spectral_radius, 6)),
        ("residual, exact [nm rms]", lambda one, _: fixed_text(one.residual_nm, 1)),
        ("of that turbulence [nm rms]", lambda one, _: _part_text(one, "turbulence_nm")),
        ("of that vibration [nm rms]", lambda one, _: _part_text(one, "vibration_nm")),
        ("of that noise [nm rms]", lambda one, _: _part_text(one, "noise_nm")),
        ("Strehl ratio, exact [%]", lambda one, _: fixed_text(100 * one.strehl, 2)),
        ("Strehl ratio, simulated [%]", lambda one, _: _simulated_text(report, one)),
    ]
    above = _limit_rows(report.limits.limit, ", frequency known", "above_limit_percent")
    if above:
        rows += ["Distance to the limit of any linear controller", *above]
    if report.errors_hz.size > 1:
        ends = interval_text(float(report.errors_hz[0]), float(report.errors_hz[-1]))
        rows += [
            f"Over frequency errors of {ends} Hz",
            ("worst residual [nm rms]", lambda _, row: fixed_text(row.worst_nm, 1)),
            ("worst Strehl ratio [%]", lambda one, _: fixed_text(_worst_percent(one), 2)),
            *_limit_rows(report.limits.band, " for this range", "above_band_limit_percent"),
        ]
    rows += [
        "Margins at the real sensor gain",
        ("modulus margin", lambda one, _: _margin_text(one, "modulus", 3)),
        ("gain margin, factors", lambda one, _: _gain_margin_text(one)),
        ("phase margin [deg]", lambda one, _: _margin_text(one, "phase_deg", 3)),
        ("delay margin [frames]", lambda one, _: _margin_text(one, "delay_frames", 3)),
        ("highest crossover [Hz]", lambda one, _: _margin_text(one, "crossover_hz", 3)),
        ("stable real sensor gains", lambda one, _: _stable_gains_text(one)),
    ]
    return Table(
        caption=f"Summary at a real sensor gain of {number_text(report.real_gain)}",
        headings=("quantity", *(one.name for one in report.assessments)),
        rows=tuple(
            (entry,)
            if isinstance(entry, str)
            else (entry[0], *(entry[1](one, row) for one, row in report.rows))
            for entry in rows
        ),
    )


def _limit_rows(
    limit: ResidualLimit | BandLimit | None, where: str, field: str
) -> list[tuple[str, Value]]:
    """Return the row of percents above a limit, or none where the limit says nothing."""
    if limit is None or not limit.rms_nm > 0:
        return []
    title = f"above the limit of {fixed_text(limit.rms_nm, 1)} nm{where} [%]"
    return [(title, lambda _, row: fixed_text(getattr(row, field), 0))]


def certificate_table(one: DesignAssessment) -> Table:
    """Return the checks of one design."""
    return Table(
        caption=f"Certificate of {one.name}",
        headings=("check", "value", "must stay below", "result", "computed by"),
        rows=tuple(
            (
                check.name,
                _measured_text(check.value),
                _measured_text(check.limit)
                if not 0.999 < check.limit < 1
                else f"1 {MINUS} 1e{MINUS}9",
                Cell(text="passed", tone="good")
                if check.passed
                else Cell(text="FAILED", tone="bad"),
                check.computed_by,
            )
            for check in one.checks
        ),
        words=(4,),
    )


def _measured_text(value: float) -> str:
    """Return six digits of a number, or three if it is close to 0."""
    return number_text(value, 6 if abs(value) >= 1e-4 else 3)


def _certificate_cell(one: DesignAssessment) -> Cell:
    if one.certified:
        count = len(one.checks)
        return Cell(text=f"passed, {count} check{'s' if count > 1 else ''}", tone="good")
    failed = sum(not check.passed for check in one.checks)
    text = "NOT COMPUTED" if one.certificate_error else f"FAILED, {failed} of {len(one.checks)}"
    return Cell(text=text, tone="bad")


def _stability_cell(one: DesignAssessment) -> Cell:
    return Cell(text="stable", tone="good") if one.stable else Cell(text="UNSTABLE", tone="bad")


def _part_text(one: DesignAssessment, name: str) -> str:
    return DASH if one.budget is None else fixed_text(getattr(one.budget, name), 1)


def _simulated_text(report: DesignReport, one: DesignAssessment) -> str:
    run = report.simulations.get(one.name)
    if run is None:
        return DASH
    scatter = "" if np.isnan(run.scatter) else f" ± {fixed_text(100 * run.scatter, 2)}"
    return f"{fixed_text(100 * run.strehl, 2)}{scatter}"


def _worst_percent(one: DesignAssessment) -> float:
    return 100 * float(np.min(one.curve.strehl)) if one.stable else float("nan")


def _margin_text(one: DesignAssessment, name: str, digits: int) -> str:
    return DASH if one.margins is None else number_text(getattr(one.margins, name), digits)


def _gain_margin_text(one: DesignAssessment) -> str:
    if one.margins is None:
        return DASH
    return interval_text(one.margins.gain_low, one.margins.gain_high, 3)


def _stable_gains_text(one: DesignAssessment) -> str | Cell:
    if not one.sensor_gains:
        return Cell(text="none found", tone="bad")
    return ", ".join(interval_text(low, high, 4) for low, high in one.sensor_gains)
