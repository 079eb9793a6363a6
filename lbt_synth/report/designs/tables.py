"""The verdict on designs and the tables of a report."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lbt_synth.loop.least_residuals.band_limit import BandLimit
from lbt_synth.loop.least_residuals.residual_limit import ResidualLimit
from lbt_synth.report.designs.report import DesignAssessment, DesignReport
from lbt_synth.report.number_text import (
    DASH,
    MINUS,
    NO_BREAK,
    fixed_text,
    interval_text,
    number_text,
    signed_text,
)
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import (
    Column,
    column,
    columns,
    fill_row,
    nm_column,
    percent_column,
    row_table,
    table_row,
)
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.storage.words import count_text, listing_text
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


KEPT = 0.9  # of its best Strehl ratio, within which a design counts as good


def good_range(one: DesignAssessment) -> tuple[float, float] | None:
    """Return between which frequency errors [Hz] a design keeps 90 % of its best Strehl ratio.

    None where it is unstable.
    """
    if not one.stable:
        return None
    errors, strehls = one.curve.errors_hz, one.curve.strehl[0, 0]
    best = int(np.argmax(strehls))
    poor = np.flatnonzero(strehls < KEPT * np.max(strehls))
    first = int(np.max(poor[poor < best], initial=-1)) + 1
    last = int(np.min(poor[poor > best], initial=errors.size)) - 1
    return float(errors[first]), float(errors[last])


def verdict(report: DesignReport) -> str:
    """Return at most three sentences: which design leaves least, which is robust, what is proved.

    The table of the report has the numbers of all designs.
    """
    sentences = [_certificate_sentence(report)]
    if report.stable and report.errors_hz.size > 1:
        sentences.insert(0, _error_sentence(report))
    if report.stable:
        sentences.insert(0, _least_sentence(report))
    # a number stays in one line with its unit
    return re.sub(r"(?<=\d) (?=%|nm|um|mas|urad|Hz)", NO_BREAK, " ".join(sentences))


def _least_sentence(report: DesignReport) -> str:
    stable = report.stable
    best = min(stable, key=lambda one: one.residual_nm)
    shown = {one.name: nm_text(one.residual_nm, ".1f", unit="nm rms") for one in stable}
    least = shown[best.name]
    # designs that show the same number as the best are as good
    equal = [name for name, text in shown.items() if text == least]
    verb = "leave" if len(equal) > 1 else "leaves"
    several = len(stable) > 1
    where = ", if the vibrations are where the configuration has them"
    return (
        f"{f'Of {len(stable)} stable designs, ' if several else ''}{listing_text(equal)} "
        f"{verb} {'the least, ' if several else ''}{least} (Strehl ratio "
        f"{fixed_text(100 * best.strehl, 1)} %){where if report.config.truth.vibrations else ''}."
    )


def _error_sentence(report: DesignReport) -> str:
    """Say which design keeps most of its Strehl ratio over all frequency errors."""
    first, last = (signed_text(float(report.errors_hz[i])) for i in (0, -1))
    worst = {
        one.name: fixed_text(100 * float(np.min(one.curve.strehl)), 1) for one in report.stable
    }
    most = max(worst.values(), key=float)
    tough = [name for name, percent in worst.items() if percent == most]
    if len(worst) == 1:
        who = "the"
    elif len(tough) == len(worst):
        who = "all do equally well: the"
    else:
        who = f"{listing_text(tough)} {'does' if len(tough) == 1 else 'do'} best: the"
    return (
        f"If their frequencies are wrong by {first} to {last} Hz, {who} Strehl ratio is still "
        f"{most} % at worst."
    )


def _certificate_sentence(report: DesignReport) -> str:
    """Say which designs are unstable, and whether all certificates hold."""
    unstable = [one.name for one in report.assessments if not one.stable]
    failed = [one.name for one in report.assessments if not one.certified]
    checks = sum(len(one.checks) for one in report.assessments)
    parts = []
    if unstable:
        verb = "is" if len(unstable) == 1 else "are"
        parts.append(f"{listing_text(unstable)} {verb} UNSTABLE in this loop")
    if failed:
        parts.append(f"the certificate of {listing_text(failed)} does NOT hold")
    elif unstable:  # a proof about another loop must not be taken for one about this loop
        about = "they are about the loops that the designs were made for, not about this one"
        parts.append(f"all {checks} checks of the certificates passed, but {about}")
    else:
        parts.append(f"all {checks} checks of the certificates were recomputed and passed")
    sentence = "; ".join(parts)
    return f"{sentence if unstable else sentence[0].upper() + sentence[1:]}."


# titles of what is an interval, not a column of the row
_GOOD = "within 10 % of its best Strehl ratio [Hz]"
_GAIN_MARGIN, _STABLE_GAINS = "gain margin, factors", "stable real sensor gains"
_MOVING_GAINS = "proved while the gain moves at any speed"
_OWN_CELLS: dict[str, Callable[[DesignReport, DesignAssessment], str | Cell]] = {
    "certified": lambda _, one: _certificate_cell(one),
    "stable": lambda _, one: _stability_cell(one),
    "strehl_simulated": lambda report, one: _simulated_text(report, one),
    _GOOD: lambda _, one: _good_text(one),
    _GAIN_MARGIN: lambda _, one: _gain_margin_text(one),
    _STABLE_GAINS: lambda _, one: _stable_gains_text(one),
    _MOVING_GAINS: lambda report, one: _moving_text(report, one),
}
_DESIGN = ("method", "route", "n_states", "multiplications", "gamma", "estimation_rms", "certified")
_LOOP = (
    *("stable", "spectral_radius", "residual_nm", "turbulence_nm", "vibration_nm", "noise_nm"),
    *("strehl", "strehl_simulated"),
)
_RANGE = ("worst_nm", "worst_strehl", _GOOD)
_MARGINS = (
    *("modulus", _GAIN_MARGIN, "phase_deg", "delay_frames", "crossover_hz", _STABLE_GAINS),
    _MOVING_GAINS,
)


def summary_table(report: DesignReport) -> Table:
    """All designs side by side: the columns of their rows, in groups."""
    limits = report.limits
    groups: list[tuple[str, Sequence[str]]] = [
        ("Design", _DESIGN),
        ("In the loop of the configuration", _LOOP),
    ]
    titles = _limit_title("above_limit_percent", limits.limit, ", frequency known")
    if titles:
        groups.append(("Distance to the limit of any linear controller", list(titles)))
    if report.errors_hz.size > 1:
        ends = interval_text(float(report.errors_hz[0]), float(report.errors_hz[-1]))
        band = _limit_title("above_band_limit_percent", limits.band, " for this range")
        titles |= band
        groups.append((f"Over frequency errors of {ends} Hz", [*_RANGE, *band]))
    groups.append(("Margins at the real sensor gain", _MARGINS))
    printed = {each.name: each for each in columns(AssessmentRow)}
    found = [(one, assessment_row(report, one, row)) for one, row in report.rows]
    lines: list[tuple[str | Cell, ...]] = []
    for group, names in groups:
        lines.append((group,))
        for name in names:
            each, own = printed.get(name), _OWN_CELLS.get(name)
            title = titles.get(name) or (name if each is None else _title(each))
            cells = (_text(each, row) if own is None else own(report, one) for one, row in found)
            lines.append((title, *cells))
    return Table(
        caption=f"Summary at a real sensor gain of {number_text(report.real_gain)}; "
        f"{report.config.imaging.label}",
        headings=("quantity", *report.names),
        rows=tuple(lines),
    )


def truth_table(report: DesignReport) -> Table:
    """Return the designs and reference designs in the truth of the configuration."""
    caption = f"In the truth of {report.config.source.name}; {report.config.imaging.label}"
    without = ("worst_nm", "above_band_limit_percent", "method", "stable")
    return row_table(caption, report.truth.rows, without=without)


def _title(each: Column) -> str:
    return f"{each.help} [{each.shown_unit}]" if each.unit else each.help


def _text(each: Column | None, row: AssessmentRow) -> str:
    """Return a number of a row with the signs of print."""
    assert each is not None  # a cell that is no column has its own function
    text = replace(each, missing=DASH).text(row)
    return text if isinstance(getattr(row, each.name), str) else text.replace("-", MINUS)


def _limit_title(name: str, limit: ResidualLimit | BandLimit | None, where: str) -> dict[str, str]:
    """Return the title of percents above a limit, or none where the limit says nothing."""
    if limit is None or not limit.rms_nm > 0:
        return {}
    return {name: f"above the limit of {nm_text(limit.rms_nm, '.1f')}{where} [%]"}


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
        return Cell(text=f"passed, {count_text(len(one.checks), 'check')}", tone="good")
    failed = sum(not check.passed for check in one.checks)
    text = "NOT COMPUTED" if one.certificate_error else f"FAILED, {failed} of {len(one.checks)}"
    return Cell(text=text, tone="bad")


def _stability_cell(one: DesignAssessment) -> Cell:
    return Cell(text="stable", tone="good") if one.stable else Cell(text="UNSTABLE", tone="bad")


def _simulated_text(report: DesignReport, one: DesignAssessment) -> str:
    run = report.simulations.get(one.name)
    if run is None:
        return DASH
    scatter = "" if np.isnan(run.scatter) else f" ± {fixed_text(100 * run.scatter, 2)}"
    return f"{fixed_text(100 * run.strehl, 2)}{scatter}"


def _good_text(one: DesignAssessment) -> str:
    found = good_range(one)
    return DASH if found is None else " to ".join(map(signed_text, found))


def _gain_margin_text(one: DesignAssessment) -> str:
    if one.margins is None:
        return DASH
    return interval_text(one.margins.gain_low, one.margins.gain_high, 3)


def _stable_gains_text(one: DesignAssessment) -> str | Cell:
    if not one.sensor_gains:
        return Cell(text="none found", tone="bad")
    return ", ".join(interval_text(low, high, 4) for low, high in one.sensor_gains)


def _moving_text(report: DesignReport, one: DesignAssessment) -> str:
    """Return the interval of a gain that moves, in real sensor gains as those above it."""
    if one.moving is None:
        return DASH
    gain = report.config.sensor_gain
    low, high = gain * one.moving.moving_low, gain * one.moving.moving_high
    return DASH if np.isnan(low) else interval_text(low, high, 4)
