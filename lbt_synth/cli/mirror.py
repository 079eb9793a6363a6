"""The command mirror: the mirror's local loop, and what ignoring it costs."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth import studies
from lbt_synth.cli.display import load_shown
from lbt_synth.cli.output import Report
from lbt_synth.cli.output_files import require_outputs, write_outputs
from lbt_synth.cli.progress import show_spinner
from lbt_synth.config import Config
from lbt_synth.errors import ConfigError
from lbt_synth.loop import least_residual
from lbt_synth.loop.least_residuals.residual_limit import limit_or_nan
from lbt_synth.models import PositionLoop
from lbt_synth.report.figures.studies import mirror_figure
from lbt_synth.storage.rows import fact, facts

_SHOWN_TAPS = 8


def run(arguments: Namespace) -> Report:
    """Show how the mirror of a configuration settles, and compare designs on it."""
    require_outputs(arguments.output, inputs=[arguments.config])
    config = load_shown(arguments)
    plant, shell = config.plant.own_sensor_alone(), _require_local_loop(config)
    hardware = plant.hardware
    step = shell.step_response(arguments.tolerance)
    with show_spinner("designing", quiet=arguments.json):
        rows = studies.mirror(
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
