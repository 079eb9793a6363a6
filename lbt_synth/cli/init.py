"""The command init: a configuration to begin with, its schema, and completion in shells."""

from __future__ import annotations

import json
from argparse import Action, ArgumentParser, Namespace
from collections.abc import Iterator, Mapping
from pathlib import Path

from lbt_synth.cli.arguments import COMMANDS, build_parser, refuse_options
from lbt_synth.cli.output import Report
from lbt_synth.config import config_schema, telescope_template
from lbt_synth.config.load import example_files
from lbt_synth.errors import OutputError
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
    """Write a configuration of a telescope, all examples, a schema or a script."""
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
    telescope = arguments.telescope or _USUAL
    output = arguments.output or f"{telescope}.yaml"
    file = require_ending(output, "a configuration", (".yaml", ".yml"))
    schema = file.with_name(_SCHEMA)
    require_writable(file, schema)
    contents = {
        file: f"# yaml-language-server: $schema={_SCHEMA}\n{telescope_template(telescope)}",
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


def _refuse_taken(contents: Mapping[Path, str], *, force: bool) -> None:
    """Refuse to replace files that hold anything else."""
    taken = [
        str(path)
        for path, text in contents.items()
        if path.is_file() and path.read_bytes() != text.encode()
    ]
    if taken and not force:
        renamed = any(Path(path).name != _SCHEMA for path in taken)  # by -o
        advice = "another name by -o, or --force" if renamed else "--force"
        raise OutputError(f"{', '.join(taken)} would be replaced. Give {advice}.")


def _script(arguments: Namespace) -> Report:
    """Print the schema of a configuration or the completion of a shell, or write it."""
    asked = "--schema" if arguments.schema else "--completion"
    others = ["telescope", "examples", "force", *["completion"] * arguments.schema]
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
