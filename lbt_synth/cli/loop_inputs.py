"""What several commands put into a loop: options, designs and truths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from lbt_synth.cli.streams import printable
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.files import load_gain
from lbt_synth.models import Truth
from lbt_synth.models.loop_hardware import loop_differences


def load_design(path: str, *, any_sensors: bool = False) -> Design:
    """Load a design; refuse one that reads other sensors unless the command takes it."""
    design = load_gain(path)
    if any_sensors or not design.other_sensors:
        return design
    raise ProblemError(
        f"{path} is a design of several sensors; this command takes designs of the loop's own "
        "sensor alone. Try show, verify, limits, simulate, or export --for c."
    )


def load_designs(paths: list[str], *, any_sensors: bool = False) -> dict[str, Design]:
    """Load designs, named by the stems of their files or, where these repeat, by longer tails."""
    if len({Path(path).resolve() for path in paths}) != len(paths):
        raise ProblemError(f"each gain file must be given once; got {', '.join(paths)}.")
    stems = [printable(Path(path).stem) for path in paths]
    names = stems if len(set(stems)) == len(stems) else _distinct_tails(paths)
    return {
        name: load_design(path, any_sensors=any_sensors)
        for name, path in zip(names, paths, strict=True)
    }


def _distinct_tails(paths: list[str]) -> list[str]:
    """Return the last parts of different paths, as few as distinguish all of them."""
    whole = [Path(path).resolve().parts for path in paths]
    for count in range(1, max(map(len, whole))):
        names = [printable("/".join(parts[-count:])) for parts in whole]
        if len(set(names)) == len(names):
            return names
    return paths


def loop_difference_notes(config: Config, design: Design) -> list[str]:
    """Say where a design was made for another loop than the configuration's."""
    notes = []
    if design.hardware is not None:
        notes = loop_differences(design.hardware, config.hardware)
        if design.other_sensors and not config.hardware.suite.is_same(design.hardware.suite):
            notes.append(
                "runs with the sensors of the gain file beside the loop's own, not with those of "
                "the configuration."
            )
    return [f"note: {text}" for text in notes]


def named_difference_notes(config: Config, designs: Mapping[str, Design]) -> list[str]:
    """Say so of designs by their names."""
    return [
        f"{note[:-1]} ({name})."
        for name, design in designs.items()
        for note in loop_difference_notes(config, design)
    ]


def own_sensor_notes(config: Config) -> list[str]:
    """Say that other sensors are not read, if the configuration has some."""
    others = config.other_sensors
    return [f"note: the loop's own sensor is read alone, without {others}."] if others else []


def truth_at_sensor_gain(config: Config, sensor_gain: float | None) -> Truth:
    """Return the configuration's truth, at the real sensor gain of the command line if given."""
    if sensor_gain is None:
        return config.truth
    return replace(config.truth, sensor_gain=sensor_gain / config.sensor_gain)
