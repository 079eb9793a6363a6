"""Designs side by side in the loop of a configuration: their numbers, verdict, and page."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lbt_synth.config import Config
from lbt_synth.design import Check, Design
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.interop.c.export import frame_cost
from lbt_synth.loop import ClosedLoop, loop_margins, residual_budget, stable_sensor_gains
from lbt_synth.loop.band_limit import BandLimit
from lbt_synth.loop.budget import ResidualBudget
from lbt_synth.loop.least_residual import ResidualLimit
from lbt_synth.loop.margins import LoopMargins
from lbt_synth.models import LoopHardware
from lbt_synth.models.loop_hardware import loop_differences
from lbt_synth.report.figures.loops import draw_bode, draw_sigma, draw_steps, sigma_curves
from lbt_synth.report.figures.studies import limits_figure, robustness_map_figure
from lbt_synth.report.page.html import (
    Block,
    Notice,
    Page,
    chart,
    new_page,
    paragraph,
    survival_blocks,
    words,
)
from lbt_synth.report.screen import say_residual
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts, columns, fact, facts, row_table
from lbt_synth.storage.tables import Table
from lbt_synth.storage.words import count_text, listing_text
from lbt_synth.studies import robustness_map
from lbt_synth.studies.limits import LimitStudy, compare_in_truth
from lbt_synth.studies.robustness import RobustnessMap
from lbt_synth.validation import FloatArray, frozen_copy, require_instance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DesignAssessment:
    """What is known exactly of one design in the loop of a configuration."""

    design: Design
    loop: ClosedLoop  # with the real sensor gain
    limits: Facts  # name, residual, Strehl ratio, and how far they are from the limits
    # None where the loop is unstable: the exact residual, and, None for several sensors, too, the
    # margins at the real sensor gain
    budget: ResidualBudget | None
    margins: LoopMargins | None
    # interval of real sensor gains with a stable loop, relative to the sensor matrix of the
    # configuration, around the real one, the assumed one, or one of the map; nan for none
    sensor_gains: tuple[float, float]
    checks: tuple[Check, ...]  # the certificate, recomputed
    certificate_error: str  # why it could not be; empty if it could
    # Strehl ratio over the frequency error and the real sensor gain; None for several sensors
    map: RobustnessMap | None
    worst_strehl: float  # over the frequency errors at the real sensor gain; nan if unknown

    @property
    def name(self) -> str:
        """Its name in the report."""
        return str(self.limits.design)

    @property
    def stable(self) -> bool:
        """Whether the loop is stable at the real sensor gain."""
        return self.loop.is_stable

    @property
    def alone(self) -> bool:
        """Whether it reads the loop's own sensor alone, and has transfer functions."""
        return not self.loop.reads_others

    @property
    def certified(self) -> bool:
        """Whether the certificate could be recomputed, and every check passed."""
        return not self.certificate_error and all(check.passed for check in self.checks)


def assess_design(
    design: Design, limits: Facts, config: Config, errors_hz: FloatArray
) -> DesignAssessment:
    """Assess a design in the loop of a configuration, over frequency errors (e,)."""
    hardware, truth = config.hardware, config.truth
    loop = design.close(hardware, sensor_gain=truth.sensor_gain)
    real_gain = config.sensor_gain * truth.sensor_gain
    gains = np.unique([*config.settings.robustness.sensor_gains, real_gain])
    checks: tuple[Check, ...] = ()
    complaint, image, worst_strehl = "", None, np.nan
    try:
        checks = design.recertify().checks
    except (LbtSynthError, ArithmeticError) as error:
        complaint = str(error)
    starts = [loop.sensor_gain, 1.0]
    if not loop.reads_others:
        over: dict[str, Any] = {"errors_hz": errors_hz, "sensor_gains": gains / config.sensor_gain}
        image = robustness_map(design, truth, config.imaging, hardware=hardware, **over)
        starts += image.sensor_gains[image.stable[0]].tolist()
        image = replace(image, sensor_gains=frozen_copy(gains))  # the real ones again
        worst_strehl = float(image.strehl[0, int(np.searchsorted(gains, real_gain))].min())
    intervals = (stable_sensor_gains(hardware, design.controller, nominal=g) for g in starts)
    low, high = next((ends for ends in intervals if not np.isnan(ends[0])), (np.nan, np.nan))
    return DesignAssessment(
        design=design,
        loop=loop,
        limits=limits,
        budget=residual_budget(loop, truth) if loop.is_stable else None,
        margins=loop_margins(loop) if loop.is_stable and not loop.reads_others else None,
        sensor_gains=(low * config.sensor_gain, high * config.sensor_gain),
        checks=checks,
        certificate_error=complaint,
        map=image,
        worst_strehl=worst_strehl,
    )


