"""The command init: a configuration to begin with, its schema, and completion in shells."""

from __future__ import annotations

import json
import re
from argparse import Action, ArgumentParser, Namespace
from collections.abc import Iterator, Mapping
from pathlib import Path

from lbt_synth.cli.arguments import COMMANDS, build_parser, refuse_options
from lbt_synth.cli.output import Report
from lbt_synth.config import config_schema, identified_config, telescope_template
from lbt_synth.config.load import example_files
from lbt_synth.config.write import config_text
from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.identification import LoopRecord, SpectrumRecord, identify, load_record
from lbt_synth.loop import Imaging
from lbt_synth.methods.registry import default_method
from lbt_synth.storage.atomic_files import (
    make_directory,
    require_ending,
    require_writable,
    write_atomically,
    write_together,
)

_SCHEMA = "lbt-synth.schema.json"
_USUAL = "generic"  # the telescope of which nothing is known


def run(arguments: Namespace) -> Report:
    """Write a configuration of a telescope or a record, all examples, a schema or a script."""
    report = Report()
    if arguments.schema or arguments.completion:
        return _script(arguments)
    if arguments.examples:
        folder = Path(arguments.output or "examples")
        contents = {folder / name: text for name, text in sorted(example_files().items())}
        _refuse_taken(contents, force=arguments.force)
        make_directory(folder)
        report.note_files(write_together({at: text.encode() for at, text in contents.items()}))
        return report
    record = arguments.source
    default = f"{Path(record).stem if record else arguments.telescope or _USUAL}.yaml"
    file = require_ending(arguments.output or default, "a configuration", (".yaml", ".yml"))
    schema = file.with_name(_SCHEMA)
    require_writable(file, schema, inputs=[record] if record else [])
    if record:
        _refuse_taken({file: None}, force=arguments.force)
        text = _text_of_record(record, arguments.telescope)
    else:
        text = telescope_template(arguments.telescope or _USUAL)
    contents = {
        file: f"# yaml-language-server: $schema={_SCHEMA}\n{text}",
        schema: json.dumps(config_schema(), indent=1) + "\n",
    }
    _refuse_taken(contents, force=arguments.force)
    report.note_files(write_together({at: text.encode() for at, text in contents.items()}))
    method = default_method()
    report.verdict.append(
        f"Next, put in your own numbers; then lbt-synth design {file} --method {method} "
        f"-o {file.with_name(f'{file.stem}_{method}.fits')} makes a controller."
    )
    return report


def _refuse_taken(contents: Mapping[Path, str | None], *, force: bool) -> None:
    """Refuse to replace files that hold anything else."""
    taken = [
        str(path)
        for path, text in contents.items()
        if path.is_file() and (text is None or path.read_bytes() != text.encode())
    ]
    if taken and not force:
        renamed = any(Path(path).name != _SCHEMA for path in taken)  # by -o
        advice = "another name by -o, or --force" if renamed else "--force"
        raise OutputError(f"{', '.join(taken)} would be replaced. Give {advice}.")


def _text_of_record(path: str, telescope: str | None) -> str:
    """Return what a record knows as a configuration, and in comments what it does not."""
    try:
        record = load_record(path)
    except ProblemError as error:
        raise ProblemError(
            f"{error} Try lbt-synth identify, which takes what is missing."
        ) from error
    if isinstance(record, SpectrumRecord):
        raise ProblemError("--from takes recorded series; got a spectrum. Try lbt-synth identify.")
    source = ascii(Path(path).name)[1:-1]
    wavelength_um = record.imaging_wavelength_um
    settings, comments = identified_config(
        identify(record.bridged()),
        diameter_m=record.diameter_m,
        obstruction=record.obstruction,
        wavelength_um=Imaging().wavelength_um if wavelength_um is None else wavelength_um,
        title=f"What {source} says of its loop, by lbt-synth init; what is assumed says so.\n"
        "Standard errors are beside what was identified.",
    )
    comments |= dict.fromkeys(("loop.frame_rate_hz", "loop.delay_frames"), f"from {source}")
    comments["imaging.wavelength_um"] = f"from {source}" if wavelength_um else "assumed"
    return config_text(settings, comments) + _unknown_sections(record, source, telescope or _USUAL)


def _unknown_sections(record: LoopRecord, source: str, telescope: str) -> str:
    """Return the sections of a telescope that a record does not know, as comments."""
    names = ["atmosphere"] if record.diameter_m is not None else ["telescope", "atmosphere"]
    template = telescope_template(telescope)
    sections = [match[0] for name in names if (match := _section(name, template))]
    marks = re.findall(r"^# (\[\d\] .+\n(?:#     .+\n)*)", template, re.MULTILINE)
    used = [mark for mark in marks if any(mark[:3] in section for section in sections)]
    text = "".join([f"Not in {source}; this is of the template {telescope}:\n", *sections, *used])
    return "\n" + "".join(f"# {line}\n" for line in text.replace("\n# ", "\n").splitlines())


def _section(name: str, template: str) -> re.Match[str] | None:
    return re.search(rf"^{name}:.*\n(?:  .*\n)+", template, re.MULTILINE)


def _script(arguments: Namespace) -> Report:
    """Print the schema of a configuration or the completion of a shell, or write it."""
    asked = "--schema" if arguments.schema else "--completion"
    others = ["telescope", "source", "examples", "force", *["completion"] * arguments.schema]
    refuse_options(arguments, others, f"does not go with {asked}; leave it out")
    data, text = config_schema(), json.dumps(config_schema(), indent=1)
    if not arguments.schema:
        text = _completion(arguments.completion)
        data = {"shell": arguments.completion, "script": text}
    if arguments.output is None:
        return Report(data=data, text=text)
    output = Path(arguments.output)
    if arguments.schema:
        require_ending(output, "a schema", (".json",))
    require_writable(output)
    report = Report()
    report.note_written(write_atomically(output, f"{text}\n".encode()))
    return report


def _completion(shell: str) -> str:
    """Return the script of a shell, made from the arguments of all commands."""
    import shtab  # which no other command needs

    parser = build_parser(*COMMANDS)
    for action in _takes_files(parser):
        action.complete = shtab.FILE  # type: ignore[attr-defined]
    return str(shtab.complete(parser, shell=shell))


def _takes_files(parser: ArgumentParser) -> Iterator[Action]:
    """Yield the arguments of all commands that may be the name of a file."""
    for action in parser._actions:
        if isinstance(action.choices, dict):
            for command in action.choices.values():
                yield from _takes_files(command)
        elif action.choices is None and action.nargs != 0 and action.type in (None, str):
            yield action
