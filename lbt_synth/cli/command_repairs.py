"""What the command line says of the commands of a record, and what it says of wrong ones."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from lbt_synth.errors import RecordError
from lbt_synth.identification.commands.repair import CommandRepair
from lbt_synth.identification.commands.verdict import explain_commands
from lbt_synth.identification.records.record import LoopRecord

if TYPE_CHECKING:  # it loads the methods of synthesis, which identify does not need
    from lbt_synth.identification.auto import RecordedDesign


def given_repair(arguments: Namespace) -> CommandRepair:
    """Return what the command line says that the commands need."""
    return CommandRepair(
        increments=arguments.command_increments,
        shift_frames=arguments.command_shift_frames,
        swap_axes=arguments.swap_axes,
        sign=tuple(arguments.command_sign or ()),
        matrix=tuple(arguments.command_matrix or ()),
        scale=arguments.command_scale or 1.0,
    )


def is_scale_known(arguments: Namespace) -> bool:
    """Return whether the command line says at which size commands were recorded."""
    return arguments.command_scale is not None or arguments.command_matrix is not None


@contextmanager
def explain_refusals(arguments: Namespace) -> Iterator[None]:
    """Refuse a record in the words of the command line, with the options that repair it."""
    try:
        yield
    except RecordError as error:
        advice = f"{error.options}, or " if error.options else ""
        raise RecordError(
            f"the commands of {arguments.file} do not reach its measurements as given: "
            f"{error.explanation}. Try {advice}--accept-record to go on as it is.",
            explanation=error.explanation,
            options=error.options,
        ) from error


def judge_record(arguments: Namespace, record: LoopRecord) -> tuple[str, ...]:
    """Refuse a record whose commands do not reach its measurements; return notes on others."""
    if record.commands is None:
        return ()
    gains = arguments.sensor_gain
    with explain_refusals(arguments):
        verdict = explain_commands(record, sensor_gain=gains)
        if not arguments.accept_record:
            verdict.require_accepted()
    return (*verdict.notes, *(f"warning: it is assumed that {word}" for word in verdict.overruled))


def with_repair(arguments: Namespace, made: RecordedDesign) -> RecordedDesign:
    """Return what was made of a record, with the repair of its commands as an assumption."""
    options = given_repair(arguments).options
    if not options:
        return made
    words = f"the commands of the record were read with {options}"
    design = replace(made.design, assumptions=(words, *made.design.assumptions))
    return replace(made, design=design)
