"""Commands that close the loop: sigma, simulate."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from lbt_synth.cli.output import Report, TableText, working
from lbt_synth.cli.telemetry import write_first_case
from lbt_synth.config import Config, load_config
from lbt_synth.design import Design, EstimatorDesign
from lbt_synth.errors import ProblemError, UnstableLoopError
from lbt_synth.files import load_gain
from lbt_synth.files.telemetry.store import require_telemetry_name
from lbt_synth.loop import (
    ClosedLoop,
    close_loop,
    least_residual,
    loop_margins,
    residual_budget,
    stable_sensor_gains,
    strehl,
)
from lbt_synth.loop import simulate as run_simulation
from lbt_synth.loop.simulation.run import settling_frames
from lbt_synth.models import Truth
from lbt_synth.models.loop_hardware import loop_differences, same_mirror
from lbt_synth.report.figures import sigma_figure, simulation_figure
from lbt_synth.report.figures.style import require_figure_name, save_figure
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.studies.limits import above_percent, limit_or_nan


def sigma(arguments: Namespace) -> Report:
    """Plot singular values of one or several designs, and print their margins."""
    _require_figure(arguments.output, inputs=arguments.gains)
    designs = named_designs(arguments.gains)
    with working("drawing", quiet=arguments.json):
        figure = sigma_figure(designs, sensor_gain=arguments.sensor_gain)
    rows, data = [], {}
    for name, design in designs.items():
        entry: dict[str, object] = {"method": design.method}
        if isinstance(design, EstimatorDesign):
            entry |= {"gamma": design.gamma, "rms": design.rms}
        if design.hardware is not None:
            loop = close_loop(design.hardware, design.controller, sensor_gain=arguments.sensor_gain)
            entry["stable"] = loop.is_stable
            if loop.is_stable:
                entry |= asdict(loop_margins(loop))
        data[name] = entry
        rows.append(
            (
                name,
                entry.get("gamma"),
                entry.get("stable"),
                entry.get("modulus"),
                entry.get("gain_low"),
                entry.get("gain_high"),
                entry.get("phase_deg"),
                entry.get("delay_frames"),
            )
        )
    path = save_figure(figure, arguments.output)
    physical = all(design.hardware is not None for design in designs.values())
    norm = "norm [nm]" if physical else "norm"
    return Report(
        data={"designs": data, "sensor_gain": arguments.sensor_gain, "file": str(path)},
        tables=[
            TableText(
                title=f"Margins at sensor gain {arguments.sensor_gain:g}",
                headings=(
                    "design",
                    norm,
                    "stable",
                    "modulus",
                    "gain from",
                    "gain to",
                    "phase [deg]",
                    "delay [frames]",
                ),
                rows=rows,
            )
        ],
        notes=[f"written: {path}"],
    )


def simulate(arguments: Namespace) -> Report:
    """Close the loop in the time domain, beside the exact answer."""
    inputs = [arguments.config, arguments.gain]
    if arguments.output is not None:
        _require_figure(arguments.output, inputs=inputs)
    if arguments.telemetry is not None:
        require_telemetry_name(arguments.telemetry)
        require_writable(arguments.telemetry, inputs=inputs)
    config = load_config(arguments.config)
    design = load_gain(arguments.gain)
    truth = real_truth(config, arguments)
    settings = config.settings.simulation

    def chosen(name: str) -> int:
        given = getattr(arguments, name)
        return int(getattr(settings, name) if given is None else given)

    loop = close_loop(config.hardware, design.controller, sensor_gain=truth.sensor_gain)
    _require_stable(loop, design, config.sensor_gain)
    # the same settling for all controllers, so that one seed is one weather
    settle = max(settings.settle_frames, settling_frames(loop.spectral_radius))
    with working("closing the loop", quiet=arguments.json):
        run = run_simulation(
            design.controller,
            truth,
            hardware=config.hardware,
            frames=chosen("frames"),
            cases=chosen("cases"),
            seed=chosen("seed"),
            settle_frames=settle,
        )
        strehls = run.strehl(config.imaging)
    command_rms = np.sqrt(np.sum(np.mean(run.commands**2, axis=(0, 1))))
    scatter = float(np.std(strehls, ddof=1)) if len(strehls) > 1 else float("nan")
    exact = _exact(loop, config, truth)
    rows = [
        ("Strehl ratio", 100 * float(np.mean(strehls)), _percent(exact["strehl_exact"]), "%"),
        ("residual", float(np.sqrt(np.mean(run.rms_nm**2))), exact["residual_exact_nm"], "nm rms"),
        ("  turbulence", None, exact["turbulence_nm"], "nm rms"),
        ("  vibration", None, exact["vibration_nm"], "nm rms"),
        ("  noise", None, exact["noise_nm"], "nm rms"),
        ("commands", float(command_rms), None, "nm rms"),
        ("least residual of any linear controller", None, exact["limit_nm"], "nm rms"),
        ("  residual above it", None, exact["above_limit_percent"], "%"),
    ]
    report = Report(
        data={
            "strehl": strehls,
            "residual_nm": run.rms_nm,
            **exact,
            "command_rms": command_rms,
            "frames": run.residual_nm.shape[1],
            "cases": len(strehls),
            "seed": run.seed,
            "sensor_gain": config.sensor_gain * truth.sensor_gain,
        },
        tables=[
            TableText(
                title=f"{design.method} in the loop: {len(strehls)} "
                f"run{'s' if len(strehls) > 1 else ''} of {run.residual_nm.shape[1]} frames",
                headings=("quantity", "simulated", "exact", "unit"),
                rows=[row for row in rows if row[1:3] != (None, None)],
            )
        ],
        notes=_simulation_notes(config, design, scatter, settle, drifts=truth.drifts),
    )
    if arguments.output is not None:
        path = save_figure(
            simulation_figure(
                run, title=f"{design.method}: first run above, mean spectrum of all runs below"
            ),
            arguments.output,
        )
        report.data["file"] = str(path)
        report.notes.append(f"written: {path}")
    if arguments.telemetry is not None:
        write_first_case(
            report, arguments.telemetry, run, replace(config, truth=truth), design, arguments.gain
        )
    return report


def _exact(loop: ClosedLoop, config: Config, truth: Truth) -> dict[str, float | None]:
    """Return the exact answers, all None where the truth drifts: it has none."""
    names = (
        "strehl_exact",
        "residual_exact_nm",
        "turbulence_nm",
        "vibration_nm",
        "noise_nm",
        "limit_nm",
        "above_limit_percent",
    )
    if truth.drifts:
        return dict.fromkeys(names)
    budget = residual_budget(loop, truth)
    limit_nm = limit_or_nan(lambda: least_residual(config.hardware, truth))
    values = (
        strehl(budget, config.imaging),
        budget.rms_nm,
        budget.turbulence_nm,
        budget.vibration_nm,
        budget.noise_nm,
        limit_nm,
        round(above_percent(budget.rms_nm, limit_nm), 6) + 0.0,
    )
    return dict(zip(names, values, strict=True))


def _percent(value: float | None) -> float | None:
    return None if value is None else 100 * value


def _require_stable(loop: ClosedLoop, design: Design, reference_gain: float) -> None:
    """Refuse an unstable loop, and say what makes it so: mirror, sensor gain or delay."""
    if loop.is_stable:
        return
    own, here = design.hardware, loop.hardware
    low, high = stable_sensor_gains(here, design.controller)
    if own is not None and not same_mirror(own, here):
        reason = (
            "The file was designed for another mirror than that of the configuration. Design for "
            "mirror.local_loop of the configuration, best with --method lqg."
        )
    elif not np.isnan(low):
        reason = (
            f"With this delay the design is stable at sensor gains from {low * reference_gain:.4g} "
            f"to {high * reference_gain:.4g}; design for this gain, or for a range of them with "
            "--method robust."
        )
    elif own is not None and own.delay_frames != here.delay_frames:
        reason = (
            f"The file was designed for a delay of {own.delay_frames:g} frames. Set "
            f"loop.delay_frames to {own.delay_frames:g}, or design for {here.delay_frames:g}."
        )
    else:
        reason = "Design for this configuration."
    raise UnstableLoopError(
        f"the closed loop must be stable; got an unstable one (spectral radius "
        f"{loop.spectral_radius:.6g}) at a sensor gain of {loop.sensor_gain * reference_gain:.6g} "
        f"and a delay of {here.delay_frames:g} frames. {reason}",
        spectral_radius=loop.spectral_radius,
    )


def _simulation_notes(
    config: Config, design: Design, scatter: float, settle: int, *, drifts: bool
) -> list[str]:
    notes = []
    if drifts:
        notes.append("note: a vibration drifts, so there is no exact answer beside the simulation.")
    if not np.isnan(scatter):
        notes.append(f"scatter of the Strehl ratio between runs: {100 * scatter:.2f} points")
    usual = config.settings.simulation.settle_frames
    if settle > usual:
        notes.append(
            f"note: this loop settles for {settle} frames, not {usual}; its random series are not "
            "those of a faster loop with the same seed. Raise simulation.settle_frames."
        )
    return notes + foreign_notes(config, design)


def foreign_notes(config: Config, design: Design) -> list[str]:
    """Say where a design was made for another loop than the configuration's."""
    if design.hardware is None:
        return []
    return [f"note: {text}" for text in loop_differences(design.hardware, config.hardware)]


