"""What the terminal says of a design: its facts, its loop, its certificate, and warnings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.cli.certificate_table import certificate_table, check_records
from lbt_synth.cli.output import Report, TableText
from lbt_synth.design import Design
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.methods.registry import method_of_design
from lbt_synth.models import LoopHardware
from lbt_synth.storage import rows
from lbt_synth.storage.rows import column, table_row
from lbt_synth.storage.tables import Table
from lbt_synth.validation import FloatArray

Data: TypeAlias = dict[str, Any]

_SMALL_MODULUS = 0.3


@table_row
class DesignFacts:
    """What every design has."""

    method: str = column("method")
    solver: str = column("route")
    n_states: int = column("states of the controller")


@table_row
class LoopFacts:
    """The loop that a design is for, and its margins."""

    frame_rate_hz: float = column("frame rate", unit="Hz")
    delay_frames: float = column("total delay", unit="frames")
    settling_ms: float | None = column("settling time of the mirror, to 10 %", unit="ms")
    modulus: float = column("modulus margin")
    gain_low: float = column("stable sensor gains, from")
    gain_high: float = column("stable sensor gains, to")
    phase_deg: float = column("phase margin", unit="deg")
    delay_margin: float = column("delay margin", unit="frames")
    crossover_hz: float = column("highest crossover", unit="Hz")


def describe_design(design: Design, *, matrices: bool = False) -> Report:
    """Describe a design: what it is, its loop, its certificate, and its matrices if asked for."""
    described = method_of_design(design.method).describe(design)
    said = DesignFacts(
        method=design.method,
        solver=f"{design.solver.route} ({design.solver.status})",
        n_states=design.controller.n_states,
    )
    data: Data = {
        "method": design.method,
        "solver": asdict(design.solver),
        "n_states": design.controller.n_states,
        "poles": [complex(p) for p in design.poles],
        "controller_spectral_radius": design.controller.to_statespace().spectral_radius,
        "checks": check_records(design.certificate.checks),
        **rows.json_record(described.facts),
        **{t.key: [rows.json_record(row) for row in t.rows] for t in described.tables},
    }
    facts, notes = [said, described.facts], [*described.notes]
    if design.hardware is not None:
        loop, loop_data = _describe_loop(design, design.hardware)
        facts.append(loop)
        data |= loop_data
        notes = _loop_notes(design, design.hardware, data) + notes
    table = rows.fact_table("Design", *facts)
    report = Report(
        data=data,
        tables=[
            _table_text(table if design.hardware is not None else _without_units(table)),
            *(_table_text(rows.row_table(t.title, t.rows)) for t in described.tables),
            certificate_table(design.certificate),
        ],
        notes=notes,
    )
    if matrices:
        _add_matrices(report, design, described.matrices)
    return report


def _table_text(table: Table) -> TableText:
    return TableText(title=table.caption, headings=table.headings, rows=table.rows)


def _without_units(table: Table) -> Table:
    """Return the facts of a bare estimation problem, whose signals have no units."""
    return Table(
        caption=table.caption,
        headings=table.headings,
        rows=tuple((*row[:2], "") for row in table.rows),
        words=table.words,
    )


def _add_matrices(report: Report, design: Design, more: Mapping[str, FloatArray]) -> None:
    matrices = {name: getattr(design.controller, name) for name in "ABCD"} | dict(more)
    report.data["matrices"] = matrices
    with np.printoptions(precision=8, linewidth=160, suppress=False):
        report.notes += [f"{name} =\n{value}" for name, value in matrices.items()]


def _describe_loop(design: Design, hardware: LoopHardware) -> tuple[LoopFacts, Data]:
    margins = loop_margins(close_loop(hardware, design.controller))
    settling_s, data = None, {}
    if hardware.mirror is not None:
        settling_s = hardware.mirror.step_response().settling_s
        data["mirror"] = asdict(hardware.mirror) | {"settling_s": settling_s}
    facts = LoopFacts(
        frame_rate_hz=hardware.frame_rate_hz,
        delay_frames=hardware.delay_frames,
        settling_ms=None if settling_s is None else 1e3 * settling_s,
        modulus=margins.modulus,
        gain_low=margins.gain_low,
        gain_high=margins.gain_high,
        phase_deg=margins.phase_deg,
        delay_margin=margins.delay_frames,
        crossover_hz=margins.crossover_hz,
    )
    return facts, data | {
        "frame_rate_hz": hardware.frame_rate_hz,
        "delay_frames": hardware.delay_frames,
        "margins": asdict(margins),
    }


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
    if alone > 1:
        notes.append(
            f"note: the controller alone has a pole of modulus {alone:.4g}; with the loop open its "
            "commands grow. Reset it whenever the loop opens."
        )
    return notes
