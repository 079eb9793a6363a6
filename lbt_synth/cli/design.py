"""Commands that make and inspect gain files: design, show, verify."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict
from typing import Any

import numpy as np

from lbt_synth.cli.export import cost_data, cost_facts
from lbt_synth.cli.output import Report, TableText, working
from lbt_synth.config import Config, load_config
from lbt_synth.config.design_methods import (
    OWNERS,
    ROUTES,
    WITHOUT_HORIZON,
    DesignRequest,
    designed,
)
from lbt_synth.design import (
    Certificate,
    Design,
    EstimatorDesign,
    FilterDesign,
    IntegratorDesign,
    LqgDesign,
    PolytopicDesign,
    ShapedDesign,
)
from lbt_synth.errors import ProblemError
from lbt_synth.files import load_gain, save_gain
from lbt_synth.files.gain_file.store import require_gain_name
from lbt_synth.interop import frame_cost
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.models import LoopHardware
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.studies.limits import model_limit, shaped_limit
from lbt_synth.validation import FloatArray

_SMALL_MODULUS = 0.3


def design(arguments: Namespace) -> Report:
    """Design a controller and write its gain file."""
    _refuse_foreign_options(arguments)
    require_writable(require_gain_name(arguments.output), inputs=[arguments.config])
    with working(f"designing ({arguments.method})", quiet=arguments.json):
        made = _synthesise(load_config(arguments.config), arguments)
    path = save_gain(arguments.output, made)
    report = _description(made)
    report.data["file"] = str(path)
    if arguments.method == "mixed" and made.method != "mixed":
        name = {"kalman": "Kalman filter", "hinf": "filter of the least norm"}[made.method]
        report.notes.append(
            f"note: the bound leaves no better choice than the {name}, which is it."
        )
    report.notes.append(f"written: {path}")
    return report


def _refuse_foreign_options(arguments: Namespace) -> None:
    """Refuse an option that the chosen method would silently ignore."""
    method = arguments.method
    routes = ROUTES[method]
    if arguments.route is not None and arguments.route not in routes:
        expected = " or ".join(routes) if routes else "no --route"
        raise ProblemError(f"--method {method} takes {expected}; got --route {arguments.route}.")
    for option, owners in OWNERS.items():
        if getattr(arguments, option) is not None and method not in owners:
            raise ProblemError(
                f"--{option.replace('_', '-')} goes with --method {' or '.join(owners)}; "
                f"got --method {method}."
            )
    if method == "polytopic" and arguments.half_width_hz is None:
        raise ProblemError(
            "--method polytopic needs the half width of the interval of frequencies; try "
            "--half-width-hz 1."
        )
    if method in WITHOUT_HORIZON and arguments.horizon != 1:
        raise ProblemError(
            f"--method {method} takes no horizon; set loop.delay_frames in the configuration "
            f"instead. Got --horizon {arguments.horizon}."
        )


def _synthesise(config: Config, arguments: Namespace) -> Design:
    given = {name: getattr(arguments, name) for name in ("route", "horizon", *OWNERS)}
    options = {name: value for name, value in given.items() if value is not None}
    return designed(config, DesignRequest(method=arguments.method, options=options))


def show(arguments: Namespace) -> Report:
    """Show a gain file."""
    loaded = load_gain(arguments.gain)
    report = _description(loaded)
    report.data["file"] = arguments.gain
    cost = frame_cost(loaded)
    report.data["frame_cost"] = cost_data(cost)
    report.tables.append(
        TableText(
            title="Cost of one frame, as exported to C",
            headings=("quantity", "value", "unit"),
            rows=cost_facts(cost),
        )
    )
    if arguments.matrices:
        matrices = {name: getattr(loaded.controller, name) for name in "ABCD"}
        if isinstance(loaded, FilterDesign):
            matrices |= {
                "gain_predictor": loaded.gain_predictor,
                "gain_filter": loaded.gain_filter,
            }
        if isinstance(loaded, PolytopicDesign):
            matrices |= {f"predictor_{name}": getattr(loaded.predictor, name) for name in "ABC"}
        report.data["matrices"] = matrices
        with np.printoptions(precision=8, linewidth=160, suppress=False):
            report.notes += [f"{name} =\n{value}" for name, value in matrices.items()]
    return report


def verify(arguments: Namespace) -> Report:
    """Compute the certificate of a gain file anew."""
    loaded = load_gain(arguments.gain)
    certificate = loaded.recertified()
    return Report(
        data={
            "file": arguments.gain,
            "method": loaded.method,
            "passed": certificate.passed,
            "checks": _check_data(certificate),
        },
        tables=[_check_table(certificate)],
        notes=[f"{arguments.gain}: {'verified' if certificate.passed else 'NOT VERIFIED'}"],
        passed=certificate.passed,
    )


def _description(made: Design) -> Report:
    """Tables of a design: what it is, its loop, its certificate."""
    facts: list[tuple[str, Any, str]] = [
        ("method", made.method, ""),
        ("route", f"{made.solver.route} ({made.solver.status})", ""),
        ("states of the controller", made.controller.n_states, ""),
    ]
    alone = made.controller.to_statespace().spectral_radius
    data: dict[str, Any] = {
        "method": made.method,
        "solver": asdict(made.solver),
        "n_states": made.controller.n_states,
        "poles": [complex(p) for p in made.poles],
        "controller_spectral_radius": alone,
        "checks": _check_data(made.certificate),
    }
    unit = "nm" if made.hardware is not None else ""
    if isinstance(made, EstimatorDesign):
        error = "residual" if isinstance(made, LqgDesign) else "estimation error"
        facts += [
            (f"{error}, rms", made.rms, unit),
            (f"{error}, H-infinity norm", made.gamma, unit),
        ]
        data |= {"rms": made.rms, "gamma": made.gamma}
        if made.hardware is not None:
            limit_nm, above = model_limit(made)
            facts += [
                ("least residual of any linear controller", limit_nm, unit),
                (f"{error} above it", round(above, 6) + 0.0, "%"),
            ]
            data |= {"limit_nm": limit_nm, "above_limit_percent": above}
    if isinstance(made, PolytopicDesign):
        _describe_interval(made, facts, data)
    if isinstance(made, FilterDesign):
        data |= {
            "gamma_requested": made.gamma_requested,
            "gamma_least": made.gamma_least,
            "gamma_infeasible": made.gamma_infeasible,
        }
        if made.rms_requested is not None:
            facts.append(("rms asked for", made.rms_requested, unit))
            data["rms_requested"] = made.rms_requested
        if made.gamma_requested is not None:
            facts.append(("bound asked for", made.gamma_requested, unit))
        if made.gamma_least is not None:
            facts += [
                ("least norm of any filter, upper bound", f"{made.gamma_least:.9g}", unit),
                ("least norm of any filter, lower bound", _digits(made.gamma_infeasible), unit),
            ]
    if isinstance(made, LqgDesign):
        facts.append(("weight of the command", made.command_weight, ""))
        data["command_weight"] = made.command_weight
    if isinstance(made, IntegratorDesign):
        facts.append(("gain", made.gain, ""))
        data["gain"] = made.gain
    if isinstance(made, ShapedDesign):
        facts.append(("states of one mode, past commands included", made.states_per_mode, ""))
        if made.is_reduced:
            facts.append(("objective above the long parameter's", 100 * made.loss, "%"))
        limit_nm, above = shaped_limit(made)
        if not np.isnan(limit_nm):
            facts += [
                ("least worst residual over its bands, all modes", limit_nm, unit),
                ("residual at unit sensor gain above it", above, "%"),
            ]
        terms = made.terms_nm()
        data |= {
            "states_per_mode": made.states_per_mode,
            "loss": made.loss,
            "demands": [{"mode": m + 1, "demand": label} for m, label in made.demanded()],
            "limit_nm": limit_nm,
            "above_limit_percent": above,
            "objective_nm": made.objective_nm,
            "long_objective_nm": made.long_objective_nm,
            "terms": [{"mode": m + 1, "term": text, "rms_nm": rms} for m, text, rms in terms],
        }
    tables = []
    if made.hardware is not None:
        margins = loop_margins(close_loop(made.hardware, made.controller))
        data |= {
            "frame_rate_hz": made.hardware.frame_rate_hz,
            "delay_frames": made.hardware.delay_frames,
            "margins": asdict(margins),
        }
        facts += [
            ("frame rate", made.hardware.frame_rate_hz, "Hz"),
            ("total delay", made.hardware.delay_frames, "frames"),
            *_mirror_facts(made.hardware, data),
            ("modulus margin", margins.modulus, ""),
            ("stable sensor gains, from", margins.gain_low, ""),
            ("stable sensor gains, to", margins.gain_high, ""),
            ("phase margin", margins.phase_deg, "deg"),
            ("delay margin", margins.delay_frames, "frames"),
            ("highest crossover", margins.crossover_hz, "Hz"),
        ]
    tables.append(TableText(title="Design", headings=("quantity", "value", "unit"), rows=facts))
    if isinstance(made, ShapedDesign):
        tables.append(
            TableText(
                title="Demands",
                headings=("demand", "mode"),
                rows=[(label, mode + 1) for mode, label in made.demanded()],
            )
        )
        tables.append(
            TableText(
                title="Residual of each term",
                headings=("term", "mode", "residual [nm rms]"),
                rows=[(text, mode + 1, rms) for mode, text, rms in terms],
            )
        )
    tables.append(_check_table(made.certificate))
    notes = []
    moving = made.hardware is not None and made.hardware.mirror is not None
    if moving and isinstance(made, EstimatorDesign) and not isinstance(made, LqgDesign):
        notes.append(
            "note: this filter commands its estimate as if the mirror settled at once, so that its "
            "estimation error is not the residual; --method lqg commands for the mirror's dynamics."
        )
    if made.hardware is not None and margins.modulus < _SMALL_MODULUS:
        notes.append(
            f"note: the modulus margin {margins.modulus:.3g} is small; a loop is usually asked for "
            f"{_SMALL_MODULUS:g} or more. Lower the gain, or design with more noise."
        )
    if made.hardware is not None and not is_identity(made.hardware.sensor):
        notes.append(
            "note: sensor gains here are factors on the gain that the design assumes, which is in "
            "its sensor matrix."
        )
    if isinstance(made, ShapedDesign) and made.is_reduced and made.loss < 0:
        notes.append(
            f"note: the long parameter is not long enough: one of {made.states_per_mode} states is "
            "better. Try more functions, or another pole."
        )
    if made.hardware is not None and alone > 1:
        notes.append(
            f"note: the controller alone has a pole of modulus {alone:.4g}; with the loop open its "
            "commands grow. Reset it whenever the loop opens."
        )
    return Report(data=data, tables=tables, notes=notes)


def _mirror_facts(hardware: LoopHardware, data: dict[str, Any]) -> list[tuple[str, Any, str]]:
    """Say what a design believes of the mirror, if it does not settle at once."""
    if hardware.mirror is None:
        return []
    settling_s = hardware.mirror.step_response().settling_s
    data["mirror"] = asdict(hardware.mirror) | {"settling_s": settling_s}
    return [("settling time of the mirror, to 10 %", 1e3 * settling_s, "ms")]


def _describe_interval(
    made: PolytopicDesign, facts: list[tuple[str, Any, str]], data: dict[str, Any]
) -> None:
    """Add what a design guarantees over its interval, beside the worst that was found."""
    what = {"hinf": "H-infinity norm", "h2": "rms"}[made.norm]
    ratio = made.bound_guaranteed / made.worst_achieved
    facts += [
        ("interval of frequencies, from", made.interval.low_hz, "Hz"),
        ("interval of frequencies, to", made.interval.high_hz, "Hz"),
        (f"{what} on the interval, guaranteed", f"{made.bound_guaranteed:.9g}", "nm"),
        (f"{what} on the interval, worst found", f"{made.worst_achieved:.9g}", "nm"),
        ("  guaranteed over found", f"{ratio:.6f}", ""),
        ("  found at", f"{made.worst_frequency_hz:.6g}", "Hz"),
        ("  bound of the programme", f"{made.bound_programme:.9g}", "nm"),
    ]
    data |= {
        "half_width_hz": made.half_width_hz,
        "norm": made.norm,
        "bound_guaranteed": made.bound_guaranteed,
        "worst_achieved": made.worst_achieved,
        "worst_frequency_hz": made.worst_frequency_hz,
        "bound_programme": made.bound_programme,
        "guaranteed_over_found": ratio,
    }


def is_identity(matrix: FloatArray) -> bool:
    """Whether a matrix is the identity."""
    return matrix.shape[0] == matrix.shape[1] and np.array_equal(matrix, np.eye(len(matrix)))


def _digits(level: float | None) -> str:
    """Nine digits of a level; files of version 0.1 have none."""
    return "-" if level is None else f"{level:.9g}"


def _check_table(certificate: Certificate) -> TableText:
    return TableText(
        title="Certificate",
        headings=("check", "value", "limit", "passed", "computed by"),
        rows=[(c.name, c.value, c.limit, c.passed, c.computed_by) for c in certificate.checks],
    )


def _check_data(certificate: Certificate) -> list[dict[str, Any]]:
    return [asdict(check) | {"passed": check.passed} for check in certificate.checks]
