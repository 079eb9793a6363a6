"""The unit that a command shows wavefronts in: ``--unit``, or ``units`` of its configuration."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import numpy as np

from lbt_synth.config import Config, load_config
from lbt_synth.config.load import config_from_text
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.models import nm_per_mas
from lbt_synth.storage.display_unit import LENGTHS, UNITS, DisplayUnit, show_in

_MAS_PER_URAD = np.degrees(1e-6) * 3.6e6


def choose_unit(
    arguments: Namespace, diameter_m: float | None = None, configured: str | None = None
) -> None:
    """Show wavefronts in the unit that was asked for; an angle needs the telescope's diameter."""
    asked = getattr(arguments, "show_unit", None) or arguments.unit
    name = (asked if asked in UNITS else None) or configured or "nm"
    if name in LENGTHS:
        show_in(DisplayUnit(name=name, nm=LENGTHS[name]))
        return
    if diameter_m is None:
        raise ProblemError(
            f"a wavefront is shown in {name} by the telescope's diameter, which is not known here. "
            "Give telescope.diameter_m in the configuration, --diameter-m with a record, or take "
            "nm."
        )
    mas = nm_per_mas(diameter_m)
    show_in(DisplayUnit(name=name, nm=mas if name == "mas" else mas * _MAS_PER_URAD))


def choose_config_unit(arguments: Namespace, config: Config) -> Config:
    """Show wavefronts in the unit that was asked for, or in that of a configuration."""
    choose_unit(arguments, config.imaging.diameter_m, config.settings.units)
    return config


def load_shown(arguments: Namespace) -> Config:
    """Load the configuration of a command, and show wavefronts in its unit."""
    return choose_config_unit(arguments, load_config(arguments.config))


def choose_wavefront_unit(arguments: Namespace) -> None:
    """Show wavefronts of all modes in the unit that was asked for, which cannot be an angle."""
    if arguments.unit not in (None, *LENGTHS):
        raise ProblemError(
            f"--unit {arguments.unit} is an angle of tip and tilt, and this command shows other "
            f"modes, too. Try {' or '.join(LENGTHS)}."
        )
    choose_unit(arguments)


def choose_design_unit(arguments: Namespace, *designs: Design) -> None:
    """Show wavefronts in the unit that was asked for, by the configurations in gain files."""
    if arguments.unit is None:
        return
    texts = {each.configuration for each in designs if each.configuration}
    found = {config_from_text(text, Path("gain file")).imaging.diameter_m for text in texts}
    choose_unit(arguments, found.pop() if len(found) == 1 else None)
