"""Tables of a report of designs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from lbt_synth.loop import BandLimit, ResidualLimit
from lbt_synth.report.designs.assessment import DesignAssessment
from lbt_synth.report.designs.report import DesignReport
from lbt_synth.report.designs.verdict import good_range
from lbt_synth.report.number_text import (
    DASH,
    MINUS,
    fixed_text,
    interval_text,
    number_text,
    signed_text,
)
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.studies import LimitRow

Value = Callable[[DesignAssessment, LimitRow], str | Cell]
_one_decimal = partial(fixed_text, decimals=1)
_two_decimals = partial(fixed_text, decimals=2)
_three_digits = partial(number_text, digits=3)


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
        ("error in its own model [nm rms]", lambda one, _: _one_decimal(one.estimation_rms)),
        ("certificate, recomputed", lambda one, _: _certificate_cell(one)),
        "In the loop of the configuration",
        ("closed loop", lambda one, _: _stability_cell(one)),
        ("largest modulus of its poles", lambda one, _: number_text(one.spectral_radius, 6)),
        ("residual, exact [nm rms]", lambda one, _: _one_decimal(one.residual_nm)),
        ("of that turbulence [nm rms]", _part("budget", "turbulence_nm", _one_decimal)),
        ("of that vibration [nm rms]", _part("budget", "vibration_nm", _one_decimal)),
        ("of that noise [nm rms]", _part("budget", "noise_nm", _one_decimal)),
        ("Strehl ratio, exact [%]", lambda one, _: _two_decimals(100 * one.strehl)),
        ("Strehl ratio, simulated [%]", lambda one, _: _simulated_text(report, one)),
    ]
    above = _limit_rows(report.limits.limit, ", frequency known", "above_limit_percent")
    if above:
        rows += ["Distance to the limit of any linear controller", *above]
    if report.errors_hz.size > 1:
        ends = interval_text(float(report.errors_hz[0]), float(report.errors_hz[-1]))
        rows += [
            f"Over frequency errors of {ends} Hz",
            ("worst residual [nm rms]", lambda _, row: _one_decimal(row.worst_nm)),
            ("worst Strehl ratio [%]", lambda one, _: _two_decimals(_worst_percent(one))),
            ("within 10 % of its best Strehl ratio [Hz]", lambda one, _: _good_text(one)),
            *_limit_rows(report.limits.band, " for this range", "above_band_limit_percent"),
        ]
    rows += [
        "Margins at the real sensor gain",
        ("modulus margin", _part("margins", "modulus", _three_digits)),
        ("gain margin, factors", lambda one, _: _gain_margin_text(one)),
        ("phase margin [deg]", _part("margins", "phase_deg", _three_digits)),
        ("delay margin [frames]", _part("margins", "delay_frames", _three_digits)),
        ("highest crossover [Hz]", _part("margins", "crossover_hz", _three_digits)),
        ("stable real sensor gains", lambda one, _: _stable_gains_text(one)),
    ]
    return Table(
        caption=f"Summary at a real sensor gain of {number_text(report.real_gain)}",
        headings=("quantity", *report.names),
        rows=tuple(
            (entry,)
            if isinstance(entry, str)
            else (entry[0], *(entry[1](one, row) for one, row in report.rows))
            for entry in rows
        ),
    )


def _part(part: str, name: str, text: Callable[[float], str]) -> Value:
    """Return what prints a number of the budget or the margins, which unstable loops lack."""

    def value(one: DesignAssessment, _: Any) -> str:
        found = getattr(one, part)
        return DASH if found is None else text(getattr(found, name))

    return value


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


def _simulated_text(report: DesignReport, one: DesignAssessment) -> str:
    run = report.simulations.get(one.name)
    if run is None:
        return DASH
    scatter = "" if np.isnan(run.scatter) else f" ± {_two_decimals(100 * run.scatter)}"
    return f"{_two_decimals(100 * run.strehl)}{scatter}"


def _worst_percent(one: DesignAssessment) -> float:
    return 100 * float(np.min(one.curve.strehl)) if one.stable else float("nan")


def _good_text(one: DesignAssessment) -> str:
    found = good_range(one)
    return DASH if found is None else f"{signed_text(found.low_hz)} to {signed_text(found.high_hz)}"


def _gain_margin_text(one: DesignAssessment) -> str:
    if one.margins is None:
        return DASH
    return interval_text(one.margins.gain_low, one.margins.gain_high, 3)


def _stable_gains_text(one: DesignAssessment) -> str | Cell:
    if not one.sensor_gains:
        return Cell(text="none found", tone="bad")
    return ", ".join(interval_text(low, high, 4) for low, high in one.sensor_gains)
