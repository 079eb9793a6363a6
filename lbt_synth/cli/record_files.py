"""What identify and auto read and write: the record, what is known beforehand, and the model."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lbt_synth.cli.loop_inputs import given_options
from lbt_synth.cli.output import Report
from lbt_synth.config import identified_config
from lbt_synth.config.write import config_text
from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.files import save_gain
from lbt_synth.identification import (
    IdentifiedModel,
    LinePrior,
    LoopRecord,
    SpectrumRecord,
    accelerometer_lines,
    load_lines,
    load_record,
    require_length,
)
from lbt_synth.identification.auto import RecordedDesign
from lbt_synth.identification.records.line_priors import load_accelerations
from lbt_synth.report.figures import identification_figure
from lbt_synth.report.figures.style import require_figure_name, save_figure
from lbt_synth.storage.atomic_files import require_ending, require_writable, write_atomically

_FACTS = (  # that a file may not hold
    *("delay_frames", "unit", "command_unit", "diameter_m", "obstruction"),
    *("axes", "averages", "commands"),
)


def read_record(arguments: Namespace) -> LoopRecord | SpectrumRecord:
    """Load the record of the command line, with its short gaps bridged."""
    kind = arguments.kind
    record = load_record(
        arguments.file,
        kind=None if kind is None else kind.replace("-", "_"),
        frame_rate_hz=None if kind == "spectrum" else arguments.frame_rate_hz,
        columns=_parse_columns(arguments.columns),
        **{name: getattr(arguments, name) for name in _FACTS},
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


def find_places(arguments: Namespace, model: str | Path | None, **others: Path) -> dict[str, Path]:
    """Return where model, figure and others go, by default beside each other.

    Refuse bad places.
    """
    output = Path(arguments.output)
    model = require_ending(model or output.with_suffix(".yaml"), "a model", (".yaml", ".yml"))
    places = {**others, "model": model}
    if not arguments.no_figure:
        figure = arguments.figure or output.with_suffix(".png")
        places["figure"] = require_figure_name(figure)
    elif arguments.figure is not None:
        raise ProblemError("give one of --figure and --no-figure, not both.")
    outputs = list(places.values())
    if len({place.resolve() for place in outputs}) < len(outputs):
        raise OutputError(f"each output needs a name of its own; got {outputs[0]} twice.")
    given = given_options(arguments, "file", "commands", "lines_file", "accelerometers")
    require_writable(*outputs, inputs=given.values())
    return places


def write_files(
    report: Report,
    places: dict[str, Path],
    arguments: Namespace,
    record: LoopRecord | SpectrumRecord,
    model: IdentifiedModel,
    made: RecordedDesign | None = None,
) -> None:
    """Write gain file, model and figure, once all of them are computed."""
    text = _model_text(model, arguments, record)
    figure = None
    if "figure" in places:
        designs = None if made is None else {made.name: made.design}
        figure = identification_figure(model, designs=designs)
    if made is not None:
        report.note_written(save_gain(places["gain"], made.design))
    report.note_written(write_atomically(places["model"], text), "model")
    if figure is not None:
        report.note_written(save_figure(figure, places["figure"]), "figure")


def _model_text(
    model: IdentifiedModel, arguments: Namespace, record: LoopRecord | SpectrumRecord
) -> bytes:
    """Return the text of a configuration for an identified model."""
    obstruction = record.obstruction if isinstance(record, LoopRecord) else arguments.obstruction
    if obstruction is not None and record.diameter_m is None:
        raise ProblemError("--obstruction is a fraction of the diameter; give --diameter-m.")
    source = ascii(Path(arguments.file).name)[1:-1]
    settings, comments = identified_config(
        model,
        diameter_m=record.diameter_m,
        obstruction=obstruction,
        wavelength_um=arguments.wavelength_um,
        title=f"Identified from {source} by lbt-synth {arguments.command}.",
    )
    return config_text(settings, comments).encode()