def real_truth(config: Config, arguments: Namespace) -> Truth:
    """Truth of the configuration, at the sensor gain of the command line if there is one."""
    if arguments.sensor_gain is None:
        return config.truth
    return replace(config.truth, sensor_gain=arguments.sensor_gain / config.sensor_gain)


def _require_figure(output: str, *, inputs: list[str]) -> None:
    """Refuse an output that cannot become a figure, before any work is done."""
    require_writable(require_figure_name(output), inputs=inputs)


def named_designs(paths: list[str]) -> dict[str, Design]:
    """Designs by the stems of their files, by tails of the paths where stems repeat."""
    if len({Path(path).resolve() for path in paths}) != len(paths):
        raise ProblemError(f"each gain file must be given once; got {', '.join(paths)}.")
    stems = [Path(path).stem for path in paths]
    names = stems if len(set(stems)) == len(stems) else _tails(paths)
    return {name: load_gain(path) for name, path in zip(names, paths, strict=True)}


def _tails(paths: list[str]) -> list[str]:
    """Return the last parts of different paths, as few as tell all of them apart."""
    whole = [Path(path).resolve().parts for path in paths]
    for count in range(1, max(map(len, whole))):
        names = ["/".join(parts[-count:]) for parts in whole]
        if len(set(names)) == len(names):
            return names
    return paths
