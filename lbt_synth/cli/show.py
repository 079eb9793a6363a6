"""The command show: what is in a gain file."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.design_description import describe_design
from lbt_synth.cli.display import choose_design_unit
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import show_spinner
from lbt_synth.cli.truth_table import add_truth
from lbt_synth.config.load import config_from_text
from lbt_synth.files import load_gain
from lbt_synth.interop import frame_cost
from lbt_synth.storage.rows import fact_table, json_record


def run(arguments: Namespace) -> Report:
    """Describe the design in a gain file, what a frame costs, and its matrices if asked for."""
    design = load_gain(arguments.gain)
    choose_design_unit(arguments, design)
    report = describe_design(design, matrices=arguments.matrices)
    cost = frame_cost(design)
    report.data |= {"file": arguments.gain, "frame_cost": json_record(cost)}
    report.tables.append(fact_table("Cost per frame, as exported to C", cost))
    if design.configuration:
        with show_spinner("comparing in the truth", quiet=arguments.json):
            add_truth(report, design, config_from_text(design.configuration, Path(arguments.gain)))
    return report
