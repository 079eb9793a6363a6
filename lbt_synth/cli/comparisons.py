"""The commands compare, limits, tradeoff, mirror and robustness: designs in a configured loop."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np

from lbt_synth import studies
from lbt_synth.cli.arguments import command_options, given_options
from lbt_synth.cli.loop_inputs import (
    load_designs,
    load_shown,
    margin_columns,
    named_difference_notes,
    own_sensor_notes,
    say_limit,
    say_residual,
    truth_at_sensor_gain,
)
from lbt_synth.cli.output import BRIEF_ROWS, PERCENT, RMS, Report, spread_indices
from lbt_synth.cli.streams import track_progress
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import ConfigError, ProblemError
from lbt_synth.interop import frame_cost
from lbt_synth.loop import least_residual, loop_margins
from lbt_synth.loop.least_residuals.residual_limit import limit_or_nan
from lbt_synth.methods.registry import reference_methods
from lbt_synth.report.designs.report import refine_values, require_compatible, stable_interval
from lbt_synth.report.figures import robustness_figure, robustness_map_figure
from lbt_synth.report.figures.studies import limits_figure, mirror_figure, tradeoff_figure
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts, fact, facts, row_table
from lbt_synth.storage.words import listing_text
from lbt_synth.studies import LimitRow
from lbt_synth.studies.limits import LimitStudy
from lbt_synth.studies.robustness import FAMILIES, RobustnessMap, default_methods, mirror_rows
from lbt_synth.validation import FloatArray, IntArray, agree, frozen_copy, integer, number


def run_compare(arguments: Namespace) -> Report:
    """Compare gain files in the loop of a configuration, one line each."""
    config = load_shown(arguments)
    designs = load_designs(arguments.gains, config)
    study = _study_limits(config, designs)
    rows = [_compared(designs[row.design], row, config) for row in study.rows]
    report = Report(verdict=_say_designs(study.rows, study))
    if tough := [row for row in rows if row.modulus is not None]:
        row = max(tough, key=lambda row: float(row.modulus))
        frames = min(row.delay_frames, row.early_frames)
        decibels = min(row.gain_less_db, row.gain_more_db)
        report.verdict.append(
            f"{row.design} has the largest margin, and survives {frames:.2g} frames of delay or "
            f"{decibels:.2g} dB of sensor gain, either way."
        )
    caption = f"In the truth of {config.source.name}; {config.imaging.label}"
    report.add_rows("designs", caption, rows, figure=lambda: limits_figure(study))
    report.data["limit_nm"] = None if study.limit is None else study.limit.rms_nm
    report.notes += named_difference_notes(config, designs)
    return report


def _compared(design: Design, row: LimitRow, config: Config) -> Facts:
    """Return the line of a design: what it leaves, what its loop survives, and what it costs."""
    loop = design.close(config.hardware, sensor_gain=config.truth.sensor_gain)
    margins = loop_margins(loop) if row.stable and not loop.reads_others else None
    cost = None if design.other_sensors else frame_cost(design).multiplications
    return facts(
        design=fact(row.design, "design"),
        residual_nm=fact(row.residual_nm, "residual", missing="unstable", **RMS),
        strehl=fact(row.strehl, "Strehl", **PERCENT),
        **margin_columns(margins),
        n_states=fact(design.controller.n_states, "states"),
        multiplications=fact(cost, "products per frame"),
    )


def _study_limits(config: Config, designs: Mapping[str, Design]) -> LimitStudy:
    return studies.limits(
        designs, config.hardware, config.truth, config.imaging, errors_hz=config.errors_hz
    )


def _say_designs(rows: Sequence[LimitRow], study: LimitStudy) -> list[str]:
    """Return which designs are unstable in the truth, and what the best of the others leaves."""
    unstable = [row.design for row in rows if not row.stable]
    verbs = "is" if len(unstable) == 1 else "are"
    verdict = [f"{listing_text(unstable)} {verbs} unstable in the truth."] if unstable else []
    if stable := [row for row in rows if row.stable]:
        best = min(stable, key=lambda row: row.residual_nm)
        verdict.append(say_residual(best.design, best, study.limit))
    return verdict


def run_limits(arguments: Namespace) -> Report:
    """Compare designs with the least residual of any linear controller."""
    config = load_shown(arguments)
    files = load_designs(arguments.gains, config)
    designs = {
        method.name: config.design(method.name, **method.in_comparison)
        for method in reference_methods()
    }
    designs |= {f"{name} (file)" if name in designs else name: d for name, d in files.items()}
    study = _study_limits(config, designs)
    no_band = () if study.band is not None else ("above_band_limit_percent",)
    report = Report(verdict=_say_designs(study.rows, study))
    report.add_rows(
        "rows",
        f"Distance to the limits of any linear controller; {config.imaging.label}",
        study.rows,
        without=no_band,
        hidden=() if study.shift_hz.size else ("worst_nm",),
        figure=lambda: limits_figure(study),
    )
    report.data["limit_nm"] = None if study.limit is None else study.limit.rms_nm
    if study.band is not None and study.band_hz is not None:
        report.data |= {
            "band_hz": study.band_hz,
            "band_limit_nm": study.band.rms_nm,
            "band_achieved_nm": study.band.achieved_nm,
        }
        low, high = study.band_hz
        report.verdict.append(
            f"With the vibration anywhere from {low:g} to {high:g} Hz, the least worst residual is "
            f"{nm_text(study.band.rms_nm, '.6g', unit='nm rms')} (a filter of infinite order "
            f"achieves {nm_text(study.band.achieved_nm, '.6g')})."
        )
    report.notes += [*_limit_notes(study, config), *named_difference_notes(config, designs)]
    return report


def _limit_notes(study: LimitStudy, config: Config) -> list[str]:
    """Return what the limit is of, and which rows compare something else than they seem to."""
    if study.limit is None:
        notes = [
            "note: the limit of this loop cannot be computed; its modes have to decouple, with "
            "vibrations along principal axes of the sensor's noise."
        ]
    else:
        within = " (of sinusoids of known frequency, what moves within frames)"
        notes = [say_limit(study.limit, config) + within * (study.band is not None)]
    if config.truth.vibrations and not config.plant.vibrations:
        notes.append(
            "note: kalman and hinf are designed without a vibration, as model.vibrations is "
            "missing; the truth has one."
        )
    if study.band is None and len(config.truth.vibrations) > 1:
        notes.append("note: the limit over a range of frequencies is that of a single sinusoid.")
    return notes


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
    mixed = [point for point in points if point.family == FAMILIES[0]]
    first, last, least = mixed[0], mixed[-1], points[0].design
    caption = "Trade-off of variance, norm and sensor gain"
    report = Report(tables=[row_table(f"{caption}, by the mixed filter", mixed)])
    report.add_rows(
        "points", caption, points, without=("design",), figure=lambda: tradeoff_figure(points)
    )
    report.data |= {"gamma_least": least.gamma_least, "gamma_infeasible": least.gamma_infeasible}
    report.verdict = [
        f"Lowering the norm of the error from {nm_text(last.gamma, '.1f')} to "
        f"{nm_text(first.gamma, '.1f')} raises its rms from {nm_text(last.rms, '.1f')} to "
        f"{nm_text(first.rms, '.1f')}.",
        f"The least norm of any filter lies between {nm_text(least.gamma_infeasible, '.9g')} and "
        f"{nm_text(least.gamma_least, '.9g')}.",
    ]
    report.notes += own_sensor_notes(config)
    return report


def run_mirror(arguments: Namespace) -> Report:
    """Show how the mirror of a configuration settles, and compare designs on it."""
    config = load_shown(arguments)
    plant, shell = config.plant.own_sensor_alone(), config.hardware.mirror
    if shell is None:
        raise ConfigError(
            f"{config.source}: the key mirror.local_loop is missing: without it the mirror settles "
            "at once. lbt_slow_mirror.yaml of lbt-synth init --examples has it.",
            path="mirror.local_loop",
        )
    hardware, step = plant.hardware, shell.step_response(arguments.tolerance)
    rows = mirror_rows(
        plant, config.truth, config.imaging, command_weight=config.settings.design.command_weight
    )
    limit_nm = limit_or_nan(lambda: least_residual(hardware, config.truth))
    least = "least residual of any linear controller in the truth"
    ms = {"unit": "ms", "scale": 1e3}
    frames = step.settling_s / hardware.dt_s
    best = min((row for row in rows if row.stable), key=lambda row: float(row.residual_nm))
    report = Report(data={"taps": hardware.mirror_taps})
    report.verdict = [f"{row.design}: unstable on this mirror." for row in rows if not row.stable]
    report.verdict += [
        f"{best.design} leaves least, {nm_text(best.residual_nm, '.1f')} rms (Strehl ratio "
        f"{100 * best.strehl:.1f} %).",
        f"The mirror settles within {1e3 * step.settling_s:.3g} ms, {frames:.2g} frames.",
    ]
    report.add_rows(
        "rows",
        f"Designs on this mirror; {config.imaging.label}",
        rows,
        figure=lambda: mirror_figure(hardware, tolerance=arguments.tolerance),
    )
    report.add_facts(
        "The mirror after a step of its command",
        facts(
            rise_s=fact(step.rise_s, "rise, 10 % to 90 %", **ms),
            overshoot=fact(step.overshoot, "overshoot", unit="%", scale=100),
            tolerance=fact(step.tolerance, "tolerance of the settling time", unit="%", scale=100),
            settling_s=fact(step.settling_s, "settling time", **ms),
            settling_frames=fact(frames, "  in frames", unit="frames"),
            bandwidth_hz=fact(shell.bandwidth_hz, "bandwidth, -3 dB", unit="Hz"),
            frame_s=fact(hardware.dt_s, "one frame", **ms),
            limit_nm=fact(limit_nm, least, unit="nm rms", format=".2f"),
        ),
    )
    taps = [f"{tap:.4f}" for tap in hardware.mirror_taps[:BRIEF_ROWS]]
    more = ", ..." * (hardware.mirror_taps.size > BRIEF_ROWS)
    report.notes.append(f"weights of u(k), u(k-1), ... in exposure k: {', '.join(taps)}{more}")
    return report


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
            why += ", ".join(names[option] for option in maps)
        raise ProblemError(f"{names[name]} {why}.")


def _redesign(config: Config, arguments: Namespace) -> Report:
    """Design filters for the true frequency at each error."""
    settings, errors, ratio = config.settings, config.errors_hz, arguments.gamma_ratio
    methods = default_methods()
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
            total=len(errors) * len(methods),
            what="designs",
        )
    )
    by_method = {name: [row for row in rows if row.method == name] for name in methods}
    caption = f"Robustness to the vibration frequency; {config.imaging.label}"
    centre = int(np.argmin(np.abs(errors)))
    places = spread_indices(len(errors), centre)
    columns = [
        facts(
            error_hz=fact(errors[place], "error", unit="Hz", format="+.2f"),
            **{f"{n}_strehl": fact(r[place].strehl, n, **PERCENT) for n, r in by_method.items()},
            **{f"{n}_nm": fact(r[place].residual_nm, n, **RMS) for n, r in by_method.items()},
        )
        for place in places
    ]
    report = Report(tables=[row_table(f"{caption}, and residual", columns)])
    report.verdict = [
        f"{name} has a Strehl ratio of {100 * r[centre].strehl:.1f} % at an error of "
        f"{errors[centre]:+g} Hz, and of {_worst_text([row.strehl for row in r])} at worst."
        for name, r in by_method.items()
    ]
    report.add_rows("rows", caption, rows, figure=lambda: robustness_figure(rows))
    report.notes += own_sensor_notes(config)
    return report


def _worst_text(strehls: Sequence[float]) -> str:
    return "none (unstable)" if np.isnan(strehls).any() else f"{100 * min(strehls):.1f} %"


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
    maps, intervals = {}, {}
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
        intervals[name] = _stable_gains(design, maps[name], assumed[name])
    real = int(np.argmin(np.abs(gains - config.sensor_gain * config.truth.sensor_gain)))
    where = f"frequency errors of {np.min(errors):+g} to {np.max(errors):+g} Hz"
    report = Report(figure=lambda: robustness_map_figure(maps))
    report.data["maps"] = {
        name: asdict(grid) | {"stable_sensor_gains": intervals[name]} for name, grid in maps.items()
    }
    report.rows = [point for name, grid in maps.items() for point in _map_points(name, grid)]
    lines = [
        line for name in maps for line in _map_lines(name, maps[name], [real], intervals[name])
    ]
    title = f"{config.imaging.label}, over {where}"
    report.tables.append(row_table(f"At a sensor gain of {gains[real]:.3g}: {title}", lines))
    report.verdict = _say_maps(maps, lines, where)
    shown = spread_indices(gains.size, real)
    for name, grid in maps.items():
        rows = list(_map_lines(name, grid, shown, intervals[name]))
        report.tables.append(row_table(f"{name}: {title}", rows))
        report.notes += _map_notes(name, designs[name], config)
    return report


def _say_maps(maps: Mapping[str, RobustnessMap], lines: Sequence[Facts], where: str) -> list[str]:
    """Return where designs are unstable, and which keeps the highest Strehl ratio at worst."""
    verdict = [
        f"{name} is unstable at {count} of {grid.stable.size} pairs of a sensor gain and a delay "
        "error of its map."
        for name, grid in maps.items()
        if (count := np.count_nonzero(~grid.stable))
    ]
    worst = {line.file: [x.worst for x in lines if x.file == line.file] for line in lines}
    lowest = {name: float(np.min(values)) for name, values in worst.items()}  # nan if unstable
    if stable := {name: value for name, value in lowest.items() if not np.isnan(value)}:
        best = max(stable, key=lambda name: stable[name])
        verdict.append(
            f"{best} keeps the highest Strehl ratio at worst over {where}, "
            f"{100 * stable[best]:.1f} %."
        )
    return verdict


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


def _map_lines(
    name: str,
    grid: RobustnessMap,
    shown: Sequence[int] | IntArray,
    intervals: Sequence[tuple[float, float]],
) -> Iterator[Facts]:
    """Yield a row for some sensor gains at each delay error, with its worst frequency error."""
    for i, (delay, (low, high)) in enumerate(zip(grid.delay_errors_frames, intervals, strict=True)):
        for j in shown:
            stable, strehls = bool(grid.stable[i, j]), grid.strehl[i, j]
            worst = int(np.argmin(strehls)) if stable else 0
            centre = strehls[grid.errors_hz == 0]
            at_hz = grid.errors_hz[worst] if stable else np.nan
            yield facts(
                file=fact(name, "file"),
                sensor_gain=fact(grid.sensor_gains[j], "sensor gain", format=".3f"),
                delay_error=fact(delay, "delay error", unit="frames", format="+g"),
                stable=fact(stable, "stable"),
                centre=fact(centre[0] if centre.size else np.nan, "Strehl at 0 Hz", **PERCENT),
                worst=fact(strehls[worst], "worst Strehl", **PERCENT),
                worst_hz=fact(at_hz, "at", unit="Hz", format="+.2f"),
                low=fact(low, "stable gains, from", format=".4g"),
                high=fact(high, "to", format=".4g"),
            )


def _map_notes(name: str, design: Design, config: Config) -> list[str]:
    """Return in what a design was made for another loop, whose map this is."""
    hardware, notes = require_hardware(design, "a map"), []
    if hardware.delay_frames != config.hardware.delay_frames:
        notes.append(
            f"note: {name} was designed for a delay of {hardware.delay_frames:g} frames, from "
            f"which its delay errors count; the configuration has "
            f"{config.hardware.delay_frames:g}."
        )
    if hardware.mirror != config.hardware.mirror:
        notes.append(
            f"note: {name} was designed for another mirror than the configuration's, and its map "
            "is that of its own."
        )
    return notes
