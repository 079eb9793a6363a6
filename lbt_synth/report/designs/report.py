"""Designs side by side in the loop of a configuration: their numbers, verdict and tables."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth import studies
from lbt_synth.config import Config
from lbt_synth.design import Check, Design
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.interop import frame_cost
from lbt_synth.interop.c.export import FrameCost
from lbt_synth.linear import Controller
from lbt_synth.loop import (
    ClosedLoop,
    LoopMargins,
    ResidualBudget,
    Simulation,
    close_loop,
    loop_margins,
    moving_gain,
    residual_budget,
    simulate,
    stable_sensor_gains,
    strehl,
)
from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.loop.least_residuals.band_limit import BandLimit
from lbt_synth.loop.least_residuals.residual_limit import ResidualLimit
from lbt_synth.loop.simulation.run import settling_frames
from lbt_synth.loop.stable_range import MovingGain, radii_by_gain
from lbt_synth.models import LoopHardware
from lbt_synth.models.loop_hardware import loop_differences
from lbt_synth.report.page.html import (
    Source,
    creation_time,
    program_versions,
    read_source,
    require_letters,
)
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts, columns, fact, facts
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.storage.words import count_text, listing_text
from lbt_synth.studies import LimitRow, RobustnessMap, robustness_map
from lbt_synth.studies.limits import LimitStudy, TruthComparison, compare_in_truth
from lbt_synth.validation import FloatArray, frozen_copy, require_instance

_CONVEX_ROUTES = ("sdp", "lmi")
_MOST_FRAMES = 8192  # of a run
_MOST_DESIGNS = 36  # more lines cannot be distinguished
_GAINS = np.geomspace(0.01, 100.0, 400)  # where stable intervals are looked for


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DesignAssessment:
    """What is known exactly of one design in the loop of a configuration."""

    name: str  # its name in the report
    design: Design
    loop: ClosedLoop  # with the real sensor gain
    notes: tuple[str, ...]  # how the loop that it was made for differs from this one
    # None where the loop is unstable: the exact residual, the margins at the real sensor gain, and
    # the intervals around it of a gain that moves
    budget: ResidualBudget | None
    margins: LoopMargins | None
    moving: MovingGain | None
    strehl: float  # Strehl ratio in [0, 1]; nan where the loop is unstable
    # intervals of real sensor gains for which the loop is stable, relative to the sensor matrix of
    # the configuration; searched for between 0.01 and 100 times the assumed one
    sensor_gains: tuple[tuple[float, float], ...]
    checks: tuple[Check, ...]  # the certificate, recomputed
    certificate_error: str  # why it could not be; empty if it could
    cost: FrameCost  # arithmetic of one frame, as exported to C
    curve: RobustnessMap  # Strehl ratio over the frequency error at the real sensor gain
    map: RobustnessMap  # the same over frequency error and real sensor gain
    limits: LimitRow  # its distance to what no linear controller goes below
    run: Simulation | None  # in the simulated loop; None where it is unstable
    run_strehls: FloatArray  # (cases,): Strehl ratios of the run

    @property
    def stable(self) -> bool:
        """Whether the loop is stable at the real sensor gain."""
        return self.loop.is_stable

    @property
    def certified(self) -> bool:
        """Whether the certificate could be recomputed, and every check passed."""
        return not self.certificate_error and all(check.passed for check in self.checks)

    @property
    def residual_nm(self) -> float:
        """Exact residual [nm rms]; nan where the loop is unstable."""
        return float("nan") if self.budget is None else self.budget.rms_nm


def assess_design(
    design: Design,
    loop: ClosedLoop,
    limits: LimitRow,
    config: Config,
    errors_hz: FloatArray,
    settle_frames: int,
) -> DesignAssessment:
    """Assess a design in the loop of a configuration, over frequency errors (e,)."""
    hardware, truth, assumed_gain = config.hardware, config.truth, config.sensor_gain
    sensor_gains = np.unique(config.settings.robustness.sensor_gains)
    stable, settings = loop.is_stable, config.settings.simulation
    budget = residual_budget(loop, truth) if stable else None
    margins = loop_margins(loop) if stable else None
    checks, complaint = _recertify(design)
    mapped = partial(robustness_map, design, truth, config.imaging, hardware=hardware)
    curve, grid = (
        mapped(errors_hz=errors_hz, sensor_gains=gains)
        for gains in ([truth.sensor_gain], sensor_gains / assumed_gain)
    )
    intervals = stable_intervals(loop, design.controller, margins)
    run = None
    if stable:
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
        moving=moving_gain(loop) if stable else None,
        strehl=float("nan") if budget is None else strehl(budget, config.imaging),
        sensor_gains=tuple((low * assumed_gain, high * assumed_gain) for low, high in intervals),
        checks=checks,
        certificate_error=complaint,
        cost=frame_cost(design),
        curve=curve,
        map=replace(grid, sensor_gains=frozen_copy(sensor_gains)),  # the real ones again
        limits=limits,
        run=run,
        run_strehls=np.zeros(0) if run is None else run.strehl(config.imaging),
    )


def require_compatible(name: str, design: Design, hardware: LoopHardware) -> None:
    """Refuse a design that cannot be run in a loop."""
    own = design.hardware
    if own is None:
        raise ProblemError(
            f"{name} is a filter of a bare estimation problem; expected a design for a loop. "
            "Design it for the plant of a configuration."
        )
    for what, mine, theirs in (
        ("axes", own.modes, hardware.modes),
        ("measurements", own.n_measurements, hardware.n_measurements),
        ("commands", own.n_commands, hardware.n_commands),
    ):
        if mine != theirs:
            raise ProblemError(
                f"{name} must be for the configuration's {theirs} {what}; got a design for {mine}. "
                "Design it for this configuration."
            )
    if not np.isclose(own.frame_rate_hz, hardware.frame_rate_hz, rtol=1e-9):
        raise ProblemError(
            f"{name} must run at the configuration's {hardware.frame_rate_hz:g} Hz; got a design "
            f"for {own.frame_rate_hz:g} Hz. Design it for this frame rate."
        )


def stable_intervals(
    loop: ClosedLoop, controller: Controller, margins: LoopMargins | None
) -> list[tuple[float, float]]:
    """Intervals of sensor gains for which a loop is stable, in increasing order.

    The interval around the loop's own gain comes from its margins; others are looked for at 400
    gains from 0.01 to 100.
    """
    found = []
    if margins is not None:
        found.append((margins.gain_low * loop.sensor_gain, margins.gain_high * loop.sensor_gain))
    radii = radii_by_gain(loop.hardware, controller)(_GAINS)
    inside = np.nonzero(radii < 1 - STABILITY_MARGIN)[0]
    for run in np.split(inside, np.nonzero(np.diff(inside) > 1)[0] + 1):
        if not run.size:
            continue
        nominal = float(_GAINS[run[np.argmin(radii[run])]])
        if not any(low < nominal < high for low, high in found):
            found.append(stable_sensor_gains(loop.hardware, controller, nominal=nominal))
    return sorted(found)


def _recertify(design: Design) -> tuple[tuple[Check, ...], str]:
    """Return the checks of the recomputed certificate, or why that failed."""
    try:
        return design.recertify().checks, ""
    except (LbtSynthError, ArithmeticError) as error:
        return (), str(error)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DesignReport:
    """Designs in the loop of a configuration: what is known of each, beside the limits."""

    config: Config  # the configuration
    config_text: str  # its file as it was read
    assessments: tuple[DesignAssessment, ...]  # one per design, exact
    # residuals over the frequency error, and what no linear controller goes below
    limits: LimitStudy
    truth: TruthComparison  # the designs beside reference designs, and what they were not made for
    # (e,): frequency errors, truth less design [Hz]; only 0 where the truth has no vibration
    errors_hz: FloatArray
    files: tuple[Source, ...]  # digests of the files that were read
    versions: tuple[tuple[str, str], ...]  # programs and libraries
    made: datetime  # when

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
        Files that designs came from, whose digests the report gives.

    Returns
    -------
    DesignReport
        The numbers; :func:`design_page` makes a page of them.

    Raises
    ------
    ProblemError
        If there is no design, one does not fit the loop, a name cannot be shown, or a true
        vibration drifts.
    FileError
        If the configuration or a gain file cannot be read.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> slow = lbt.design.optimal_integrator(config.hardware, config.truth)
    >>> report = lbt.report.design_report(config, {"integrator": slow})
    >>> one = report.assessments[0]
    >>> one.certified, f"{one.residual_nm:.0f} nm, Strehl {one.strehl:.2f}"
    (True, '156 nm, Strehl 0.70')
    """
    require_instance(config, Config)
    if not 1 <= len(designs) <= _MOST_DESIGNS:
        raise ProblemError(f"a report needs 1 to {_MOST_DESIGNS} designs; got {len(designs)}.")
    for name, design in designs.items():
        require_instance(design, Design)
        require_letters(name, "name of a design")
        require_compatible(name, design, config.hardware)
    made = creation_time()
    source, content = read_source(config.source, "configuration")
    files = [source]
    for name, path in (gain_files or {}).items():
        files.append(read_source(Path(path), f"gain file of {name}")[0])
    truth, hardware, errors = config.truth, config.hardware, frequency_errors(config)
    study = studies.limits(designs, hardware, truth, config.imaging, errors_hz=list(errors))
    loops = [
        close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
        for design in designs.values()
    ]
    # all settle as the slowest, so that one seed is the same weather for all
    radii = [loop.spectral_radius for loop in loops if loop.is_stable]
    settle_frames = max(map(settling_frames, radii), default=0)
    solved = any(design.solver.route in _CONVEX_ROUTES for design in designs.values())
    return DesignReport(
        config=config,
        config_text=content.decode("utf-8-sig", errors="replace"),
        assessments=tuple(
            assess_design(design, loop, row, config, errors, settle_frames)
            for design, loop, row in zip(designs.values(), loops, study.rows, strict=True)
        ),
        limits=study,
        truth=compare_in_truth(designs, config),
        errors_hz=errors,
        files=tuple(files),
        versions=program_versions(("cvxpy", "clarabel") if solved else ()),
        made=made,
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
    known = np.unique(values)
    places = np.arange(4 * known.size - 3) / 4
    return np.asarray(np.interp(places, np.arange(known.size), known))


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
