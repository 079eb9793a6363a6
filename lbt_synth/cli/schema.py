"""The command schema: the keys of a configuration for editors, as a JSON schema."""

from __future__ import annotations

import json
from argparse import Namespace

from lbt_synth.cli.output import Report
from lbt_synth.config import config_schema
from lbt_synth.storage.atomic_files import require_ending, require_writable, write_atomically


def run(arguments: Namespace) -> Report:
    """Print the schema of a configuration, or write it."""
    schema = config_schema()
    text = json.dumps(schema, indent=1)
    if arguments.output is None:
        return Report(data=schema, opening=text.splitlines())
    report, output = Report(), require_ending(arguments.output, "a schema", (".json",))
    require_writable(output)
    report.note_written(write_atomically(output, f"{text}\n".encode()))
    return report
