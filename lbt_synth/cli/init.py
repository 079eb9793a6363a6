"""The command init: a configuration to begin with, and its schema."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path

from lbt_synth.cli.output import Report
from lbt_synth.config import telescope_template
from lbt_synth.config.load import example_files
from lbt_synth.config.schema import config_schema
from lbt_synth.errors import OutputError
from lbt_synth.methods.registry import default_method
from lbt_synth.storage.atomic_files import (
    make_directory,
    require_ending,
    require_writable,
    write_together,
)

_SCHEMA = "lbt-synth.schema.json"


def run_init(arguments: Namespace) -> Report:
    """Write a configuration of a telescope with its schema, or all examples."""
    report, telescope = Report(), arguments.telescope
    if arguments.examples:
        folder = make_directory(arguments.output or "examples")
        contents = {folder / name: text for name, text in sorted(example_files().items())}
        file, first = folder / "lbt.yaml", ""
    else:
        output = arguments.output or f"{telescope}.yaml"
        first = "put in your own numbers; then "
        file = require_ending(output, "a configuration", (".yaml", ".yml"))
        schema = file.with_name(_SCHEMA)
        require_writable(file, schema)
        contents = {
            file: f"# yaml-language-server: $schema={_SCHEMA}\n{telescope_template(telescope)}",
            schema: json.dumps(config_schema(), indent=1) + "\n",
        }
    method = default_method()
    report.verdict.append(
        f"Next, {first}lbt-synth design {file} --method {method} "
        f"-o {file.with_name(f'{file.stem}_{method}.fits')} makes a controller."
    )
    _refuse_taken(contents, force=arguments.force)
    report.note_written(*write_together({at: text.encode() for at, text in contents.items()}))
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
