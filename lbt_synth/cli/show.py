"""The command show: what is in a gain file."""

from __future__ import annotations

from argparse import Namespace

import numpy as np

from lbt_synth.cli.design_description import describe_design
from lbt_synth.cli.frame_cost import cost_facts, cost_record
from lbt_synth.cli.output import Report, fact_table
from lbt_synth.design import Design, FilterDesign, PolytopicDesign
from lbt_synth.files import load_gain
from lbt_synth.interop import frame_cost
from lbt_synth.validation import FloatArray


def run(arguments: Namespace) -> Report:
    """Describe the design in a gain file, what a frame costs, and its matrices if asked for."""
    design = load_gain(arguments.gain)
    report = describe_design(design)
    cost = frame_cost(design)
    report.data |= {"file": arguments.gain, "frame_cost": cost_record(cost)}
    report.tables.append(fact_table("Cost of one frame, as exported to C", cost_facts(cost)))
    if arguments.matrices:
        matrices = _matrices(design)
        report.data["matrices"] = matrices
        with np.printoptions(precision=8, linewidth=160, suppress=False):
            report.notes += [f"{name} =\n{value}" for name, value in matrices.items()]
    return report


def _matrices(design: Design) -> dict[str, FloatArray]:
    matrices = {name: getattr(design.controller, name) for name in "ABCD"}
    if isinstance(design, FilterDesign):
        matrices |= {"gain_predictor": design.gain_predictor, "gain_filter": design.gain_filter}
    if isinstance(design, PolytopicDesign):
        matrices |= {f"predictor_{name}": getattr(design.predictor, name) for name in "ABC"}
    return matrices
