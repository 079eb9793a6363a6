"""What several commands load and say: designs, truths, units, and reference designs."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.cli.output import Report
from lbt_synth.cli.streams import printable
from lbt_synth.config import Config, load_config
from lbt_synth.config.load import config_from_text
from lbt_synth.design import Design
from lbt_synth.design.certificate import say_checks
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import ProblemError
from lbt_synth.files import load_gain
from lbt_synth.loop.margins import LoopMargins
from lbt_synth.methods.registry import design_title
from lbt_synth.models import nm_per_mas
from lbt_synth.models.loop_hardware import loop_differences
from lbt_synth.report.screen import say_limit, say_residual
from lbt_synth.storage.display_unit import LENGTHS, nm_text, show_in, shown_unit
from lbt_synth.storage.rows import Column, fact
from lbt_synth.studies.limits import compare_in_truth

_MAS_PER_URAD = np.degrees(1e-6) * 3.6e6
_WITHOUT = ("worst_nm", "above_band_limit_percent", "method")  # columns
_NAME, _BASELINE = "this design", "integrator"


def choose_unit(
    arguments: Namespace,
    diameter_m: float | None = None,
    usual: str | None = None,
    *,
    all_modes: bool = False,
) -> None:
    """Show wavefronts in the unit of the option, else in the usual one, else in nm.

    That is the unit of the configuration, or of a record or gain file where there is none. An angle
    needs the telescope's diameter, and is none of modes beside tip and tilt.
    """
    asked = arguments.show_unit if hasattr(arguments, "show_unit") else arguments.unit
    if asked not in (None, *LENGTHS) and all_modes:
        raise ProblemError(
            f"--unit {asked} is an angle of tip and tilt, and this command shows other modes, "
            f"too. Try {' or '.join(LENGTHS)}."
        )
    usual = "nm" if all_modes and usual not in LENGTHS else usual
    name = asked or usual or "nm"
    if name in LENGTHS:
        show_in(name, LENGTHS[name])
        return
    if diameter_m is None:
        place = "telescope.diameter_m in the configuration (of a gain file: and design again)"
        raise ProblemError(
            f"a wavefront is shown in {name} by the telescope's diameter, which is not known here. "
            f"Give {'--diameter-m' if hasattr(arguments, 'diameter_m') else place}, or take nm."
        )
    mas = nm_per_mas(diameter_m)
    show_in(name, mas if name == "mas" else mas * _MAS_PER_URAD)


def load_shown(
    arguments: Namespace, config: Config | None = None, *, all_modes: bool = False
) -> Config:
    """Load the configuration of a command, if it has none, and show wavefronts in its unit."""
    config = load_config(arguments.config) if config is None else config
    choose_unit(arguments, config.imaging.diameter_m, config.settings.units, all_modes=all_modes)
    return config


def choose_design_unit(arguments: Namespace, designs: Mapping[str, Design]) -> None:
    """Show wavefronts in the unit that gain files, or the configurations in them, agree on."""
    telescopes = set[tuple[float | None, str | None]]()
    for path, design in designs.items():
        if design.shown_unit is not None:
            telescopes.add((design.diameter_m, design.shown_unit))
        elif design.configuration:
            config = config_from_text(design.configuration, Path(path))
            telescopes.add((config.imaging.diameter_m, config.settings.units))
    choose_unit(arguments, *(telescopes.pop() if len(telescopes) == 1 else ()))


def keep_unit(design: Design, diameter_m: float | None) -> Design:
    """Return a design that its gain file shows as this command does."""
    return replace(design, diameter_m=diameter_m, shown_unit=shown_unit("nm")[0])


def load_design(path: str, config: Config | None = None) -> Design:
    """Load a design; refuse one that reads other sensors, which the truth of no file moves."""
    design = load_gain(path)
    if not design.other_sensors:
        return design
    if config is None:
        raise ProblemError(
            f"{path} is a design of several sensors; this command takes designs of the loop's own "
            "sensor alone. Try show, verify, limits, simulate, or export --for c."
        )
    channels = require_hardware(design, "a loop").suite.channels
    moved = {name for motion in config.truth.motions for name in motion}
    if design.plant is None and channels and moved.isdisjoint(channels):
        first = ", ".join([channels[0], *["..."][: len(channels) - 1]])
        shows = nm_text(design.expected_residual_nm or np.nan)
        raise ProblemError(
            f"{path} reads {first}, which nothing in the truth of {config.source.name} moves; its "
            f"record shows {shows}: lbt-synth show {path}."
        )
    return design


def load_designs(paths: list[str], config: Config | None = None) -> dict[str, Design]:
    """Load designs, named by the stems of their files.

    With a configuration, they may read other sensors, too.
    """
    names = [printable(Path(path).stem) for path in paths]
    if len(set(names)) != len(names):
        raise ProblemError(f"each gain file must have a name of its own; got {', '.join(paths)}.")
    return {name: load_design(path, config) for name, path in zip(names, paths, strict=True)}


def say_accelerometers(design: Design) -> str:
    """Return what accelerometers buy on the record of a predictor; empty for other designs."""
    with_nm, without_nm = (design.claims.get(name) for name in ("residual_nm", "alone_nm"))
    if with_nm is None or without_nm is None:
        return ""
    return f"{nm_text(with_nm)} with the accelerometers, {nm_text(without_nm)} without them"


def difference_notes(config: Config, designs: Mapping[str, Design]) -> list[str]:
    """Say which designs were made for another loop than the configuration's, and for which."""
    notes = []
    for name, design in designs.items():
        if design.hardware is None:
            continue
        differences = loop_differences(design.hardware, config.hardware)
        if design.other_sensors and not config.hardware.suite.is_same(design.hardware.suite):
            differences.append(
                "runs with the sensors of the gain file beside the loop's own, not with those of "
                "the configuration."
            )
        notes += [f"note: {difference[:-1]} ({name})." for difference in differences]
    return notes


