"""The command export: a gain file as C source, a MATLAB file, a transfer-function file."""

from __future__ import annotations

import math
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lbt_synth.cli.output import Report, TableText, working
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.files.gain_file.store import load_with_digest
from lbt_synth.interop import Exported, FrameCost, export_c, export_iir, export_mat, frame_cost
from lbt_synth.storage.atomic_files import require_writable

_SINGLE_SUFFICES = 1e-3  # of the largest command
_OWNED = ("precision", "name")  # options of the format c


def export(arguments: Namespace) -> Report:
    """Write a controller for another program."""
    for option in _OWNED:
        if getattr(arguments, option) is not None and arguments.format != "c":
            raise ProblemError(f"--{option} goes with --format c; got --format {arguments.format}.")
    target = Path(arguments.output)
    header = [target.parent / f"{target.stem}.h"] if arguments.format == "c" else []
    require_writable(target, *header, inputs=[arguments.gain])
    design, digest = load_with_digest(arguments.gain)
    with working("exporting", quiet=arguments.json):
        written = _written(design, digest, arguments)
    cost = frame_cost(design)
    facts: list[tuple[str, Any, str]] = [
        ("method", design.method, ""),
        ("states of the controller", design.controller.n_states, ""),
        ("measurements", design.controller.B.shape[1], ""),
        ("commands", len(design.controller.C), ""),
    ]
    if arguments.format == "c":
        facts += cost_facts(cost)
    facts += [
        ("difference from the controller", written.error, "of the largest command"),
        ("  in single precision", _grown(written.error_single), "of the largest command"),
    ]
    return Report(
        data={
            "gain": arguments.gain,
            "gain_digest": digest,
            "format": arguments.format,
            "files": [str(file) for file in written.files],
            "error": written.error,
            "error_single": written.error_single,
            "stable_single": math.isfinite(written.error_single),
            "frame_cost": cost_data(cost),
        },
        tables=[TableText(title="Export", headings=("quantity", "value", "unit"), rows=facts)],
        notes=[*_notes(arguments, written), *(f"written: {file}" for file in written.files)],
    )


def _written(design: Design, digest: str, arguments: Namespace) -> Exported:
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


def _notes(arguments: Namespace, written: Exported) -> list[str]:
    if arguments.precision == "single" and not written.error <= _SINGLE_SUFFICES:
        return [
            f"note: in single precision commands are off by {written.error:.2g} of the largest "
            "one. Export with --precision double."
        ]
    if arguments.format == "iir" and not written.error_single <= _SINGLE_SUFFICES:
        unstable = math.isinf(written.error_single)
        effect = (
            "the loop is unstable"
            if unstable
            else f"commands are off by {written.error_single:.2g} of the largest one"
        )
        return [
            f"note: in single precision, SPECULA's default, {effect} with this transfer function. "
            "Run it with precision 0, or use the gain file itself with SsrFilter."
        ]
    return []


def _grown(error: float) -> float | str:
    return "unstable" if math.isinf(error) else error


def cost_facts(cost: FrameCost) -> list[tuple[str, Any, str]]:
    """Rows of a table: what a frame costs, and what it would with whole matrices."""
    return [
        ("multiplications a frame", cost.multiplications, f"({cost.form})"),
        ("  with whole matrices", cost.dense_multiplications, ""),
        ("additions a frame", cost.additions, ""),
        ("  with whole matrices", cost.dense_additions, ""),
        ("coefficients, double", cost.coefficient_bytes_double, "bytes"),
        ("coefficients, single", cost.coefficient_bytes_single, "bytes"),
        ("  with whole matrices, double", 8 * cost.dense_coefficients, "bytes"),
        ("state, double", cost.state_bytes_double, "bytes"),
        ("state, single", cost.state_bytes_single, "bytes"),
    ]


def cost_data(cost: FrameCost) -> dict[str, Any]:
    """Return the same for programs."""
    sizes = [f"{what}_bytes_{p}" for what in ("coefficient", "state") for p in ("double", "single")]
    return asdict(cost) | {name: getattr(cost, name) for name in sizes}
