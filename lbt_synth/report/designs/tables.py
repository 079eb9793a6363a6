"""The verdict on designs and the tables of a report."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lbt_synth.loop.least_residuals.band_limit import BandLimit
from lbt_synth.loop.least_residuals.residual_limit import ResidualLimit
from lbt_synth.report.designs.report import DesignAssessment, DesignReport
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts, columns, fact, facts
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.storage.words import count_text, listing_text

_RMS: dict[str, Any] = {"unit": "nm rms", "format": ".1f"}
_RATIO: dict[str, Any] = {"unit": "%", "scale": 100, "format": ".2f"}


def design_facts(one: DesignAssessment) -> Facts:
    """Return the numbers of a design; the page prints each column's help."""
    design, limits = one.design, one.limits
    parts = {
        name: fact(getattr(one.budget, name, None), help=f"of that {word}", **_RMS)
        for name, word in (
            ("turbulence_nm", "turbulence"),
            ("vibration_nm", "vibration"),
            ("noise_nm", "noise"),
            ("within_nm", "within frames"),
        )
    }
    margins = {
        name: fact(getattr(one.margins, name, None), help=text, format=".3g", unit=unit)
        for name, text, unit in (
            ("modulus", "modulus margin", ""),
            ("phase_deg", "phase margin", "deg"),
            ("delay_frames", "delay margin", "frames"),
            ("crossover_hz", "highest crossover", "Hz"),
        )
    }
    simulated = float(np.mean(one.run_strehls)) if one.run_strehls.size else None
    worst = float(one.curve.strehl.min()) if one.stable else float("nan")
    return facts(
        design=fact(one.name, "design"),
        method=fact(design.method, "method", help="method"),
        route=fact(design.solver.route, help="computed by"),
        n_states=fact(design.controller.n_states, help="states of the controller"),
        multiplications=fact(one.cost.multiplications, help="multiplications per frame"),
        gamma=fact(
            design.gamma,
            unit="nm",
            format=".5g",
            help="achieved gamma, norm of the error in its own model",
        ),
        estimation_rms=fact(design.rms, help="error in its own model", **_RMS),
        stable=fact(one.stable, "stable", help="closed loop"),
        certified=fact(one.certified, "certified", help="certificate, recomputed"),
        spectral_radius=fact(
            one.loop.spectral_radius, format=".6g", help="largest modulus of its poles"
        ),
        residual_nm=fact(one.residual_nm, "residual", help="residual, exact", **_RMS),
        **parts,
        strehl=fact(one.strehl, "Strehl", help="Strehl ratio, exact", **_RATIO),
        strehl_simulated=fact(simulated, help="Strehl ratio, simulated", **_RATIO),
        worst_strehl=fact(worst, "worst Strehl", help="worst Strehl ratio", **_RATIO),
        worst_nm=fact(limits.worst_nm, help="worst residual", **_RMS),
        above_limit_percent=fact(limits.above_limit_percent, unit="%", format=".0f"),
        above_band_limit_percent=fact(limits.above_band_limit_percent, unit="%", format=".0f"),
        **margins,
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

    Designs that show the same number as the best are as good. The table of the report has all.
    """
    sentences = []
    if report.stable:
        shown = {one.name: one.residual_nm for one in report.stable}
        least, names = _leaders(
            {n: nm_text(v, ".1f", unit="nm rms") for n, v in shown.items()}, shown
        )
        strehl = max(one.strehl for one in report.stable)
        where = ", if the vibrations are where the configuration has them"
        sentences.append(
            f"Least residual: {names}, {least} (Strehl ratio {100 * strehl:.1f} %)"
            f"{where if report.config.truth.vibrations else ''}."
        )
    if report.stable and report.errors_hz.size > 1:
        worst = {one.name: -100 * float(np.min(one.curve.strehl)) for one in report.stable}
        most, names = _leaders(
            {name: f"{-percent:.1f} %" for name, percent in worst.items()}, worst
        )
        first, last = (f"{report.errors_hz[i]:+.4g}" for i in (0, -1))
        sentences.append(
            f"Highest Strehl ratio at worst, if their frequencies are wrong by {first} to {last} "
            f"Hz: {names}, {most}."
        )
    sentences.append(_certificate_sentence(report))
    # a number stays in one line with its unit
    return re.sub(r"(?<=\d) (?=%|nm|um|mas|urad|Hz)", "\u00a0", " ".join(sentences))


def _leaders(texts: Mapping[str, str], values: Mapping[str, float]) -> tuple[str, str]:
    """Return the text of the least value, and the names of all designs that show the same."""
    text = texts[min(values, key=lambda name: values[name])]
    return text, listing_text([name for name, other in texts.items() if other == text])


def _certificate_sentence(report: DesignReport) -> str:
    """Say which designs are unstable, and whether all certificates hold."""
    unstable = listing_text([one.name for one in report.assessments if not one.stable])
    failed = listing_text([one.name for one in report.assessments if not one.certified])
    checks = sum(len(one.checks) for one in report.assessments)
    parts = [f"UNSTABLE in this loop: {unstable}"] if unstable else []
    if failed:
        parts.append(f"certificates that do NOT hold: {failed}")
    elif unstable:  # a proof about another loop must not be taken for one about this loop
        about = "they are about the loops that the designs were made for, not about this one"
        parts.append(f"all {checks} checks of the certificates passed, but {about}")
    else:
        parts.append(f"all {checks} checks of the certificates were recomputed and passed")
    sentence = "; ".join(parts)
    return f"{sentence[0].upper()}{sentence[1:]}."


_DESIGN = ("method", "route", "n_states", "multiplications", "gamma", "estimation_rms", "certified")
_LOOP = (
    *("stable", "spectral_radius", "residual_nm", "turbulence_nm", "vibration_nm", "noise_nm"),
    *("within_nm", "strehl", "strehl_simulated"),
)
_GOOD = "within 10 % of its best Strehl ratio [Hz]"
_MOVING = "proved while the gain moves at any speed"
_MARGINS = (
    *("modulus", "gain margin, factors", "phase_deg", "delay_frames", "crossover_hz"),
    *("stable real sensor gains", _MOVING),
)


def summary_table(report: DesignReport) -> Table:
    """All designs side by side: their numbers, words and intervals, in groups."""
    limits = report.limits
    titles = _limit_title("above_limit_percent", limits.limit, ", frequency known")
    band = _limit_title("above_band_limit_percent", limits.band, " for this range")
    over = ("worst_nm", "worst_strehl", _GOOD, *band) if report.errors_hz.size > 1 else ()
    ends = f"{report.errors_hz[0]:.4g} to {report.errors_hz[-1]:.4g} Hz"
    groups: dict[str, Sequence[str]] = {
        "Design": _DESIGN,
        "In the loop of the configuration": _LOOP,
        "Distance to the limit of any linear controller": tuple(titles),
        f"Over frequency errors of {ends}": over,
        "Margins at the real sensor gain": _MARGINS,
    }
    titles |= band
    designs = []
    for one in report.assessments:
        row = design_facts(one)
        for each in columns(row):
            title = f"{each.help} [{each.shown_unit}]" if each.unit else each.help
            titles.setdefault(each.name, title)
        numbers: dict[str, str | Cell] = {each.name: each.text(row) for each in columns(row)}
        designs.append(numbers | _word_cells(one, report.config.sensor_gain))
    lines: list[tuple[str | Cell, ...]] = []
    for group, names in groups.items():
        lines += [(group,)] if names else []
        lines += [(titles.get(n, n), *(cells[n] for cells in designs)) for n in names]
    return Table(
        caption=f"Summary at a real sensor gain of {report.real_gain:.4g}; "
        f"{report.config.imaging.label}",
        headings=("quantity", *report.names),
        rows=tuple(lines),
    )


def _limit_title(name: str, limit: ResidualLimit | BandLimit | None, where: str) -> dict[str, str]:
    """Return the title of percents above a limit, or none where the limit says nothing."""
    if limit is None or not limit.rms_nm > 0:
        return {}
    return {name: f"above the limit of {nm_text(limit.rms_nm, '.1f')}{where} [%]"}


def _word_cells(one: DesignAssessment, sensor_gain: float) -> dict[str, str | Cell]:
    """Return the cells of a design that are not a number of it: words and intervals."""
    margins, moving, good = one.margins, one.moving, good_range(one)
    certified = Cell(text=f"passed, {count_text(len(one.checks), 'check')}", tone="good")
    if not one.certified:
        failed = sum(not check.passed for check in one.checks)
        text = "NOT COMPUTED" if one.certificate_error else f"FAILED, {failed} of {len(one.checks)}"
        certified = Cell(text=text, tone="bad")
    cells: dict[str, str | Cell] = {
        "certified": certified,
        "stable": Cell(text="stable", tone="good")
        if one.stable
        else Cell(text="UNSTABLE", tone="bad"),
    }
    if one.run_strehls.size > 1:
        mean, scatter = 100 * np.mean(one.run_strehls), 100 * np.std(one.run_strehls, ddof=1)
        cells["strehl_simulated"] = f"{mean:.2f} ± {scatter:.2f}"
    gains = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in one.sensor_gains)
    cells["stable real sensor gains"] = gains or Cell(text="none found", tone="bad")
    cells[_GOOD] = "-" if good is None else f"{good[0]:+.4g} to {good[1]:+.4g}"
    low, high = (np.nan, np.nan) if margins is None else (margins.gain_low, margins.gain_high)
    cells["gain margin, factors"] = "-" if np.isnan(low) else f"{low:.3g} to {high:.3g}"
    low, high = (np.nan, np.nan) if moving is None else (moving.moving_low, moving.moving_high)
    low, high = sensor_gain * low, sensor_gain * high  # real ones, as those above it
    cells[_MOVING] = "-" if np.isnan(low) else f"{low:.4g} to {high:.4g}"
    return cells