def add_certificate(report: Report, design: Design) -> None:
    """Add whether a design passed its certificate, and what it assumes."""
    place = len(report.verdict) if design.certificate.passed else 0  # a failure comes first
    report.verdict.insert(place, say_checks(design.certificate.checks))
    report.data |= {"certificate": design.certificate.passed, "assumptions": design.assumptions}
    report.notes += [f"assumes: {assumption}." for assumption in design.assumptions]


def add_truth(
    report: Report, design: Design, config: Config, *, without: Collection[str] = ()
) -> None:
    """Add what a design leaves in the truth, beside reference designs and the limit.

    A reference design that the design is itself is left out.
    """
    if config.truth.drifts:
        report.notes.append(
            "note: a vibration of the truth drifts, so that its residual has no exact value; "
            "lbt-synth simulate runs it."
        )
        return
    comparison = compare_in_truth({_NAME: design}, config, without=without)
    row, *others = comparison.rows
    caption = f"In the truth of {config.source.name}; {config.imaging.label}"
    report.add_rows("truth", caption, comparison.rows, without=_WITHOUT)
    report.data |= {
        "truth_limit_nm": None if comparison.limit is None else comparison.limit.rms_nm,
        "wavelength_um": config.imaging.wavelength_um,
        "truth_warnings": comparison.warnings[_NAME],
    }
    warnings = comparison.warnings[_NAME]
    if row.stable:
        report.verdict.append(
            say_residual(f"The {design_title(design.method)}", row, comparison.limit)
        )
        if slow := [other for other in others if other.design == _BASELINE and other.stable]:
            residual = nm_text(slow[0].residual_nm, ".1f")
            said = report.verdict[-1].removesuffix(".")
            report.verdict[-1] = f"{said}; the best {_BASELINE} leaves {residual}."
    else:
        report.verdict.append(f"{warnings[0][0].upper()}{warnings[0][1:]} of {config.source.name}.")
        warnings = warnings[1:]
    if comparison.limit is not None:
        report.notes.append(say_limit(comparison.limit, config))
    report.notes += [f"warning: {text}." for text in warnings]
    report.notes += [f"note: {text}" for text in comparison.notes]


def margin_columns(margins: LoopMargins | None) -> dict[str, tuple[Any, Column]]:
    """Return the facts of what a loop survives, alone; None where it is unstable."""
    less, more = getattr(margins, "gain_errors_db", (None, None))
    frames, decibels = ({"unit": u, "format": f} for u, f in (("frames", ".2f"), ("dB", ".1f")))
    return {
        "delay_frames": fact(getattr(margins, "delay_frames", None), "late by", **frames),
        "early_frames": fact(getattr(margins, "early_frames", None), "early by", **frames),
        "gain_less_db": fact(less, "gain down", **decibels),
        "gain_more_db": fact(more, "gain up", **decibels),
        "modulus": fact(getattr(margins, "modulus", None), "modulus margin", format=".3f"),
    }