def require_compatible(name: str, design: Design, hardware: LoopHardware) -> None:
    """Refuse a design that cannot be run in a loop."""
    made_for = design.hardware
    if made_for is None:
        raise ProblemError(
            f"{name} is a filter of a bare estimation problem; expected a design for a loop. "
            "Design it for the plant of a configuration."
        )
    for what, mine, theirs in (
        ("axes", made_for.modes, hardware.modes),
        ("measurements", made_for.n_measurements, hardware.n_measurements),
        ("commands", made_for.n_commands, hardware.n_commands),
    ):
        if mine != theirs:
            raise ProblemError(
                f"{name} must be for the configuration's {theirs} {what}; got a design for {mine}. "
                "Design it for this configuration."
            )
    if not np.isclose(made_for.frame_rate_hz, hardware.frame_rate_hz, rtol=1e-9):
        raise ProblemError(
            f"{name} must run at the configuration's {hardware.frame_rate_hz:g} Hz; got a design "
            f"for {made_for.frame_rate_hz:g} Hz. Design it for this frame rate."
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DesignReport:
    """Designs in the loop of a configuration: what is known of each, beside the limits."""

    config: Config  # the configuration
    assessments: tuple[DesignAssessment, ...]  # one per design, exact
    # the designs beside reference designs and limits, over the frequency error, and what they were
    # not made for
    limits: LimitStudy
    # (e,): frequency errors, truth less design [Hz]; only 0 where the truth has no vibration
    errors_hz: FloatArray

    @property
    def names(self) -> list[str]:
        """Names of the designs."""
        return [one.name for one in self.assessments]

    @property
    def stable(self) -> tuple[DesignAssessment, ...]:
        """The designs whose loop is stable."""
        return tuple(one for one in self.assessments if one.stable)

    @property
    def real_gain(self) -> float:
        """Real sensor gain, relative to the sensor matrix of the configuration."""
        return self.config.sensor_gain * self.config.truth.sensor_gain


def design_report(config: Config, designs: Mapping[str, Design]) -> DesignReport:
    """Examine designs in the loop of a configuration; ProblemError for one that does not fit."""
    require_instance(config, Config)
    if not designs:
        raise ProblemError("a report needs at least one design; got none.")
    for name, design in designs.items():
        require_instance(design, Design)
        require_compatible(name, design, config.hardware)
    errors = frequency_errors(config)
    study = compare_in_truth(designs, config, errors_hz=list(errors))
    return DesignReport(
        config=config,
        assessments=tuple(
            assess_design(design, row, config, errors)
            for design, row in zip(designs.values(), study.rows, strict=False)
        ),
        limits=study,
        errors_hz=errors,
    )


def frequency_errors(config: Config) -> FloatArray:
    """Frequency errors of the configuration and 0, with three more between any two.

    Errors that would move a true vibration to 0 or to the Nyquist frequency are left out.
    Without vibrations there is only 0.
    """
    lines = config.truth.lines_hz
    if not lines:
        return frozen_copy([0.0])
    fine = refine_values([*config.errors_hz, 0.0])
    shifts = [config.truth.frequency_shift_hz(line, 1.0) for line in lines]
    places = np.array(lines) + fine[:, None] * shifts
    nyquist_hz = config.hardware.frame_rate_hz / 2
    return frozen_copy(fine[np.all((places > 0) & (places < nyquist_hz), axis=1)])


def refine_values(values: Sequence[float]) -> FloatArray:
    """Sort values, and add three between any two of them."""
    ordered = np.unique(values)
    places = np.arange(4 * ordered.size - 3) / 4
    return np.asarray(np.interp(places, np.arange(ordered.size), ordered))


WORDS = ("origin", "certificate", "loop", "gain_margin", "stable_gains")  # facts that are texts


def design_facts(report: DesignReport, one: DesignAssessment) -> Facts:
    """Return the numbers of a design, and those of ``WORDS``, which are texts.

    How each is called and printed is in the words of pages; the page prints what has a help.
    """
    design, row, margins = one.design, one.limits, one.margins
    limits, budget = report.limits, one.budget
    factors = None if margins is None else (margins.gain_low, margins.gain_high)
    values = {
        "design": one.name,
        "method": design.method,
        "stable": one.stable,
        "certified": one.certified,
        "route": design.solver.route,
        "origin": f"{design.method}, {design.solver.route}",
        "n_states": design.controller.n_states,
        "multiplications": frame_cost(design).multiplications if one.alone else None,
        "gamma": design.gamma,
        "estimation_rms": design.rms,
        "certificate": _certificate_word(one),
        "loop": "stable" if one.stable else "UNSTABLE",
        "spectral_radius": one.loop.radius_per_frame,
        "residual_nm": row.residual_nm,
        "strehl": row.strehl,
        "above_limit_percent": _known(limits.limit) and row.above_limit_percent,
        "worst_nm": row.worst_nm if report.errors_hz.size > 1 else None,
        "worst_strehl": one.worst_strehl,
        "above_band_limit_percent": _known(limits.band) and row.above_band_limit_percent,
        "gain_margin": _interval(factors, ".3g"),
        "stable_gains": _interval(one.sensor_gains),
    }
    for name in ("turbulence_nm", "vibration_nm", "noise_nm", "within_nm"):
        values[name] = getattr(budget, name, None)
    for name in ("modulus", "phase_deg", "delay_frames", "crossover_hz"):
        values[name] = getattr(margins, name, None)
    bounds = {"limit": _known(limits.limit), "band": _known(limits.band)}
    return facts(
        **{
            name: fact(values[name], **{**how, "help": how.get("help", "").format(**bounds)})
            for name, how in words("facts").items()
        }
    )


def _known(limit: ResidualLimit | BandLimit | None) -> str | None:
    """Return a limit as a text; None where there is none, or one of 0, above which all is."""
    return None if limit is None or not limit.rms_nm > 0 else nm_text(limit.rms_nm, ".1f")


def _interval(ends: tuple[float, float] | None, spec: str = ".4g") -> str:
    """Return an interval as a text; a dash where there is none."""
    return "-" if ends is None or np.isnan(ends[0]) else f"{ends[0]:{spec}} to {ends[1]:{spec}}"


def _certificate_word(one: DesignAssessment) -> str:
    if one.certificate_error:
        return "NOT COMPUTED"
    failed = sum(not check.passed for check in one.checks)
    count = count_text(len(one.checks), "check")
    return f"FAILED, {failed} of {count}" if failed else f"passed, {count}"


def verdict(report: DesignReport) -> str:
    """Return three sentences at most: which design leaves least, which is robust, the proofs."""
    sentences = []
    if report.stable:
        best = min((one.limits for one in report.stable), key=lambda row: row.residual_nm)
        sentences.append(say_residual(best.design, best, report.limits.limit))
    alone = [one for one in report.stable if one.alone]
    if alone and report.errors_hz.size > 1:
        tough = max(alone, key=lambda one: one.worst_strehl)
        first, last = report.errors_hz[[0, -1]]
        sentences.append(
            f"{tough.name} keeps the highest Strehl ratio at worst, {100 * tough.worst_strehl:.1f} "
            f"%, if the vibrations are elsewhere by {first:+.4g} to {last:+.4g} Hz."
        )
    sentences.append(_certificate_sentence(report))
    # a number stays in one line with its unit
    return re.sub(r"(?<=\d) (?=%|nm|um|mas|urad|Hz)", "\u00a0", " ".join(sentences))


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


def summary_table(report: DesignReport) -> Table:
    """All designs side by side, in groups; a line that no design has a value for is left out."""
    rows = [design_facts(report, one) for one in report.assessments]
    ends = f"{report.errors_hz[0]:.4g} to {report.errors_hz[-1]:.4g} Hz"
    lines: list[tuple[str, ...]] = []
    group = ""
    for how in columns(rows[0]):
        group = words("groups").get(how.name, group).format(ends=ends)
        cells = tuple(how.text(row) for row in rows)
        if how.help and set(cells) != {"-"}:
            title = f"{how.help} [{how.shown_unit}]" if how.unit else how.help
            lines += [(group,)] * ((group,) not in lines) + [(title, *cells)]
    caption = f"Summary at a real sensor gain of {report.real_gain:.4g}"
    return Table(
        caption=f"{caption}; {report.config.imaging.label}",
        headings=("quantity", *report.names),
        rows=tuple(lines),
    )


def design_page(
    config: Config,
    designs: Mapping[str, Design],
    *,
    gain_files: Mapping[str, str | os.PathLike[str]] | None = None,
    title: str | None = None,
) -> Page:
    """Examine designs in the loop of a configuration, and return their page.

    Each controller is closed with the configuration's loop as it is, whatever it was designed
    for. Certificates are recomputed. :func:`write_page` writes the page.

    Parameters
    ----------
    config : Config
        The configuration.
    designs : mapping of str to Design
        Designs by name.
    gain_files : mapping of str to path-like, optional
        Files that designs came from, whose digests the page gives.
    title : str, optional
        Heading of the page; by default it names the configuration.

    Returns
    -------
    Page
        The page.

    Raises
    ------
    ProblemError
        If there is no design, one does not fit the loop, a true vibration drifts, or the title is
        empty.
    FileError
        If the configuration or a gain file cannot be read again.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> slow = lbt.integrator(config.hardware, truth=config.truth)
    >>> lbt.report.design_page(config, {"slow": slow}, title="Tonight").title
    'Tonight'
    """
    return report_page(design_report(config, designs), gain_files or {}, title)


def report_page(
    report: DesignReport,
    gain_files: Mapping[str, str | os.PathLike[str]],
    title: str | None = None,
) -> Page:
    """Return the page of a report; :func:`design_page` says more."""
    source = report.config.source
    heading = f"Controllers for {source.name}" if title is None else title.strip()
    if not heading:
        raise ProblemError("title must hold at least one letter; got an empty text.")
    several = {one.name: one.design.tables()[0] for one in report.assessments if not one.alone}
    failures = [row_table(f"{name}: {table.title}", table.rows) for name, table in several.items()]
    return new_page(
        heading,
        f"{count_text(len(report.assessments), 'design')}: {listing_text(report.names)}",
        {
            "Summary": _summary_blocks(report),
            "When sensors fail": failures,
            "Transfer functions": _transfer_blocks(report),
            "Robustness": _robustness_blocks(report),
            "Certificates": _certificate_blocks(report),
        },
        sources=[
            (source, "configuration"),
            *((path, f"gain file of {name}") for name, path in gain_files.items()),
        ],
    )


def _summary_blocks(report: DesignReport) -> list[Block]:
    """Open with what is wrong, the verdict, and the tables of all designs and of the loop."""
    config, limits = report.config, report.limits
    blocks: list[Block] = []
    for one in report.assessments:
        if not one.stable:
            radius, gain = f"{one.loop.spectral_radius:.6g}", f"{report.real_gain:.4g}"
            text = paragraph("unstable", name=one.name, radius=radius, gain=gain)
            blocks.append(Notice(text=text, tone="bad"))
        if not one.certified:
            why = one.certificate_error or "; ".join(
                f"{check.name} {check.value:.6g}, limit {check.limit:.6g}"
                for check in one.checks
                if not check.passed
            )
            blocks.append(Notice(text=f"The certificate of {one.name} fails: {why}", tone="bad"))
    hidden = ("worst_nm", "above_band_limit_percent", "method", "stable")
    caption = f"In the truth of {config.source.name}; {config.imaging.label}"
    blocks += [
        verdict(report),
        *survival_blocks({one.name: one.margins for one in report.assessments if one.margins}),
        summary_table(report),
        row_table(caption, limits.rows, without=hidden),
    ]
    if limits.limit is not None and any(not one.alone for one in report.assessments):
        least = nm_text(limits.limit.rms_nm, ".1f", unit="nm rms")
        blocks.append(f"No controller of the loop's own sensor alone leaves less than {least}.")
    # an unstable loop is named above
    notes = [f"{one.name}: {t}." for one in report.stable for t in limits.warnings[one.name]]
    notes += limits.notes
    for one in report.assessments:
        if one.design.hardware is not None:
            differences = loop_differences(one.design.hardware, config.hardware)
            notes += [f"{one.name} was {text}" for text in differences]
    return [*blocks, *(Notice(text=note) for note in notes)]


def _transfer_blocks(report: DesignReport) -> list[Block]:
    """Return singular values of the error and of the loops, their margins, and their steps."""
    lines_hz, gain = report.config.truth.lines_hz, f"{report.real_gain:.4g}"
    alone = [one for one in report.assessments if one.alone]
    designs = {one.name: one.design for one in alone}
    loops = {one.name: one.loop for one in alone}
    curves = sigma_curves(designs, loops, lines_hz=lines_hz)
    blocks: list[Block] = []
    if alone and not any(one.stable for one in alone):
        loops = {}
        blocks.append("No loop is stable, so none has a rejection or a noise transfer.")
    if loops or any(error is not None for _, error, *_ in curves.values()):
        blocks.append(chart("sigma", draw_sigma(curves, loops, lines_hz), gain=gain))
    if loops:
        frame = f"{1e3 / report.config.hardware.frame_rate_hz:.4g}"
        blocks.append(chart("bode", draw_bode(loops), gain=gain))
        blocks.append(chart("step", draw_steps(loops), frame=frame))
    return blocks


def _robustness_blocks(report: DesignReport) -> list[Block]:
    """Return the residual over the frequency error, and maps with the sensor gain."""
    if report.errors_hz.size == 1:
        return []
    blocks: list[Block] = []
    if report.stable:
        blocks.append(chart("limits", limits_figure(report.limits, over_errors=True)))
    if maps := {one.name: one.map for one in report.assessments if one.map is not None}:
        figure = robustness_map_figure(maps, real_gain=report.real_gain)
        blocks.append(chart("map", figure))
    return blocks


def _certificate_blocks(report: DesignReport) -> list[Block]:
    blocks: list[Block] = [paragraph("certificates")]
    for one in report.assessments:
        missing = f"{one.name}: not computed: {one.certificate_error}"
        blocks.append(
            Notice(text=missing, tone="bad")
            if one.certificate_error
            else row_table(f"Certificate of {one.name}", one.checks)
        )
    return blocks
