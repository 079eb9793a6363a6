"""The commands compare, limits, tradeoff, mirror, robustness and modal: a configured loop."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial

import numpy as np

from lbt_synth import studies
from lbt_synth.cli import loop_inputs
from lbt_synth.cli.loop_inputs import difference_notes, load_designs, load_shown
from lbt_synth.cli.output import Report
from lbt_synth.cli.streams import track_progress
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.interop.c.export import frame_cost
from lbt_synth.loop import loop_margins
from lbt_synth.methods.registry import INTEGRATOR, KALMAN, design_title, reference_methods
from lbt_synth.report.designs import refine_values, require_compatible
from lbt_synth.report.figures import robustness_map_figure
from lbt_synth.report.figures import studies as figures
from lbt_synth.report.screen import say_limit, say_maps, say_residual
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import NM, PERCENT, Facts, fact, facts, row_table
from lbt_synth.storage.words import listing_text, unstable_text
from lbt_synth.studies.limits import LimitStudy, limits, limits_at_rate
from lbt_synth.studies.robustness import FAMILIES, compare_modes, compare_on_mirror
from lbt_synth.validation import FloatArray, frozen_copy, integer, number

_RATES = 34  # frame rates of a comparison, of which a table without --verbose has every third


def run_compare(arguments: Namespace) -> Report:
    """Compare gain files in the loop of a configuration, one line each."""
    config = load_shown(arguments)
    designs = load_designs(arguments.gains, config)
    report, study = _begin(designs, config)
    rows = [_compared(designs[row.design], row, config) for row in study.rows]
    if tough := [row for row in rows if row.modulus is not None]:
        row = max(tough, key=lambda row: float(row.modulus))
        frames = min(row.delay_frames, row.early_frames)
        decibels = min(row.gain_less_db, row.gain_more_db)
        report.verdict.append(
            f"{row.design} has the largest margin, and survives {frames:.2g} frames of delay or "
            f"{decibels:.2g} dB of sensor gain, either way."
        )
    caption = f"In the truth of {config.source.name}; {config.imaging.label}"
    report.add_rows("designs", caption, rows, figure=partial(figures.limits_figure, study))
    report.notes += difference_notes(config, designs)
    return report


def _compared(design: Design, row: Facts, config: Config) -> Facts:
    """Return the line of a design: what it leaves, what its loop survives, and what it costs."""
    loop = design.close(config.hardware, sensor_gain=config.truth.sensor_gain)
    margins = loop_margins(loop) if row.stable and not loop.reads_others else None
    cost = None if design.other_sensors else frame_cost(design).multiplications
    return facts(
        design=fact(row.design, "design"),
        residual_nm=fact(row.residual_nm, "residual", missing="unstable", **NM),
        strehl=fact(row.strehl, "Strehl", **PERCENT),
        **loop_inputs.margin_columns(margins),
        n_states=fact(design.controller.n_states, "states"),
        multiplications=fact(cost, "products per frame"),
    )


def _begin(designs: Mapping[str, Design], config: Config) -> tuple[Report, LimitStudy]:
    """Return a study of designs beside the limits, and what it says first of them."""
    study = limits(
        designs, config.hardware, config.truth, config.imaging, errors_hz=config.errors_hz
    )
    report = Report(data={"limit_nm": None if study.limit is None else study.limit.rms_nm})
    if unstable := [row.design for row in study.rows if not row.stable]:
        report.verdict.append(f"{unstable_text(unstable)} in the truth.")
    if stable := [row for row in study.rows if row.stable]:
        best = min(stable, key=lambda row: row.residual_nm)
        report.verdict.append(say_residual(best.design, best, study.limit))
    return report, study


def run_limits(arguments: Namespace) -> Report:
    """Compare designs with the least residual of any linear controller."""
    config = load_shown(arguments)
    if arguments.frame_rates is not None:
        return _limits_over_rates(config, arguments)
    files = load_designs(arguments.gains, config)
    designs = {
        method.name: config.design(
            method.name, **method.reference_options, **method.compared_options
        )
        for method in reference_methods()
    }
    designs |= {f"{name} (file)" if name in designs else name: d for name, d in files.items()}
    report, study = _begin(designs, config)
    report.add_rows(
        "rows",
        f"Distance to the limits of any linear controller; {config.imaging.label}",
        study.rows,
        without=("above_band_limit_percent",) * (study.band is None),
        hidden=() if study.shift_hz.size else ("worst_nm",),
        figure=partial(figures.limits_figure, study),
    )
    if study.band is not None and study.frequency_hz is not None:
        low, high = (study.frequency_hz + study.shift_hz[[0, -1]]).tolist()
        report.data |= {
            "band_hz": (low, high),
            "band_limit_nm": study.band.rms_nm,
            "band_achieved_nm": study.band.achieved_nm,
        }
        report.verdict.append(
            f"With the vibration anywhere from {low:g} to {high:g} Hz, no controller has a worst "
            f"residual below {nm_text(study.band.rms_nm, '.6g', unit='nm rms')}; a filter of "
            f"infinite order achieves {nm_text(study.band.achieved_nm, '.6g')}."
        )
    if study.limit is not None:
        report.notes.append(say_limit(study.limit, config))
    else:
        report.notes.append(
            "note: the limit of this loop cannot be computed; its modes have to decouple, with "
            "vibrations along principal axes of the sensor's noise."
        )
    report.notes += difference_notes(config, designs)
    return report


def _limits_over_rates(config: Config, arguments: Namespace) -> Report:
    """Compare two methods with the limit at frame rates in an interval, for the same star."""
    if arguments.gains:
        raise ProblemError("--frame-rates designs at each rate; leave the gain files out.")
    low, high = (number(rate, "--frame-rates", above=0) for rate in arguments.frame_rates)
    if not low < high:
        raise ProblemError(f"--frame-rates must be LOW below HIGH; got {low:g} {high:g}.")
    rates, shell = np.geomspace(low, high, _RATES), config.hardware.mirror
    if shell is not None:  # its local loop runs a whole number of samples per frame
        rates = np.unique(shell.sampling_hz / np.maximum(np.round(shell.sampling_hz / rates), 1))
    compared = (limits_at_rate(config, rate) for rate in rates.tolist())
    rows = list(track_progress(compared, total=rates.size, what="frame rates"))
    report, best, curves = Report(), list[str](), dict[str, FloatArray]()
    for name in (INTEGRATOR.name, KALMAN.name, "limit"):
        cells = [(row.values[f"{name}_nm"], row.values[f"{name}_strehl"]) for row in rows]
        residual_nm, ratio = np.array(cells).T
        curves[name] = residual_nm
        if np.isnan(residual_nm).all():  # unstable, or without a limit, at each rate
            continue
        place = int(np.nanargmin(residual_nm))
        end = ", an end of the range," * (place in (0, rates.size - 1))
        said = f"{nm_text(residual_nm[place], '.1f')} rms, Strehl ratio {100 * ratio[place]:.1f} %"
        best.append(f"{rates[place]:.0f} Hz{end} for the {design_title(name)} ({said})")
        report.data[f"best_{name}_hz"] = rates[place]
    none = "none: all loops are unstable in the truth"
    report.verdict.append(f"The best frame rate is {listing_text(best) or none}.")
    report.add_rows(
        "rows",
        f"The same star at other frame rates; {config.imaging.label}",
        rows,
        figure=partial(figures.frame_rate_figure, rates, curves),
    )
    noise = "the noise is that of photons, its variance in proportion to the rate"
    if config.settings.sensor.pyramid is not None:
        noise = "the read noise of a frame stays"
    delay = f"the delay stays {config.hardware.delay_frames:g} frames"
    delay += "; no other sensor is read" * bool(config.other_sensors)
    report.notes.append(f"assumes: the photons per second stay; {noise}; {delay}.")
    return report


def run_tradeoff(arguments: Namespace) -> Report:
    """Design filters from the least norm to the least variance, and compare them."""
    config = load_shown(arguments)
    filters = studies.tradeoff(
        config.plant.own_sensor_alone(), points=arguments.points, taps=arguments.taps
    )
    total = arguments.points * len(FAMILIES)
    points = list(track_progress(filters, total=total, what="filters"))
    mixed = [point for point in points if point.family == FAMILIES[0]]
    first, last, least = mixed[0], mixed[-1], points[0].design
    caption = "Trade-off of variance, norm and sensor gain"
    report = Report(tables=[row_table(f"{caption}, by the mixed filter", mixed)])
    figure = partial(figures.tradeoff_figure, points)
    report.add_rows("points", caption, points, without=("design",), figure=figure)
    report.data |= {"gamma_least": least.gamma_least, "gamma_infeasible": least.gamma_infeasible}
    report.verdict = [
        f"Lowering the norm of the error from {nm_text(last.gamma, '.1f')} to "
        f"{nm_text(first.gamma, '.1f')} raises its rms from {nm_text(last.rms, '.1f')} to "
        f"{nm_text(first.rms, '.1f')}.",
        f"The least norm of any filter lies between {nm_text(least.gamma_infeasible, '.9g')} and "
        f"{nm_text(least.gamma_least, '.9g')}.",
    ]
    if others := config.other_sensors:
        report.notes.append(f"note: the loop's own sensor is read alone, without {others}.")
    return report


def run_mirror(arguments: Namespace) -> Report:
    """Show how the mirror of a configuration settles, and compare designs on it."""
    config = load_shown(arguments)
    plant, shell = config.plant.own_sensor_alone(), config.hardware.mirror
    if shell is None:
        why = "is missing: without it the mirror settles at once. lbt_slow_mirror.yaml of"
        config.refuse_key("mirror.local_loop", f"{why} lbt-synth init --examples has it")
    hardware, step = plant.hardware, shell.step_response(arguments.tolerance)
    rows = compare_on_mirror(
        plant, config.truth, config.imaging, command_weight=config.settings.design.command_weight
    ).rows
    ms = {"unit": "ms", "scale": 1e3}
    frames = step.settling_s / hardware.dt_s
    best = min((row for row in rows if row.stable), key=lambda row: float(row.residual_nm))
    report = Report(data={"taps": hardware.mirror_taps})
    unstable = [row.design for row in rows if not row.stable]
    report.verdict = [f"Unstable on this mirror: {'; '.join(unstable)}."] * bool(unstable)
    report.verdict += [
        f"{best.design} leaves least, {nm_text(best.residual_nm, '.1f')} rms (Strehl ratio "
        f"{100 * best.strehl:.1f} %).",
        f"The mirror settles within {1e3 * step.settling_s:.3g} ms, {frames:.2g} frames.",
    ]
    report.add_rows(
        "rows",
        f"Designs on this mirror; {config.imaging.label}",
        rows,
        hidden=("method", "above_limit_percent", "worst_nm", "above_band_limit_percent"),
        figure=lambda: figures.mirror_figure(shell, hardware, tolerance=arguments.tolerance),
    )
    report.add_facts(
        "The mirror after a step of its command",
        facts(
            settling_s=fact(step.settling_s, "settling time", **ms),
            settling_frames=fact(frames, "  in frames", unit="frames"),
            frame_s=fact(hardware.dt_s, "one frame", **ms),
        ),
    )
    return report


def run_robustness(arguments: Namespace) -> Report:
    """Map the Strehl ratio of gain files over frequency error, sensor gain and delay error."""
    config = load_shown(arguments)
    settings, hardware = config.settings.robustness, config.hardware
    errors = _parse_range(arguments.errors_hz, "--errors-hz", refine_values(config.errors_hz))
    gains = _parse_range(arguments.sensor_gains, "--sensor-gains", settings.sensor_gains)
    true_gain = config.sensor_gain * config.truth.sensor_gain
    if arguments.sensor_gains is None and not np.isclose(gains, true_gain).any():
        gains = np.union1d(gains, true_gain)
    delays = arguments.delay_errors_frames or settings.delay_errors_frames
    for gain in gains:
        number(gain, "--sensor-gains", above=0)
    designs = load_designs(arguments.gains)
    maps = {}
    for name, design in designs.items():
        require_compatible(name, design, hardware)
        grid = studies.robustness_map(
            design,
            config.truth,
            config.imaging,
            errors_hz=errors,
            sensor_gains=gains / config.sensor_gain,
            delay_errors_frames=delays,
            hardware=hardware,
        )
        maps[name] = replace(grid, sensor_gains=frozen_copy(gains))  # the real ones again
    real = int(np.argmin(np.abs(gains - true_gain)))
    lines = [line for name, grid in maps.items() for line in grid.worst_points(name, real)]
    where = f"frequency errors of {np.min(errors):+g} to {np.max(errors):+g} Hz"
    caption = f"At a sensor gain of {gains[real]:.3g}: {config.imaging.label}, over {where}"
    report = Report(
        verdict=say_maps(maps, real, where),
        tables=[row_table(caption, lines)],
        notes=difference_notes(config, designs),
        rows=[point for name, grid in maps.items() for point in grid.points(name)],
        figure=lambda: robustness_map_figure(maps),
    )
    pairs = [(name, int(np.sum(~grid.stable)), grid.stable.size) for name, grid in maps.items()]
    headings = ("file", "unstable", "all")
    report.add_table("Pairs of a sensor gain and a delay error", headings, pairs)
    report.data["maps"] = {name: asdict(grid) for name, grid in maps.items()}
    return report


def _parse_range(
    ends: Sequence[float] | None, option: str, default: Sequence[float] | FloatArray
) -> FloatArray:
    """Return the values of LOW HIGH COUNT, or those of the configuration where none are given."""
    if ends is None:
        return np.array(default)
    low, high, count = (number(value, option) for value in ends)
    if not (low < high and count.is_integer() and count >= 2):
        raise ProblemError(
            f"{option} must be LOW HIGH COUNT with LOW below HIGH and a COUNT of at least 2; got "
            f"{low:g} {high:g} {count:g}."
        )
    return np.linspace(low, high, int(count))


def run_modal(arguments: Namespace) -> Report:
    """Compare integrators, optimised gains and Kalman filters, mode by mode."""
    config = load_shown(arguments, all_modes=True)
    modes = config.settings.mirror.modes if arguments.modes is None else arguments.modes
    if modes is None:
        config.refuse_key("mirror.modes", "is missing; give it, or --modes")
    study = compare_modes(config, integer(modes, "modes", at_least=2))
    totals_nm = {name: float(np.linalg.norm(rms)) for name, rms in study.residual_nm.items()}
    air_nm = float(np.linalg.norm(study.turbulence_nm))
    leaves = [f"{name} {nm_text(rms, '.1f')} rms" for name, rms in totals_nm.items()]
    report = Report(data={"modes": modes, "residual_nm": totals_nm, "turbulence_nm": air_nm})
    report.verdict.append(
        f"Of {nm_text(air_nm, '.1f')} rms of turbulence in {modes} modes, what is left is: "
        f"{'; '.join(leaves)}."
    )
    shown = {"gains": study.gains, "turbulence_nm": study.turbulence_nm}
    report.add_rows(
        "rows",
        "By radial order, residuals over its modes",
        list(study.by_radial_order()),
        figure=lambda: figures.modal_figure(study.residual_nm, **shown),
    )
    return report
