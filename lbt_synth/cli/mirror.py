"""The command mirror: the mirror's local loop, and what ignoring it costs."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict

from lbt_synth import studies
from lbt_synth.cli.output import Report, TableText, fact_table, format_fixed, tabulate
from lbt_synth.cli.output_files import require_outputs, write_outputs
from lbt_synth.cli.progress import show_spinner
from lbt_synth.config import Config, load_config
from lbt_synth.design.model_limits import limit_or_nan
from lbt_synth.errors import ConfigError
from lbt_synth.loop import least_residual
from lbt_synth.models import PositionLoop
from lbt_synth.report.figures import mirror_figure
from lbt_synth.studies import MirrorRow

_SHOWN_TAPS = 8


def run(arguments: Namespace) -> Report:
    """Show how the mirror of a configuration settles, and compare designs on it."""
    require_outputs(arguments.output, inputs=[arguments.config])
    config = load_config(arguments.config)
    hardware, shell = config.hardware, _require_local_loop(config)
    step = shell.step_response(arguments.tolerance)
    with show_spinner("designing", quiet=arguments.json):
        rows = studies.mirror(
            config.plant,
            config.truth,
            config.imaging,
            command_weight=config.settings.design.command_weight,
        )
    limit_nm = limit_or_nan(lambda: least_residual(hardware, config.truth))
    records = [asdict(row) for row in rows]
    taps = hardware.mirror_taps
    shown = [f"{tap:.4f}" for tap in taps[:_SHOWN_TAPS]] + ["..."] * (taps.size > _SHOWN_TAPS)
    report = Report(
        data={
            "rise_s": step.rise_s,
            "overshoot": step.overshoot,
            "settling_s": step.settling_s,
            "tolerance": step.tolerance,
            "bandwidth_hz": shell.bandwidth_hz,
            "frame_s": hardware.dt_s,
            "taps": taps,
            "rows": records,
            "limit_nm": limit_nm,
        },
        tables=[
            fact_table(
                "The mirror after a step of its command",
                [
                    ("rise, 10 % to 90 %", 1e3 * step.rise_s, "ms"),
                    ("overshoot", 100 * step.overshoot, "%"),
                    (f"settling time, to {100 * step.tolerance:g} %", 1e3 * step.settling_s, "ms"),
                    ("  in frames", step.settling_s / hardware.dt_s, "frames"),
                    ("bandwidth, -3 dB", shell.bandwidth_hz, "Hz"),
                    ("one frame", 1e3 * hardware.dt_s, "ms"),
                ],
            ),
            _design_table(rows),
        ],
        notes=[
            f"weights of u(k), u(k-1), ... in exposure k: {', '.join(shown)}",
            f"least residual of any linear controller: {format_fixed(limit_nm, 2)} nm rms",
        ],
    )
    write_outputs(
        report,
        arguments.output,
        records=records,
        figure=lambda: mirror_figure(hardware, tolerance=arguments.tolerance),
    )
    return report


def _require_local_loop(config: Config) -> PositionLoop:
    key, shell = "mirror.local_loop", config.hardware.mirror
    if shell is None:
        raise ConfigError(
            f"{config.source}: the key {key} is missing: without it the mirror settles at once. "
            "Try examples/lbt_slow_mirror.yaml.",
            path=key,
        )
    return shell


def _design_table(rows: Sequence[MirrorRow]) -> TableText:
    return tabulate(
        "Designs on this mirror",
        rows,
        ("design", lambda row: row.design),
        (
            "residual [nm]",
            lambda row: format_fixed(row.residual_nm, 2) if row.stable else "unstable",
        ),
        ("Strehl [%]", lambda row: format_fixed(100 * row.strehl, 2)),
        ("settled less real position [nm]", lambda row: format_fixed(row.unsettled_nm, 2)),
    )
