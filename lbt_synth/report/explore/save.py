"""Files of a view: its configuration, its gain file, and the commands that make them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from pathlib import Path

from lbt_synth.config.write import config_text
from lbt_synth.files import save_gain
from lbt_synth.report.explore.exploration import Exploration, View, describe_moves
from lbt_synth.report.provenance import creator_name
from lbt_synth.storage.atomic_files import write_together

_ENDINGS = (".yaml", ".fits", ".sh")


@dataclass(frozen=True, slots=True, kw_only=True)
class Saved:
    """What was written."""

    files: tuple[Path, ...]
    commands: tuple[str, ...]


def save_view(exploration: Exploration, view: View, folder: Path) -> Saved:
    """Write a view into a folder under names that are free; OutputError if that fails."""
    stem = next(
        stem
        for stem in (f"explored-{number}" for number in count(1))
        if not any((folder / (stem + ending)).exists() for ending in _ENDINGS)
    )
    config, gain, script = (folder / (stem + ending) for ending in _ENDINGS)
    commands = list_commands(view, stem)
    moves = describe_moves(exploration, view.wish) or "nothing moved"
    head = f"{exploration.config.source.name!a} with {moves}; {creator_name()}"
    lines = ["#!/bin/sh", f"# {head}", "set -e", 'cd "$(dirname "$0")"', *commands, ""]
    text = config_text(view.config.settings, {"": "\n".join((head, *commands))})
    write_together({config: text.encode(), script: "\n".join(lines).encode()})
    save_gain(gain, view.design)
    return Saved(files=(config, gain, script), commands=commands)


def list_commands(view: View, stem: str) -> tuple[str, ...]:
    """Return the commands that make the files of a name, and a report of them."""
    request = view.request
    options = [f"--{name.replace('_', '-')} {value}" for name, value in request.given.items()]
    design = ["lbt-synth design", f"{stem}.yaml --method {request.method.name}", *options]
    return (
        " ".join((*design, f"-o {stem}.fits")),
        f"lbt-synth report {stem}.yaml {stem}.fits -o {stem}.html",
    )
