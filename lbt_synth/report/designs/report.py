"""Designs side by side in the loop of a configuration: their numbers, verdict and tables."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import label

from lbt_synth.config import Config
from lbt_synth.design import Check, Design
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.interop.c.export import frame_cost
from lbt_synth.linear import Controller
from lbt_synth.loop import (
    ClosedLoop,
    loop_margins,
    residual_budget,
    simulate,
    stable_sensor_gains,
)
from lbt_synth.loop.band_limit import BandLimit
from lbt_synth.loop.budget import ResidualBudget
from lbt_synth.loop.least_residual import ResidualLimit
from lbt_synth.loop.margins import LoopMargins
from lbt_synth.loop.simulation import Simulation, settling_frames
from lbt_synth.loop.stable_range import MovingGain, moving_gain
from lbt_synth.models import LoopHardware
from lbt_synth.models.loop_hardware import loop_differences
from lbt_synth.report.page.html import words
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts, columns, fact, facts
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.storage.words import count_text, listing_text
from lbt_synth.studies import robustness_map
from lbt_synth.studies.limits import LimitRow, LimitStudy, compare_in_truth
from lbt_synth.studies.robustness import RobustnessMap
from lbt_synth.validation import FloatArray, frozen_copy, require_instance

_MOST_FRAMES = 8192  # of a run: its series and spectra need no more


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DesignAssessment:
    """What is known exactly of one design in the loop of a configuration."""

    name: str  # its name in the report
    design: Design
    loop: ClosedLoop  # with the real sensor gain
    notes: tuple[str, ...]  # how the loop that it was made for differs from this one
    # None where the loop is unstable: the exact residual, and a run in time; and, None for several
    # sensors, too, the margins at the real sensor gain, and the intervals around it of a gain that
    # moves
    budget: ResidualBudget | None
    run: Simulation | None
    margins: LoopMargins | None
    moving: MovingGain | None
    # interval of real sensor gains with a stable loop, relative to the sensor matrix of the
    # configuration, around the real one, the assumed one, or one of the map; nan for none
    sensor_gains: tuple[float, float]
    checks: tuple[Check, ...]  # the certificate, recomputed
    certificate_error: str  # why it could not be; empty if it could
    # Strehl ratio over the frequency error and the real sensor gain; None for several sensors
    map: RobustnessMap | None
    # (e,): Strehl ratio over the frequency error at the real sensor gain; nan where it is unknown
    strehls: FloatArray
    limits: LimitRow  # residual, Strehl ratio, and how far they are from the limits

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
    design: Design,
    loop: ClosedLoop,
    limits: LimitRow,
    config: Config,
    errors_hz: FloatArray,
    settle_frames: int,
) -> DesignAssessment:
    """Assess a design in the loop of a configuration, over frequency errors (e,)."""
    hardware, truth, settings = config.hardware, config.truth, config.settings.simulation
    real_gain = config.sensor_gain * truth.sensor_gain
    gains = np.unique([*config.settings.robustness.sensor_gains, real_gain])
    checks: tuple[Check, ...] = ()
    complaint, budget, margins, moving, run, image = "", None, None, None, None, None
    try:
        checks = design.recertify().checks
    except (LbtSynthError, ArithmeticError) as error:
        complaint = str(error)
    starts, strehls = [loop.sensor_gain, 1.0], np.full(errors_hz.size, np.nan)
    if not loop.reads_others:
        over: dict[str, Any] = {"errors_hz": errors_hz, "sensor_gains": gains / config.sensor_gain}
        image = robustness_map(design, truth, config.imaging, hardware=hardware, **over)
        starts += image.sensor_gains[image.stable[0]].tolist()
        image = replace(image, sensor_gains=frozen_copy(gains))  # the real ones again
        strehls = image.strehl[0, int(np.searchsorted(gains, real_gain))]
    low, high = stable_interval(hardware, design.controller, starts)
    if loop.is_stable:
        budget = residual_budget(loop, truth)
        if not loop.reads_others:
            margins, moving = loop_margins(loop), moving_gain(loop)
        run = simulate(
            design.controller,
            truth,
            hardware=hardware,
            frames=min(settings.frames, _MOST_FRAMES),
            cases=settings.cases,
            seed=settings.seed,
            settle_frames=max(settings.settle_frames, settle_frames),
        )
    return DesignAssessment(
        name=limits.design,
        design=design,
        loop=loop,
        notes=() if design.hardware is None else tuple(loop_differences(design.hardware, hardware)),
        budget=budget,
        margins=margins,
        moving=moving,
        run=run,
        sensor_gains=(low * config.sensor_gain, high * config.sensor_gain),
        checks=checks,
        certificate_error=complaint,
        map=image,
        strehls=strehls,
        limits=limits,
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


def stable_interval(
    hardware: LoopHardware, controller: Controller, starts: Iterable[float]
) -> tuple[float, float]:
    """Return the interval of stable sensor gains around the first stable one of some, or nan."""
    intervals = (stable_sensor_gains(hardware, controller, nominal=start) for start in starts)
    return next((ends for ends in intervals if not np.isnan(ends[0])), (np.nan, np.nan))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DesignReport:
    """Designs in the loop of a configuration: what is known of each, beside the limits."""

    config: Config  # the configuration
    gain_files: Mapping[str, str | os.PathLike[str]]  # that designs came from, by their names
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


def design_report(
    config: Config,
    designs: Mapping[str, Design],
    *,
    gain_files: Mapping[str, str | os.PathLike[str]] | None = None,
) -> DesignReport:
    """Examine designs in the loop of a configuration.

    Each controller is closed with the configuration's loop as it is, whatever it was designed
    for. Certificates are recomputed.

    Parameters
    ----------
    config : Config
        The configuration.
    designs : mapping of str to Design
        Designs by name.
    gain_files : mapping of str to path-like, optional
        Files that designs came from, whose digests the page gives.

    Returns
    -------
    DesignReport
        The numbers; :func:`design_page` makes a page of them.

    Raises
    ------
    ProblemError
        If there is no design, one does not fit the loop, or a true vibration drifts.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> slow = lbt.design.optimal_integrator(config.hardware, config.truth)
    >>> report = lbt.report.design_report(config, {"integrator": slow})
    >>> one = report.assessments[0]
    >>> one.certified, f"{one.limits.residual_nm:.0f} nm, Strehl {one.limits.strehl:.2f}"
    (True, '156 nm, Strehl 0.70')
    """
    require_instance(config, Config)
    if not designs:
        raise ProblemError("a report needs at least one design; got none.")
    for name, design in designs.items():
        require_instance(design, Design)
        require_compatible(name, design, config.hardware)
    truth, hardware, errors = config.truth, config.hardware, frequency_errors(config)
    study = compare_in_truth(designs, config, errors_hz=list(errors))
    loops = [design.close(hardware, sensor_gain=truth.sensor_gain) for design in designs.values()]
    # all settle as the slowest, so that one seed is the same weather for all
    radii = [loop.radius_per_frame for loop in loops if loop.is_stable]
    settle_frames = max(map(settling_frames, radii), default=0)
    return DesignReport(
        config=config,
        gain_files=dict(gain_files or {}),
        assessments=tuple(
            assess_design(design, loop, row, config, errors, settle_frames)
            for design, loop, row in zip(designs.values(), loops, study.rows, strict=False)
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


WORDS = (  # facts that are texts, made of several numbers
    "origin",
    "certificate",
    "loop",
    "good_errors",
    "gain_margin",
    "stable_gains",
    "moving_gains",
)
_TONES = {"passed": "good", "stable": "good", "FAILED": "bad", "NOT": "bad", "UNSTABLE": "bad"}


def design_facts(report: DesignReport, one: DesignAssessment) -> Facts:
    """Return the numbers of a design, and those of ``WORDS``, which are texts.

    How each is called and printed is in the words of pages; the page prints what has a help.
    """
    design, row, margins, moving = one.design, one.limits, one.margins, one.moving
    limits, gain = report.limits, report.config.sensor_gain
    strehls = np.zeros(0) if one.run is None else one.run.strehl(report.config.imaging)
    factors = None if margins is None else (margins.gain_low, margins.gain_high)
    moves = None if moving is None else (gain * moving.moving_low, gain * moving.moving_high)
    budget = one.budget
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
        "turbulence_nm": budget and budget.turbulence_nm,
        "vibration_nm": budget and budget.vibration_nm,
        "noise_nm": budget and budget.noise_nm,
        "within_nm": budget and budget.within_nm,
        "strehl": row.strehl,
        "strehl_simulated": float(np.mean(strehls)) if strehls.size else None,
        "scatter": 100 * float(np.std(strehls, ddof=1)) if strehls.size > 1 else None,
        "above_limit_percent": _known(limits.limit) and row.above_limit_percent,
        "worst_nm": row.worst_nm if report.errors_hz.size > 1 else None,
        "worst_strehl": float(one.strehls.min()),
        "good_errors": _interval(good_range(report, one), "+.4g"),
        "above_band_limit_percent": _known(limits.band) and row.above_band_limit_percent,
        "modulus": margins and margins.modulus,
        "phase_deg": margins and margins.phase_deg,
        "delay_frames": margins and margins.delay_frames,
        "crossover_hz": margins and margins.crossover_hz,
        "gain_margin": _interval(factors, ".3g"),
        "stable_gains": _interval(one.sensor_gains),
        "moving_gains": _interval(moves),
    }
    bounds = {"limit": _known(limits.limit), "band": _known(limits.band)}
    entries = {}
    for name, printing in words("facts").items():
        text = printing.get("help", "").format(**bounds)
        entries[name] = fact(values[name], **printing | {"help": text})
    return facts(**entries)


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


_KEPT = 0.9  # of its best Strehl ratio, within which a design counts as good


def good_range(report: DesignReport, one: DesignAssessment) -> tuple[float, float] | None:
    """Return between which frequency errors [Hz] a design keeps 90 % of its best Strehl ratio.

    None where it is unstable, reads several sensors, or where there is no range of errors.
    """
    if np.isnan(one.strehls).any() or report.errors_hz.size == 1:
        return None
    runs, _ = label(one.strehls >= _KEPT * np.max(one.strehls))
    good = report.errors_hz[runs == runs[np.argmax(one.strehls)]]
    return float(good[0]), float(good[-1])


def verdict(report: DesignReport) -> str:
    """Return at most three sentences: which design leaves least, which is robust, what is proved.

    Designs that show the same number as the best are as good. The table of the report has all.
    """
    sentences = []
    if report.stable:
        strehl = max(one.limits.strehl for one in report.stable)
        where = ", if the vibrations are where the configuration has them"
        least = _leaders(
            {one.name: one.limits.residual_nm for one in report.stable},
            lambda residual_nm: nm_text(residual_nm, ".1f", unit="nm rms"),
        )
        sentences.append(
            f"Least residual: {least} (Strehl ratio {100 * strehl:.1f} %)"
            f"{where if report.config.truth.vibrations else ''}."
        )
    worst = {o.name: -100 * float(np.min(o.strehls)) for o in report.stable if o.alone}
    if worst and report.errors_hz.size > 1:
        first, last = (f"{report.errors_hz[i]:+.4g}" for i in (0, -1))
        most = _leaders(worst, lambda percent: f"{-percent:.1f} %")
        sentences.append(
            f"Highest Strehl ratio at worst, if their frequencies are wrong by {first} to {last} "
            f"Hz{'' if all(o.alone for o in report.stable) else ', of one sensor'}: {most}."
        )
    sentences.append(_certificate_sentence(report))
    # a number stays in one line with its unit
    return re.sub(r"(?<=\d) (?=%|nm|um|mas|urad|Hz)", "\u00a0", " ".join(sentences))


def _leaders(values: Mapping[str, float], show: Callable[[float], str]) -> str:
    """Name the designs that show the same as the one of the least value, and say that."""
    least = show(min(values.values()))
    return f"{listing_text([n for n, value in values.items() if show(value) == least])}, {least}"


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
    lines: list[tuple[str | Cell, ...]] = []
    group = ""
    for how in columns(rows[0]):
        group = words("groups").get(how.name, group).format(ends=ends)
        texts = [how.text(row) for row in rows]
        if not how.help or set(texts) == {"-"}:
            continue
        title = f"{how.help} [{how.shown_unit}]" if how.unit else how.help
        lines += [] if (group,) in lines else [(group,)]
        lines.append((title, *map(_toned, texts)))
    return Table(
        caption=f"Summary at a real sensor gain of {report.real_gain:.4g}; "
        f"{report.config.imaging.label}",
        headings=("quantity", *report.names),
        rows=tuple(lines),
    )


def _toned(text: str) -> str | Cell:
    """Return a cell in the tone of its first word."""
    tone = _TONES.get(text.partition(",")[0].partition(" ")[0])
    return text if tone is None else Cell(text=text, tone=tone)
