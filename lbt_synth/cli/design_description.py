"""What the terminal says of a design: its facts, its loop, its certificate, and warnings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.cli.certificate_table import certificate_table, check_records
from lbt_synth.cli.output import Facts, Report, TableText, fact_table
from lbt_synth.design import (
    Design,
    EstimatorDesign,
    FilterDesign,
    IntegratorDesign,
    LqgDesign,
    PolytopicDesign,
    ShapedDesign,
)
from lbt_synth.design.model_limits import model_limit, shaped_limit
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.models import LoopHardware

Data: TypeAlias = dict[str, Any]

_SMALL_MODULUS = 0.3


def describe_design(design: Design) -> Report:
    """Describe a design: what it is, its loop, its certificate."""
    facts: Facts = [
        ("method", design.method, ""),
        ("route", f"{design.solver.route} ({design.solver.status})", ""),
        ("states of the controller", design.controller.n_states, ""),
    ]
    data: Data = {
        "method": design.method,
        "solver": asdict(design.solver),
        "n_states": design.controller.n_states,
        "poles": [complex(p) for p in design.poles],
        "controller_spectral_radius": design.controller.to_statespace().spectral_radius,
        "checks": check_records(design.certificate.checks),
    }
    for kind, describe in _DESCRIPTIONS:
        if isinstance(design, kind):
            more_facts, more_data = describe(design)
            facts += more_facts
            data |= more_data
    if design.hardware is not None:
        more_facts, more_data = _describe_loop(design, design.hardware)
        facts += more_facts
        data |= more_data
    tables = [fact_table("Design", facts)]
    if isinstance(design, ShapedDesign):
        tables += _shaping_tables(data)
    tables.append(certificate_table(design.certificate))
    notes = [] if design.hardware is None else _loop_notes(design, design.hardware, data)
    return Report(data=data, tables=tables, notes=notes)


def _unit(design: Design) -> str:
    return "nm" if design.hardware is not None else ""


def _describe_estimation(design: EstimatorDesign) -> tuple[Facts, Data]:
    error = "residual" if isinstance(design, LqgDesign) else "estimation error"
    facts: Facts = [
        (f"{error}, rms", design.rms, _unit(design)),
        (f"{error}, H-infinity norm", design.gamma, _unit(design)),
    ]
    data: Data = {"rms": design.rms, "gamma": design.gamma}
    if design.hardware is not None:
        limit_nm, above = model_limit(design)
        facts += [
            ("least residual of any linear controller", limit_nm, "nm"),
            (f"{error} above it", round(above, 6) + 0.0, "%"),
        ]
        data |= {"limit_nm": limit_nm, "above_limit_percent": above}
    return facts, data


def _describe_interval(design: PolytopicDesign) -> tuple[Facts, Data]:
    """Describe what a design guarantees over its interval, beside the worst that was found."""
    what = {"hinf": "H-infinity norm", "h2": "rms"}[design.norm]
    ratio = design.bound_guaranteed / design.worst_achieved
    facts: Facts = [
        ("interval of frequencies, from", design.interval.low_hz, "Hz"),
        ("interval of frequencies, to", design.interval.high_hz, "Hz"),
        (f"{what} on the interval, guaranteed", f"{design.bound_guaranteed:.9g}", "nm"),
        (f"{what} on the interval, worst found", f"{design.worst_achieved:.9g}", "nm"),
        ("  guaranteed over found", f"{ratio:.6f}", ""),
        ("  found at", f"{design.worst_frequency_hz:.6g}", "Hz"),
        ("  bound of the programme", f"{design.bound_programme:.9g}", "nm"),
    ]
    return facts, {
        "half_width_hz": design.half_width_hz,
        "norm": design.norm,
        "bound_guaranteed": design.bound_guaranteed,
        "worst_achieved": design.worst_achieved,
        "worst_frequency_hz": design.worst_frequency_hz,
        "bound_programme": design.bound_programme,
        "guaranteed_over_found": ratio,
    }


def _describe_bounds(design: FilterDesign) -> tuple[Facts, Data]:
    """Describe the bounds that were asked for, and the least norm of any filter."""
    facts: Facts = []
    data: Data = {
        "gamma_requested": design.gamma_requested,
        "gamma_least": design.gamma_least,
        "gamma_infeasible": design.gamma_infeasible,
    }
    unit, lower = _unit(design), design.gamma_infeasible  # None in files of version 0.1
    if design.rms_requested is not None:
        facts.append(("rms asked for", design.rms_requested, unit))
        data["rms_requested"] = design.rms_requested
    if design.gamma_requested is not None:
        facts.append(("bound asked for", design.gamma_requested, unit))
    if design.gamma_least is not None:
        facts += [
            ("least norm of any filter, upper bound", f"{design.gamma_least:.9g}", unit),
            (
                "least norm of any filter, lower bound",
                None if lower is None else f"{lower:.9g}",
                unit,
            ),
        ]
    return facts, data


def _describe_weight(design: LqgDesign) -> tuple[Facts, Data]:
    weight = design.command_weight
    return [("weight of the command", weight, "")], {"command_weight": weight}


def _describe_gain(design: IntegratorDesign) -> tuple[Facts, Data]:
    return [("gain", design.gain, "")], {"gain": design.gain}


def _describe_shaping(design: ShapedDesign) -> tuple[Facts, Data]:
    facts: Facts = [("states of one mode, past commands included", design.states_per_mode, "")]
    if design.is_reduced:
        facts.append(("objective above the long parameter's", 100 * design.loss, "%"))
    limit_nm, above = shaped_limit(design)
    if not np.isnan(limit_nm):
        facts += [
            ("least worst residual over its bands, all modes", limit_nm, _unit(design)),
            ("residual at unit sensor gain above it", above, "%"),
        ]
    return facts, {
        "states_per_mode": design.states_per_mode,
        "loss": design.loss,
        "demands": [{"mode": m + 1, "demand": label} for m, label in design.demand_labels()],
        "limit_nm": limit_nm,
        "above_limit_percent": above,
        "objective_nm": design.objective_nm,
        "long_objective_nm": design.long_objective_nm,
        "terms": [
            {"mode": m + 1, "term": text, "rms_nm": rms} for m, text, rms in design.terms_nm()
        ],
    }


# What is said of a design beyond its method, in this order, for each class that it is of
_DESCRIPTIONS: tuple[tuple[type[Design], Callable[[Any], tuple[Facts, Data]]], ...] = (
    (EstimatorDesign, _describe_estimation),
    (PolytopicDesign, _describe_interval),
    (FilterDesign, _describe_bounds),
    (LqgDesign, _describe_weight),
    (IntegratorDesign, _describe_gain),
    (ShapedDesign, _describe_shaping),
)


def _describe_loop(design: Design, hardware: LoopHardware) -> tuple[Facts, Data]:
    margins = loop_margins(close_loop(hardware, design.controller))
    facts: Facts = [
        ("frame rate", hardware.frame_rate_hz, "Hz"),
        ("total delay", hardware.delay_frames, "frames"),
    ]
    data: Data = {
        "frame_rate_hz": hardware.frame_rate_hz,
        "delay_frames": hardware.delay_frames,
        "margins": asdict(margins),
    }
    if hardware.mirror is not None:
        settling_s = hardware.mirror.step_response().settling_s
        facts.append(("settling time of the mirror, to 10 %", 1e3 * settling_s, "ms"))
        data["mirror"] = asdict(hardware.mirror) | {"settling_s": settling_s}
    facts += [
        ("modulus margin", margins.modulus, ""),
        ("stable sensor gains, from", margins.gain_low, ""),
        ("stable sensor gains, to", margins.gain_high, ""),
        ("phase margin", margins.phase_deg, "deg"),
        ("delay margin", margins.delay_frames, "frames"),
        ("highest crossover", margins.crossover_hz, "Hz"),
    ]
    return facts, data


def _shaping_tables(data: Data) -> list[TableText]:
    return [
        TableText(
            title="Demands",
            headings=("demand", "mode"),
            rows=[(row["demand"], row["mode"]) for row in data["demands"]],
        ),
        TableText(
            title="Residual of each term",
            headings=("term", "mode", "residual [nm rms]"),
            rows=[(row["term"], row["mode"], row["rms_nm"]) for row in data["terms"]],
        ),
    ]


def _loop_notes(design: Design, hardware: LoopHardware, data: Data) -> list[str]:
    notes = []
    modulus, alone = data["margins"]["modulus"], data["controller_spectral_radius"]
    if hardware.mirror is not None and not design.knows_mirror:
        notes.append(
            "note: this filter commands its estimate as if the mirror settled at once, so that its "
            "estimation error is not the residual; --method lqg commands for the mirror's dynamics."
        )
    if modulus < _SMALL_MODULUS:
        notes.append(
            f"note: the modulus margin {modulus:.3g} is small; a loop is usually asked for "
            f"{_SMALL_MODULUS:g} or more. Lower the gain, or design with more noise."
        )
    if not np.array_equal(hardware.sensor, np.eye(len(hardware.sensor))):
        notes.append(
            "note: sensor gains here are factors on the gain that the design assumes, which is in "
            "its sensor matrix."
        )
    if isinstance(design, ShapedDesign) and design.is_reduced and design.loss < 0:
        notes.append(
            f"note: the long parameter is not long enough: one of {design.states_per_mode} states "
            "is better. Try more functions, or another pole."
        )
    if alone > 1:
        notes.append(
            f"note: the controller alone has a pole of modulus {alone:.4g}; with the loop open its "
            "commands grow. Reset it whenever the loop opens."
        )
    return notes
