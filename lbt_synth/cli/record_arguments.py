"""What identify and auto read: the record, and what is known of the loop beforehand."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from typing import Any

from lbt_synth.errors import ProblemError
from lbt_synth.identification import (
    LinePrior,
    LoopRecord,
    SpectrumRecord,
    accelerometer_lines,
    load_lines,
    load_record,
    require_length,
)
from lbt_synth.identification.records.line_priors import load_accelerations


def read_record(arguments: Namespace) -> LoopRecord | SpectrumRecord:
    """Load the record of the command line, with its short gaps bridged."""
    record = load_record(
        arguments.file,
        kind=None if arguments.kind is None else arguments.kind.replace("-", "_"),
        frame_rate_hz=None if arguments.kind == "spectrum" else arguments.frame_rate_hz,
        delay_frames=arguments.delay_frames,
        unit=arguments.unit,
        command_unit=arguments.command_unit,
        diameter_m=arguments.diameter_m,
        obstruction=arguments.obstruction,
        axes=arguments.axes,
        averages=arguments.averages,
        columns=_parse_columns(arguments.columns),
        commands=arguments.commands,
    )
    if isinstance(record, LoopRecord):
        record = record.bridged()
        require_length(record)
    return record


def _parse_columns(given: Sequence[str] | None) -> dict[str, list[str | int]] | None:
    """Parse ROLE=NAME[,NAME] pairs."""
    if given is None:
        return None
    out: dict[str, list[str | int]] = {}
    for pair in given:
        role, equals, names = pair.partition("=")
        if not equals or not role or not names:
            raise ProblemError(
                f"--columns takes ROLE=NAME or ROLE=NAME,NAME, as in measurements=tip,tilt or "
                f"commands=3,4; got {pair!r}."
            )
        out[role] = [int(name) if name.isdecimal() else name for name in names.split(",")]
    return out


def identification_options(
    arguments: Namespace, record: LoopRecord | SpectrumRecord
) -> dict[str, Any]:
    """Return the options of an identification that the command line gives."""
    options: dict[str, Any] = {
        "announced": _expected_lines(arguments, record),
        "lowest_line_hz": arguments.lowest_line_hz,
        "most_lines": arguments.most_lines,
    }
    if isinstance(record, LoopRecord):
        options["sensor_gain"] = arguments.sensor_gain
        options["assumed_gain"] = arguments.assumed_gain
    elif arguments.sensor_gain is not None:
        raise ProblemError("a spectrum is of the phase: it has no sensor gain to be given.")
    return options


def _expected_lines(
    arguments: Namespace, record: LoopRecord | SpectrumRecord
) -> tuple[LinePrior, ...]:
    """Return lines known beforehand, from the arguments, a file, and accelerometers."""
    lines: list[LinePrior] = []
    if arguments.lines_hz is not None:
        lines += load_lines([(f, arguments.lines_error_hz) for f in arguments.lines_hz])
    if arguments.lines_file is not None:
        lines += load_lines(arguments.lines_file)
    if arguments.accelerometers is not None:
        if isinstance(record, SpectrumRecord):
            raise ProblemError(
                "accelerometers are compared with the recorded series; got a spectrum. Give their "
                "lines by --lines-hz."
            )
        lines += accelerometer_lines(
            load_accelerations(arguments.accelerometers),
            record.pseudo_open_loop(),
            record.frame_rate_hz,
            usable=record.usable,
        )
    return tuple(lines)
