"""The command design: a controller from a configuration, as a gain file."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth.cli.argument_kinds import given_options
from lbt_synth.cli.design_description import describe_design
from lbt_synth.cli.display import choose_config_unit
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import show_spinner
from lbt_synth.cli.truth_table import add_truth
from lbt_synth.config import load_config
from lbt_synth.files import save_gain
from lbt_synth.files.gain_file.store import require_gain_name
from lbt_synth.methods.registry import method_of_design, option_names
from lbt_synth.methods.request import Wording, design_request
from lbt_synth.storage.atomic_files import require_writable

_WORDING = Wording(method="--method {}", option="--{}")


def run(arguments: Namespace) -> Report:
    """Design a controller and write its gain file."""
    given = given_options(arguments, *option_names())
    request = design_request(arguments.method, given, _WORDING)
    require_writable(require_gain_name(arguments.output), inputs=[arguments.config])
    config = load_config(arguments.config)
    choose_config_unit(arguments, config)
    with show_spinner(f"designing ({request.method.name})", quiet=arguments.json):
        design = config.design(request)
    path = save_gain(arguments.output, design)
    report = describe_design(design)
    with show_spinner("comparing in the truth", quiet=arguments.json):
        add_truth(report, design, config)
    made_by = method_of_design(design.method)
    if made_by is not request.method:
        report.notes.append(
            f"note: the bound leaves no better choice than the {made_by.title}, which is it."
        )
    report.note_written(path)
    return report
