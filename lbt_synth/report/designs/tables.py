"""The verdict on designs and the tables of a report."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lbt_synth.loop.least_residuals.band_limit import BandLimit
from lbt_synth.loop.least_residuals.residual_limit import ResidualLimit
from lbt_synth.report.designs.report import DesignAssessment, DesignReport
from lbt_synth.report.number_text import (
    DASH,
    NO_BREAK,
    fixed_text,
    interval_text,
    number_text,
    signed_text,
)
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import (
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
    within_nm: float | None = nm_column(
        "", unit="nm rms", help="of that within frames", default=None
    )
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
        *(one, one.loop, one.budget, one.margins, one.cost, limits, one.design, one.design.solver),
        design=one.name,
        estimation_rms=one.design.rms,
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


_DESIGN = ("method", "route", "n_states", "multiplications", "gamma", "estimation_rms", "certified")
_LOOP = (
    *("stable", "spectral_radius", "residual_nm", "turbulence_nm", "vibration_nm", "noise_nm"),
    *("within_nm", "strehl", "strehl_simulated"),
)
_GOOD = "within 10 % of its best Strehl ratio [Hz]"
_MARGINS = (
    *("modulus", "gain margin, factors", "phase_deg", "delay_frames", "crossover_hz"),
    *("stable real sensor gains", "proved while the gain moves at any speed"),
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
        over = ("worst_nm", "worst_strehl", _GOOD, *band)
        groups.append((f"Over frequency errors of {ends} Hz", over))
    groups.append(("Margins at the real sensor gain", _MARGINS))
    printed = {each.name: each for each in columns(AssessmentRow)}
    designs = [
        (assessment_row(report, one, row), _own_cells(report, one)) for one, row in report.rows
    ]
    lines: list[tuple[str | Cell, ...]] = []
    for group, names in groups:
        lines.append((group,))
        for name in names:
            each = printed.get(name)
            title = name
            if each is not None:
                title = f"{each.help} [{each.shown_unit}]" if each.unit else each.help
            cells = (
                own[name] if name in own else replace(printed[name], missing=DASH).text(row)
                for row, own in designs
            )
            lines.append((titles.get(name, title), *cells))
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


def _limit_title(name: str, limit: ResidualLimit | BandLimit | None, where: str) -> dict[str, str]:
    """Return the title of percents above a limit, or none where the limit says nothing."""
    if limit is None or not limit.rms_nm > 0:
        return {}
    return {name: f"above the limit of {nm_text(limit.rms_nm, '.1f')}{where} [%]"}


def _own_cells(report: DesignReport, one: DesignAssessment) -> dict[str, str | Cell]:
    """Return the cells of a design that are not a number of its row: words and intervals."""
    margins, run, good = one.margins, report.simulations.get(one.name), good_range(one)
    if one.certified:
        certified = Cell(text=f"passed, {count_text(len(one.checks), 'check')}", tone="good")
    else:
        failed = sum(not check.passed for check in one.checks)
        text = "NOT COMPUTED" if one.certificate_error else f"FAILED, {failed} of {len(one.checks)}"
        certified = Cell(text=text, tone="bad")
    simulated = DASH
    if run is not None:
        scatter = "" if np.isnan(run.scatter) else f" ± {fixed_text(100 * run.scatter, 2)}"
        simulated = f"{fixed_text(100 * run.strehl, 2)}{scatter}"
    gains: str | Cell = ", ".join(interval_text(*ends, 4) for ends in one.sensor_gains)
    moving, gain = one.moving, report.config.sensor_gain
    return {
        "certified": certified,
        "stable": Cell(text="stable", tone="good")
        if one.stable
        else Cell(text="UNSTABLE", tone="bad"),
        "strehl_simulated": simulated,
        _GOOD: DASH if good is None else " to ".join(map(signed_text, good)),
        "gain margin, factors": DASH
        if margins is None
        else interval_text(margins.gain_low, margins.gain_high, 3),
        "stable real sensor gains": gains or Cell(text="none found", tone="bad"),
        # in real sensor gains, as those above it
        "proved while the gain moves at any speed": DASH
        if moving is None or np.isnan(moving.moving_low)
        else interval_text(gain * moving.moving_low, gain * moving.moving_high, 4),
    }
