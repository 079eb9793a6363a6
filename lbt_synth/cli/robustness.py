"""The command robustness: filters redesigned at each frequency error, or maps of gain files."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np

from lbt_synth import studies
from lbt_synth.cli.argument_kinds import given_options
from lbt_synth.cli.loop_inputs import (
    load_designs,
    load_shown,
    own_sensor_notes,
    truth_at_sensor_gain,
)
from lbt_synth.cli.output import Report
from lbt_synth.cli.output_files import require_outputs, write_outputs
from lbt_synth.cli.parser import command_options
from lbt_synth.cli.progress import count_progress, track_progress
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import ProblemError
from lbt_synth.loop import Imaging, stable_sensor_gains
from lbt_synth.report.designs.report import refine_values, require_compatible
from lbt_synth.report.figures import robustness_figure, robustness_map_figure
from lbt_synth.storage.rows import Facts, fact, facts, row_table
from lbt_synth.studies import RobustnessMap, robustness_map
from lbt_synth.studies.robustness import default_methods
from lbt_synth.validation import FloatArray, agree, frozen_copy, number

_MOST_VALUES = 2001  # of frequency errors or sensor gains
_LISTED_GAINS = 8  # of more sensor gains, the table shows about so many


def run(arguments: Namespace) -> Report:
    """Compute the Strehl ratio over an error of the vibration frequency."""
    require_outputs(arguments.output, inputs=[arguments.config, *arguments.gains])
    _refuse_unused_options(arguments)
    config = load_shown(arguments)
    return (_map_designs if arguments.gains else _redesign)(config, arguments)


def _refuse_unused_options(arguments: Namespace) -> None:
    """Refuse the options of redesigning beside gain files, and those of maps without them."""
    redesign: tuple[str, ...] = ("sensor_gain", "gamma_ratio")
    maps: tuple[str, ...] = ("errors_hz", "sensor_gains", "delay_errors_frames")
    names = {name: words for name, (words, _) in command_options(arguments.command).items()}
    unused, reason = maps, "goes with gain files, whose designs stay as they are; name some"
    if arguments.gains:
        unused, reason = redesign, "is for redesigning, without gain files; the options of these "
        reason += f"are {', '.join(names[name] for name in maps)}"
    for name in given_options(arguments, *unused):
        raise ProblemError(f"{names[name]} {reason}.")


def _redesign(config: Config, arguments: Namespace) -> Report:
    settings = config.settings
    ratio = arguments.gamma_ratio
    errors = config.errors_hz
    rows = list(
        track_progress(
            studies.robustness(
                config.plant.own_sensor_alone(),
                truth_at_sensor_gain(config, arguments.sensor_gain),
                config.imaging,
                errors_hz=errors,
                gamma_ratio=settings.design.gamma_ratio if ratio is None else ratio,
                hold=settings.robustness.hold,
            ),
            total=len(errors) * len(default_methods()),
            what="designs",
            quiet=arguments.json,
        )
    )
    report = Report()
    caption = f"Robustness to the vibration frequency; {config.imaging.label}"
    report.add_rows("rows", caption, rows)
    report.notes += own_sensor_notes(config)
    write_outputs(report, arguments.output, rows, figure=lambda: robustness_figure(rows))
    return report


def _map_designs(config: Config, arguments: Namespace) -> Report:
    """Map the Strehl ratio of gain files over frequency error, sensor gain and delay error."""
    settings = config.settings.robustness
    errors = _parse_range(arguments.errors_hz, "--errors-hz", refine_values(config.errors_hz))
    gains = _parse_range(arguments.sensor_gains, "--sensor-gains", settings.sensor_gains)
    delays = arguments.delay_errors_frames or settings.delay_errors_frames
    for gain in gains:
        number(gain, "--sensor-gains", above=0)
    designs = load_designs(arguments.gains)
    assumed = {name: _assumed_gain(name, d, config) for name, d in designs.items()}
    maps = {}
    total = len(designs) * errors.size * gains.size * len(delays)
    with count_progress(total=total, what="points", quiet=arguments.json) as count:
        for name, design in designs.items():
            found = robustness_map(
                design,
                config.truth,
                config.imaging,
                errors_hz=errors,
                sensor_gains=gains / assumed[name],
                delay_errors_frames=delays,
                advance=count,
            )
            maps[name] = replace(found, sensor_gains=frozen_copy(gains))  # the real ones again
    report = Report(data={"maps": {}})
    for name, found in maps.items():
        intervals = _stable_gains(designs[name], found, assumed[name])
        report.data["maps"][name] = asdict(found) | {"stable_sensor_gains": intervals}
        report.tables.append(row_table(_map_title(name, found, config.imaging), _map_lines(found)))
        report.notes += _map_notes(name, designs[name], config, found, intervals)
    write_outputs(
        report,
        arguments.output,
        [point for name, found in maps.items() for point in _map_points(name, found)],
        figure=lambda: robustness_map_figure(maps),
    )
    return report


def _parse_range(
    given: Sequence[float] | None, option: str, default: Sequence[float] | FloatArray
) -> FloatArray:
    """Return the values of LOW HIGH COUNT, or those of the configuration where none are given."""
    if given is None:
        return np.array(default)
    low, high, count = (number(value, option) for value in given)
    if not (low < high and count.is_integer() and 2 <= count <= _MOST_VALUES):
        raise ProblemError(
            f"{option} must be LOW HIGH COUNT with LOW below HIGH and a COUNT of 2 to "
            f"{_MOST_VALUES}; got {low:g} {high:g} {count:g}."
        )
    return np.linspace(low, high, int(count))


def _assumed_gain(name: str, design: Design, config: Config) -> float:
    """Return the sensor gain that a design assumes, relative to ``sensor.matrix``."""
    require_compatible(name, design, config.hardware)
    own, here = require_hardware(design, "a map"), config.hardware
    unit = here.sensor / config.sensor_gain
    gain = float(np.sum(own.sensor * unit) / np.sum(unit**2))
    if not (gain > 0 and agree(own.sensor, gain * unit) and agree(own.influence, here.influence)):
        raise ProblemError(
            f"{name} must have the configuration's sensor and influence matrices, up to a sensor "
            "gain; it has others. Design it for this configuration."
        )
    return gain


def _stable_gains(
    design: Design, found: RobustnessMap, assumed: float
) -> list[tuple[float, float]]:
    """Return the interval of stable real sensor gains at each delay error, or nan for none."""
    hardware, intervals = require_hardware(design, "a map"), []
    for delay, stable in zip(found.delay_errors_frames, found.stable, strict=True):
        real = replace(hardware, delay_frames=hardware.delay_frames + delay)
        # around the gain that the design assumes, if the loop is stable there
        starts = [assumed, *found.sensor_gains[stable]]
        tried = (stable_sensor_gains(real, design.controller, nominal=s / assumed) for s in starts)
        low, high = next((ends for ends in tried if not np.isnan(ends[0])), (np.nan, np.nan))
        intervals.append((low * assumed, high * assumed))
    return intervals


def _map_title(name: str, found: RobustnessMap, imaging: Imaging) -> str:
    low, high = np.min(found.errors_hz), np.max(found.errors_hz)
    return f"{name}: {imaging.label}, over frequency errors of {low:+g} to {high:+g} Hz"


def _map_points(name: str, found: RobustnessMap) -> list[Facts]:
    """Return a row for each point of the map of a gain file."""
    return [
        facts(
            file=fact(name),
            delay_error_frames=fact(float(found.delay_errors_frames[i])),
            sensor_gain=fact(float(found.sensor_gains[j])),
            error_hz=fact(float(found.errors_hz[k])),
            strehl=fact(float(strehl)),
            residual_nm=fact(float(found.residual_nm[i, j, k])),
            stable=fact(bool(found.stable[i, j])),
        )
        for (i, j, k), strehl in np.ndenumerate(found.strehl)
    ]


def _map_lines(found: RobustnessMap) -> list[Facts]:
    """Return a row for some sensor gains at each delay error, with its worst frequency error."""
    gains, lines = found.sensor_gains, []
    shown = np.arange(gains.size)
    if gains.size > _LISTED_GAINS:  # some from end to end, and the one that is nearest to 1
        some = np.linspace(0, gains.size - 1, _LISTED_GAINS - 1).round().astype(int)
        shown = np.unique([*some, int(np.argmin(np.abs(gains - 1)))])
    centre = np.flatnonzero(found.errors_hz == 0)
    percent = {"unit": "%", "scale": 100, "format": ".2f"}
    for i, delay in enumerate(found.delay_errors_frames):
        for j in shown:
            stable, strehls = bool(found.stable[i, j]), found.strehl[i, j]
            worst = int(np.argmin(strehls)) if stable else 0
            worst_hz = found.errors_hz[worst] if stable else np.nan
            at_centre = strehls[centre[0]] if centre.size else np.nan
            lines.append(
                facts(
                    sensor_gain=fact(gains[j], "sensor gain", format=".3f"),
                    delay_error=fact(delay, "delay error", unit="frames", format="+g"),
                    stable=fact(stable, "stable"),
                    centre=fact(at_centre, "Strehl at 0 Hz", **percent),
                    worst=fact(strehls[worst], "worst Strehl", **percent),
                    worst_hz=fact(worst_hz, "at", unit="Hz", format="+.2f"),
                )
            )
    return lines


def _map_notes(
    name: str,
    design: Design,
    config: Config,
    found: RobustnessMap,
    intervals: list[tuple[float, float]],
) -> list[str]:
    notes = []
    for delay, (low, high) in zip(found.delay_errors_frames, intervals, strict=True):
        late = f" with a delay error of {delay:+g} frames" if delay != 0 else ""
        ends = "none found" if np.isnan(low) else f"{low:.4g} to {high:.4g}"
        notes.append(f"{name}: stable sensor gains{late}: {ends}")
    own = require_hardware(design, "a map")
    if own.delay_frames != config.hardware.delay_frames:
        notes.append(
            f"note: {name} was designed for a delay of {own.delay_frames:g} frames, from which "
            f"its delay errors count; the configuration has {config.hardware.delay_frames:g}."
        )
    if own.mirror != config.hardware.mirror:
        notes.append(
            f"note: {name} was designed for another mirror than the configuration's, and its map "
            "is that of its own."
        )
    return notes
