"""The command design: a controller from a configuration, as a gain file."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth.cli.design_description import describe_design
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import show_spinner
from lbt_synth.config import load_config
from lbt_synth.config.design_methods import (
    METHOD_ROUTES,
    METHODS_WITHOUT_HORIZON,
    OPTION_METHODS,
    DesignRequest,
    design_by_method,
)
from lbt_synth.errors import ProblemError
from lbt_synth.files import save_gain
from lbt_synth.files.gain_file.store import require_gain_name
from lbt_synth.storage.atomic_files import require_writable


def run(arguments: Namespace) -> Report:
    """Design a controller and write its gain file."""
    method = arguments.method
    _refuse_unused_options(arguments)
    require_writable(require_gain_name(arguments.output), inputs=[arguments.config])
    given = {name: getattr(arguments, name) for name in ("route", "horizon", *OPTION_METHODS)}
    options = {name: value for name, value in given.items() if value is not None}
    with show_spinner(f"designing ({method})", quiet=arguments.json):
        config = load_config(arguments.config)
        design = design_by_method(config, DesignRequest(method=method, options=options))
    path = save_gain(arguments.output, design)
    report = describe_design(design)
    if method == "mixed" and design.method != "mixed":
        name = {"kalman": "Kalman filter", "hinf": "filter of the least norm"}[design.method]
        report.notes.append(
            f"note: the bound leaves no better choice than the {name}, which is it."
        )
    report.note_written(path)
    return report


def _refuse_unused_options(arguments: Namespace) -> None:
    """Refuse an option that the chosen method would silently ignore."""
    method = arguments.method
    routes = METHOD_ROUTES[method]
    if arguments.route is not None and arguments.route not in routes:
        expected = f"--route {' or '.join(routes)}" if routes else "no --route"
        raise ProblemError(f"--method {method} takes {expected}; got --route {arguments.route}.")
    for option, owners in OPTION_METHODS.items():
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
    if method in METHODS_WITHOUT_HORIZON and arguments.horizon != 1:
        raise ProblemError(
            f"--method {method} takes no horizon; set loop.delay_frames in the configuration "
            f"instead. Got --horizon {arguments.horizon}."
        )
