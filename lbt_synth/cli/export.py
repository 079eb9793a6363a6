"""The command export: a gain file as C source, a MATLAB file or transfer functions."""

from __future__ import annotations

import math
from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.frame_cost import cost_facts, cost_record
from lbt_synth.cli.output import Facts, Report, fact_table
from lbt_synth.cli.progress import show_spinner
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.files.gain_file.store import load_with_digest
from lbt_synth.interop import Exported, export_c, export_iir, export_mat, frame_cost
from lbt_synth.storage.atomic_files import require_writable

_SINGLE_SUFFICES = 1e-3  # of the largest command
_C_OPTIONS = ("precision", "name")


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
    stable_single = math.isfinite(written.error_single)
    facts: Facts = [
        ("method", design.method, ""),
        ("states of the controller", design.controller.n_states, ""),
        ("measurements", design.controller.B.shape[1], ""),
        ("commands", len(design.controller.C), ""),
    ]
    if arguments.format == "c":
        facts += cost_facts(cost)
    facts += [
        ("difference from the controller", written.error, "of the largest command"),
        (
            "  in single precision",
            written.error_single if stable_single else "unstable",
            "of the largest command",
        ),
    ]
    return Report(
        data={
            "gain": arguments.gain,
            "gain_digest": digest,
            "format": arguments.format,
            "files": [str(file) for file in written.files],
            "error": written.error,
            "error_single": written.error_single,
            "stable_single": stable_single,
            "frame_cost": cost_record(cost),
        },
        tables=[fact_table("Export", facts)],
        notes=[
            *_precision_notes(arguments, written),
            *(f"written: {file}" for file in written.files),
        ],
    )


def _export_as(arguments: Namespace, design: Design, digest: str) -> Exported:
    if arguments.format == "mat":
        return export_mat(arguments.output, design, gain_digest=digest)
    if arguments.format == "iir":
        return export_iir(arguments.output, design, gain_digest=digest)
    return export_c(
        arguments.output,
        design,
        precision=arguments.precision or "double",
        name=arguments.name,
        gain_digest=digest,
    )


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
