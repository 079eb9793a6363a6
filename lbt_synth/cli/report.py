"""The command report: designs side by side, on a page."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict
from typing import Any

from lbt_synth.cli.certificate_table import check_records
from lbt_synth.cli.loop_inputs import load_designs
from lbt_synth.cli.output import Report, format_fixed, tabulate
from lbt_synth.cli.progress import count_progress
from lbt_synth.config import load_config
from lbt_synth.errors import ProblemError
from lbt_synth.report import DesignAssessment, DesignReport, design_report, write_report
from lbt_synth.report.designs.report import count_steps
from lbt_synth.report.designs.verdict import good_range, verdict
from lbt_synth.report.page.page_files import require_page_names
from lbt_synth.report.provenance import require_letters, time_text
from lbt_synth.studies import LimitRow


def run(arguments: Namespace) -> Report:
    """Assess designs in the loop of a configuration, and write the page."""
    inputs = (arguments.config, *arguments.gains)
    require_page_names(arguments.output, arguments.pdf, inputs=inputs)
    if arguments.title is not None and not arguments.title.strip():
        raise ProblemError("--title must hold at least one letter; got an empty text.")
    require_letters(arguments.title or "", "--title")
    config = load_config(arguments.config)
    designs = load_designs(arguments.gains)
    files = dict(zip(designs, arguments.gains, strict=True))
    total = count_steps(len(designs)) + 1
    with count_progress(total=total, what="report", quiet=arguments.json) as count:
        found = design_report(config, designs, gain_files=files, advance=count)
        written = write_report(found, arguments.output, pdf=arguments.pdf, title=arguments.title)
        count(1)
    return Report(
        data={
            "designs": {one.name: _design_record(found, one, row) for one, row in found.rows},
            "verdict": verdict(found),
            "limit_nm": None if found.limits.limit is None else found.limits.limit.rms_nm,
            "sensor_gain": found.real_gain,
            "sha256": {file.name: file.sha256 for file in found.files},
            "made": time_text(found.made),
            "files": [str(path) for path in written],
        },
        tables=[
            tabulate(
                f"Designs in the loop of {config.source.name}",
                found.assessments,
                ("design", lambda one: one.name),
                ("method", lambda one: one.design.method),
                ("stable", lambda one: one.stable),
                ("certified", lambda one: one.certified),
                ("residual [nm]", lambda one: format_fixed(one.residual_nm, 2)),
                ("Strehl [%]", lambda one: format_fixed(100 * one.strehl, 2)),
                ("worst Strehl [%]", lambda one: format_fixed(100 * _worst_strehl(one), 2)),
                (
                    "modulus margin",
                    lambda one: (
                        None if one.margins is None else format_fixed(one.margins.modulus, 3)
                    ),
                ),
            )
        ],
        notes=[
            verdict(found).replace("\u00a0", " "),
            *(f"note: {one.name}: {note}" for one in found.assessments for note in one.notes),
            *(f"written: {path}" for path in written),
        ],
    )


def _design_record(found: DesignReport, one: DesignAssessment, row: LimitRow) -> dict[str, Any]:
    """Return the summary of one design for JSON."""
    budget, good = one.budget, good_range(one)
    simulation = found.simulations.get(one.name)
    return {
        "method": one.design.method,
        "route": one.design.solver.route,
        "n_states": one.design.controller.n_states,
        "gamma": one.gamma,
        "estimation_rms": one.estimation_rms,
        "stable": one.stable,
        "spectral_radius": one.spectral_radius,
        "certified": one.certified,
        "checks": check_records(one.checks),
        "residual_nm": one.residual_nm,
        "turbulence_nm": None if budget is None else budget.turbulence_nm,
        "vibration_nm": None if budget is None else budget.vibration_nm,
        "noise_nm": None if budget is None else budget.noise_nm,
        "strehl": one.strehl,
        "strehl_simulated": None if simulation is None else simulation.strehl,
        "worst_strehl": _worst_strehl(one),
        "good_errors_hz": None if good is None else [good.low_hz, good.high_hz],
        "above_limit_percent": row.above_limit_percent,
        "worst_nm": row.worst_nm,
        "above_band_limit_percent": row.above_band_limit_percent,
        "margins": None if one.margins is None else asdict(one.margins),
        "stable_sensor_gains": one.sensor_gains,
        "multiplications": one.cost.multiplications,
    }


def _worst_strehl(one: DesignAssessment) -> float:
    return float(one.curve.strehl.min()) if one.stable else float("nan")
