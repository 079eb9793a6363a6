"""The commands limits, tradeoff, mirror and robustness: designs in the loop of a configuration."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace

import numpy as np

from lbt_synth import studies
from lbt_synth.cli.arguments import given_options
from lbt_synth.cli.loop_inputs import (
    load_designs,
    load_shown,
    named_difference_notes,
    own_sensor_notes,
    say_limit,
    truth_at_sensor_gain,
)
from lbt_synth.cli.output import Report
from lbt_synth.cli.parser import command_options
from lbt_synth.cli.streams import track_progress
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import ConfigError, ProblemError
from lbt_synth.loop import least_residual
from lbt_synth.loop.least_residuals.residual_limit import limit_or_nan
from lbt_synth.methods.registry import reference_methods
from lbt_synth.models import PositionLoop
from lbt_synth.report.designs.report import refine_values, require_compatible, stable_interval
from lbt_synth.report.figures import robustness_figure, robustness_map_figure
from lbt_synth.report.figures.studies import limits_figure, mirror_figure, tradeoff_figure
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts, fact, facts, row_table
from lbt_synth.studies.limits import LimitStudy
from lbt_synth.studies.robustness import FAMILIES, RobustnessMap, default_methods, mirror_rows
from lbt_synth.validation import FloatArray, agree, frozen_copy, integer, number

_SHOWN = 8  # sensor gains of a map, and taps of a mirror, that are printed of more


def run_limits(arguments: Namespace) -> Report:
    """Compare designs with the least residual of any linear controller."""
    config = load_shown(arguments)
    files = load_designs(arguments.gains, any_sensors=True)
    designs = {
        method.name: config.design(method.name, **method.in_comparison)
        for method in reference_methods()
    }
    designs |= {f"{name} (file)" if name in designs else name: d for name, d in files.items()}
    study = studies.limits(
        designs, config.hardware, config.truth, config.imaging, errors_hz=config.errors_hz
    )
    no_band = () if study.band is not None else ("above_band_limit_percent",)
    report = Report()
    report.add_rows(
        "rows",
        f"Distance to the limits of any linear controller; {config.imaging.label}",
        study.rows,
        without=no_band,
        hidden=() if study.shift_hz.size else ("worst_nm",),
        figure=lambda: limits_figure(study),
    )
    report.data["limit_nm"] = None if study.limit is None else study.limit.rms_nm
    if study.band is not None:
        report.data |= {
            "band_hz": study.band_hz,
            "band_limit_nm": study.band.rms_nm,
            "band_achieved_nm": study.band.achieved_nm,
        }
    report.notes += [*_limit_notes(study, config), *_design_notes(config, designs, study)]
    return report


def _limit_notes(study: LimitStudy, config: Config) -> list[str]:
    if study.limit is None:
        return [
            "note: the limit of this loop cannot be computed; its modes have to decouple, with "
            "vibrations along principal axes of the sensor's noise."
        ]
    notes = [
        say_limit(study.limit, config)
        + (
            " (of sinusoids of known frequency, what moves within frames)"
            if study.band is not None
            else ""
        )
    ]
    if study.band is not None and study.band_hz is not None:
        low, high = study.band_hz
        notes.append(
            f"least worst residual with the vibration anywhere from {low:g} to {high:g} Hz: "
            f"{nm_text(study.band.rms_nm, '.6g', unit='nm rms')} (a filter of infinite order "
            f"achieves {nm_text(study.band.achieved_nm, '.6g')})"
        )
    return notes


def _design_notes(config: Config, designs: dict[str, Design], study: LimitStudy) -> list[str]:
    """Warn of rows that compare something else than they seem to."""
    notes = []
    if config.truth.vibrations and not config.plant.vibrations:
        notes.append(
            "note: kalman and hinf are designed without a vibration, as model.vibrations is "
            "missing; the truth has one."
        )
    if study.band is None and len(config.truth.vibrations) > 1:
        notes.append("note: the limit over a range of frequencies is that of a single sinusoid.")
    return notes + named_difference_notes(config, designs)


def run_tradeoff(arguments: Namespace) -> Report:
    """Design filters from the least norm to the least variance, and compare them."""
    count = integer(arguments.points, "--points", at_least=2)
    taps = integer(arguments.taps, "--taps", at_least=1)
    config = load_shown(arguments)
    points = list(
        track_progress(
            studies.tradeoff(config.plant.own_sensor_alone(), points=count, taps=taps),
            total=count * len(FAMILIES),
            what="filters",
        )
    )
    least = points[0].design
    report = Report()
    report.add_rows(
        "points",
        "Trade-off of variance, norm and sensor gain",
        points,
        without=("design",),
        figure=lambda: tradeoff_figure(points),
    )
    report.data |= {"gamma_least": least.gamma_least, "gamma_infeasible": least.gamma_infeasible}
    report.notes.append(
        f"the least norm of any filter lies between {nm_text(least.gamma_infeasible, '.9g')} and "
        f"{nm_text(least.gamma_least, '.9g')}"
    )
    report.notes += own_sensor_notes(config)
    return report


def run_mirror(arguments: Namespace) -> Report:
    """Show how the mirror of a configuration settles, and compare designs on it."""
    config = load_shown(arguments)
    plant, shell = config.plant.own_sensor_alone(), _require_local_loop(config)
    hardware = plant.hardware
    step = shell.step_response(arguments.tolerance)
    rows = mirror_rows(
        plant, config.truth, config.imaging, command_weight=config.settings.design.command_weight
    )
    taps = hardware.mirror_taps
    shown = [f"{tap:.4f}" for tap in taps[:_SHOWN]] + ["..."] * (taps.size > _SHOWN)
    report = Report(data={"taps": taps})
    limit_nm = limit_or_nan(lambda: least_residual(hardware, config.truth))
    least = "least residual of any linear controller in the truth"
    per_cent, ms = {"unit": "%", "scale": 100}, {"unit": "ms", "scale": 1e3}
    report.add_facts(
        "The mirror after a step of its command",
        facts(
            rise_s=fact(step.rise_s, "rise, 10 % to 90 %", **ms),
            overshoot=fact(step.overshoot, "overshoot", **per_cent),
            tolerance=fact(step.tolerance, "tolerance of the settling time", **per_cent),
            settling_s=fact(step.settling_s, "settling time", **ms),
            settling_frames=fact(step.settling_s / hardware.dt_s, "  in frames", unit="frames"),
            bandwidth_hz=fact(shell.bandwidth_hz, "bandwidth, -3 dB", unit="Hz"),
            frame_s=fact(hardware.dt_s, "one frame", **ms),
            limit_nm=fact(limit_nm, least, unit="nm rms", format=".2f"),
        ),
    )
    report.add_rows(
        "rows",
        f"Designs on this mirror; {config.imaging.label}",
        rows,
        figure=lambda: mirror_figure(hardware, tolerance=arguments.tolerance),
    )
    report.notes.append(f"weights of u(k), u(k-1), ... in exposure k: {', '.join(shown)}")
    return report


def _require_local_loop(config: Config) -> PositionLoop:
    key, shell = "mirror.local_loop", config.hardware.mirror
    if shell is None:
        raise ConfigError(
            f"{config.source}: the key {key} is missing: without it the mirror settles at once. "
            "lbt_slow_mirror.yaml of lbt-synth init --examples has it.",
            path=key,
        )
    return shell


def run_robustness(arguments: Namespace) -> Report:
    """Compute the Strehl ratio over an error of the vibration frequency."""
    _refuse_unused_options(arguments)
    config = load_shown(arguments)
    return (_map_designs if arguments.gains else _redesign)(config, arguments)


def _refuse_unused_options(arguments: Namespace) -> None:
    """Refuse the options of redesigning beside gain files, and those of maps without them."""
    names = {name: words for name, (words, _) in command_options(arguments.command).items()}
    maps = ("errors_hz", "sensor_gains", "delay_errors_frames")
    unused = ("sensor_gain", "gamma_ratio") if arguments.gains else maps
    for name in given_options(arguments, *unused):
        why = "goes with gain files, whose designs stay as they are; name some"
        if arguments.gains:
            why = "is for redesigning, without gain files; the options of these are "
            why += ", ".join(names[each] for each in maps)
        raise ProblemError(f"{names[name]} {why}.")


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
        )
    )
    report = Report()
    caption = f"Robustness to the vibration frequency; {config.imaging.label}"
    report.add_rows("rows", caption, rows, figure=lambda: robustness_figure(rows))
    report.notes += own_sensor_notes(config)
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
    for name, design in designs.items():
        grid = studies.robustness_map(
            design,
            config.truth,
            config.imaging,
            errors_hz=errors,
            sensor_gains=gains / assumed[name],
            delay_errors_frames=delays,
        )
        maps[name] = replace(grid, sensor_gains=frozen_copy(gains))  # the real ones again
    report = Report(data={"maps": {}}, figure=lambda: robustness_map_figure(maps))
    report.rows = [point for name, grid in maps.items() for point in _map_points(name, grid)]
    for name, grid in maps.items():
        intervals = _stable_gains(designs[name], grid, assumed[name])
        report.data["maps"][name] = asdict(grid) | {"stable_sensor_gains": intervals}
        low, high = np.min(grid.errors_hz), np.max(grid.errors_hz)
        title = f"{name}: {config.imaging.label}, over frequency errors of {low:+g} to {high:+g} Hz"
        report.tables.append(row_table(title, list(_map_lines(grid))))
        report.notes += _map_notes(name, designs[name], config, grid, intervals)
    return report


def _parse_range(
    given: Sequence[float] | None, option: str, default: Sequence[float] | FloatArray
) -> FloatArray:
    """Return the values of LOW HIGH COUNT, or those of the configuration where none are given."""
    if given is None:
        return np.array(default)
    low, high, count = (number(value, option) for value in given)
    if not (low < high and count.is_integer() and count >= 2):
        raise ProblemError(
            f"{option} must be LOW HIGH COUNT with LOW below HIGH and a COUNT of at least 2; got "
            f"{low:g} {high:g} {count:g}."
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


def _stable_gains(design: Design, grid: RobustnessMap, assumed: float) -> list[tuple[float, float]]:
    """Return the interval of stable real sensor gains at each delay error, or nan for none."""
    hardware, intervals = require_hardware(design, "a map"), []
    for delay, stable in zip(grid.delay_errors_frames, grid.stable, strict=True):
        real = replace(hardware, delay_frames=hardware.delay_frames + delay)
        # around the gain that the design assumes, if the loop is stable there
        starts = [1.0, *grid.sensor_gains[stable] / assumed]
        low, high = stable_interval(real, design.controller, starts)
        intervals.append((low * assumed, high * assumed))
    return intervals


def _map_points(name: str, grid: RobustnessMap) -> list[Facts]:
    """Return a row for each point of the map of a gain file."""
    return [
        facts(
            file=fact(name),
            delay_error_frames=fact(float(grid.delay_errors_frames[i])),
            sensor_gain=fact(float(grid.sensor_gains[j])),
            error_hz=fact(float(grid.errors_hz[k])),
            strehl=fact(float(strehl)),
            residual_nm=fact(float(grid.residual_nm[i, j, k])),
            stable=fact(bool(grid.stable[i, j])),
        )
        for (i, j, k), strehl in np.ndenumerate(grid.strehl)
    ]


def _map_lines(grid: RobustnessMap) -> Iterator[Facts]:
    """Yield a row for some sensor gains at each delay error, with its worst frequency error."""
    gains, shown = grid.sensor_gains, np.arange(grid.sensor_gains.size)
    if gains.size > _SHOWN:  # some from end to end, and the one that is nearest to 1
        some = np.linspace(0, gains.size - 1, _SHOWN - 1).round().astype(int)
        shown = np.unique([*some, int(np.argmin(np.abs(gains - 1)))])
    percent = {"unit": "%", "scale": 100, "format": ".2f"}
    for i, delay in enumerate(grid.delay_errors_frames):
        for j in shown:
            stable, strehls = bool(grid.stable[i, j]), grid.strehl[i, j]
            worst = int(np.argmin(strehls)) if stable else 0
            centre = strehls[grid.errors_hz == 0]
            yield facts(
                sensor_gain=fact(gains[j], "sensor gain", format=".3f"),
                delay_error=fact(delay, "delay error", unit="frames", format="+g"),
                stable=fact(stable, "stable"),
                centre=fact(centre[0] if centre.size else np.nan, "Strehl at 0 Hz", **percent),
                worst=fact(strehls[worst], "worst Strehl", **percent),
                worst_hz=fact(
                    grid.errors_hz[worst] if stable else np.nan, "at", unit="Hz", format="+.2f"
                ),
            )


def _map_notes(
    name: str,
    design: Design,
    config: Config,
    grid: RobustnessMap,
    intervals: list[tuple[float, float]],
) -> list[str]:
    notes = []
    for delay, (low, high) in zip(grid.delay_errors_frames, intervals, strict=True):
        late = f" with a delay error of {delay:+g} frames" if delay != 0 else ""
        ends = "none found" if np.isnan(low) else f"{low:.4g} to {high:.4g}"
        notes.append(f"{name}: stable sensor gains{late}: {ends}")
    if unstable := np.count_nonzero(~grid.stable):
        notes.append(
            f"warning: {name} is unstable at {unstable} of {grid.stable.size} pairs of a sensor "
            "gain and a delay error of its map."
        )
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
