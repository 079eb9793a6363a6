"""The commands limits, tradeoff and mirror: designs compared in the loop of a configuration."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth import studies
from lbt_synth.cli.loop_inputs import (
    load_designs,
    load_shown,
    named_difference_notes,
    own_sensor_notes,
    say_limit,
)
from lbt_synth.cli.output import Report
from lbt_synth.cli.output_files import require_outputs, write_outputs
from lbt_synth.cli.progress import show_spinner, track_progress
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import ConfigError
from lbt_synth.loop import least_residual
from lbt_synth.loop.least_residuals.residual_limit import limit_or_nan
from lbt_synth.methods.registry import reference_methods
from lbt_synth.models import PositionLoop
from lbt_synth.report.figures.studies import limits_figure, mirror_figure, tradeoff_figure
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import fact, facts
from lbt_synth.studies import tradeoff
from lbt_synth.studies.limits import LimitStudy
from lbt_synth.studies.robustness import FAMILIES, mirror_rows
from lbt_synth.validation import integer


def run_limits(arguments: Namespace) -> Report:
    """Compare designs with the least residual of any linear controller."""
    require_outputs(arguments.output, inputs=[arguments.config, *arguments.gains])
    config = load_shown(arguments)
    files = load_designs(arguments.gains, any_sensors=True)
    with show_spinner("comparing", quiet=arguments.json):
        designs = _config_designs(config)
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
    )
    report.data["limit_nm"] = None if study.limit is None else study.limit.rms_nm
    if study.band is not None:
        report.data |= {
            "band_hz": study.band_hz,
            "band_limit_nm": study.band.rms_nm,
            "band_achieved_nm": study.band.achieved_nm,
        }
    report.notes += [*_limit_notes(study, config), *_design_notes(config, designs, study)]
    write_outputs(
        report, arguments.output, study.rows, figure=lambda: limits_figure(study), without=no_band
    )
    return report


def _config_designs(config: Config) -> dict[str, Design]:
    return {
        method.name: config.design(method.name, **method.in_comparison)
        for method in reference_methods()
    }


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
    require_outputs(arguments.output, inputs=[arguments.config])
    count = integer(arguments.points, "--points", at_least=2)
    taps = integer(arguments.taps, "--taps", at_least=1)
    config = load_shown(arguments)
    points = list(
        track_progress(
            tradeoff(config.plant.own_sensor_alone(), points=count, taps=taps),
            total=count * len(FAMILIES),
            what="filters",
            quiet=arguments.json,
        )
    )
    least = points[0].design
    report = Report()
    report.add_rows("points", "Trade-off of variance, norm and sensor gain", points)
    report.data |= {"gamma_least": least.gamma_least, "gamma_infeasible": least.gamma_infeasible}
    report.notes.append(
        f"the least norm of any filter lies between {nm_text(least.gamma_infeasible, '.9g')} and "
        f"{nm_text(least.gamma_least, '.9g')}"
    )
    report.notes += own_sensor_notes(config)
    write_outputs(report, arguments.output, points, figure=lambda: tradeoff_figure(points))
    return report


_SHOWN_TAPS = 8


def run_mirror(arguments: Namespace) -> Report:
    """Show how the mirror of a configuration settles, and compare designs on it."""
    require_outputs(arguments.output, inputs=[arguments.config])
    config = load_shown(arguments)
    plant, shell = config.plant.own_sensor_alone(), _require_local_loop(config)
    hardware = plant.hardware
    step = shell.step_response(arguments.tolerance)
    with show_spinner("designing", quiet=arguments.json):
        rows = mirror_rows(
            plant,
            config.truth,
            config.imaging,
            command_weight=config.settings.design.command_weight,
        )
    taps = hardware.mirror_taps
    shown = [f"{tap:.4f}" for tap in taps[:_SHOWN_TAPS]] + ["..."] * (taps.size > _SHOWN_TAPS)
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
    report.add_rows("rows", f"Designs on this mirror; {config.imaging.label}", rows)
    report.notes.append(f"weights of u(k), u(k-1), ... in exposure k: {', '.join(shown)}")
    write_outputs(
        report,
        arguments.output,
        rows,
        figure=lambda: mirror_figure(hardware, tolerance=arguments.tolerance),
    )
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
