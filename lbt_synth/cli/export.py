"""The command export: a gain file as C source, a MATLAB file or transfer functions."""

from __future__ import annotations

import math
from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import show_spinner
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.files.gain_file.store import load_with_digest
from lbt_synth.interop import Exported, export_c, export_iir, export_mat, frame_cost
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.rows import column, fact_table, fill_row, json_record, table_row

_SINGLE_SUFFICES = 1e-3  # of the largest command
_C_OPTIONS = ("precision", "name")


@table_row
class ExportFacts:
    """What was exported, and how far it is from the controller."""

    method: str = column("method")
    n_states: int = column("states of the controller")
    measurements: int = column("measurements")
    commands: int = column("commands")
    error: float = column("difference from the controller", unit="of the largest command")
    error_single: float = column("  in single precision", unit="of the largest command")
    stable_single: bool = column("  stable in single precision")


def run(arguments: Namespace) -> Report:
    """Write the controller of a gain file for another program."""
    for option in _C_OPTIONS:
        if getattr(arguments, option) is not None and arguments.format != "c":
            raise ProblemError(f"--{option} goes with --format c; got --format {arguments.format}.")
    target = Path(arguments.output)
    header = [target.parent / f"{target.stem}.h"] if arguments.format == "c" else []
    require_writable(target, *header, inputs=[arguments.gain])
    design, digest = load_with_digest(arguments.gain)
    with show_spinner("exporting", quiet=arguments.json):
        written = _export_as(arguments, design, digest)
    cost = frame_cost(design)
    report = Report(
        data={"gain": arguments.gain, "gain_digest": digest, "format": arguments.format}
    )
    facts = fill_row(
        ExportFacts,
        written,
        design,
        measurements=design.controller.B.shape[1],
        commands=len(design.controller.C),
        n_states=design.controller.n_states,
        stable_single=math.isfinite(written.error_single),
    )
    report.data |= {"frame_cost": json_record(cost), **json_record(facts)}
    report.tables.append(fact_table("Export", facts, *([cost] if arguments.format == "c" else [])))
    report.notes += _precision_notes(arguments, written)
    report.note_files(written.files)
    return report


def _export_as(arguments: Namespace, design: Design, digest: str) -> Exported:
    if arguments.format == "c":
        options = {"precision": arguments.precision or "double", "name": arguments.name}
        return export_c(arguments.output, design, gain_digest=digest, **options)
    export = export_mat if arguments.format == "mat" else export_iir
    return export(arguments.output, design, gain_digest=digest)


def _precision_notes(arguments: Namespace, written: Exported) -> list[str]:
    if arguments.precision == "single" and not written.error <= _SINGLE_SUFFICES:
        return [
            f"note: in single precision commands are off by {written.error:.2g} of the largest "
            "one. Export with --precision double."
        ]
    if arguments.format == "iir" and not written.error_single <= _SINGLE_SUFFICES:
        effect = (
            "the loop is unstable"
            if math.isinf(written.error_single)
            else f"commands are off by {written.error_single:.2g} of the largest one"
        )
        return [
            f"note: in single precision, SPECULA's default, {effect} with this transfer function. "
            "Run it with precision 0, or use the gain file itself with SsrFilter."
        ]
    return []
