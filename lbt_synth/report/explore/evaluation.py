"""What is computed of a design at a move: first its transfer functions, then what it leaves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.linear import hinf_norm, largest_singular_values
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.loop import close_loop
from lbt_synth.report.designs.simulation import exact_spectrum
from lbt_synth.report.explore.knobs import shift_range_hz
from lbt_synth.report.figures.loop import frequency_grid
from lbt_synth.storage.rows import column, nm_column, percent_column, table_row
from lbt_synth.studies import robustness_map
from lbt_synth.validation import ComplexArray, FloatArray

_POINTS, _NEAR_A_LINE = 240, 28  # frequencies of a curve: in all, and on each side of a line
_SHIFTS = 15
_SEGMENT = 2048  # frames of a segment of the spectrum


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopCurves:
    """Transfer functions of a design's loop; what an unstable loop does not have is nan."""

    frequency_hz: FloatArray  # (f,)
    error_nm: FloatArray | None  # (f,): norm of the estimation error; None without an estimate
    rejection: FloatArray  # (f,): norm from phase to residual
    noise_transfer: FloatArray  # (f,): norm from noise to residual
    spectrum_nm2_hz: FloatArray  # (f,): of the residual, sum over the axes
    broken: ComplexArray  # (q, f): loop gain of each measurement, the others closed
    poles: ComplexArray  # of the closed loop


@table_row
class ExploredRow:
    """A design in the loop that the sliders make; what an unstable loop does not have is nan."""

    design: str = column("design")
    residual_nm: float = nm_column("residual", format=".1f", missing="unstable")
    strehl: float = percent_column("Strehl ratio")
    modulus: float = column("modulus margin", format=".3f")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Performance:
    """What a design leaves, now and at other shifts of the true lines."""

    row: ExploredRow
    shift_hz: FloatArray  # (s,): by which the true lines are moved from the configuration's
    strehls: FloatArray  # (s,): Strehl ratio there, in [0, 1]; nan in an unstable loop


def loop_curves(design: Design, config: Config) -> LoopCurves:
    """Return the curves of a design in the loop of a configuration."""
    hardware, truth = config.hardware, config.truth
    loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
    density = {"points": _POINTS, "near": _NEAR_A_LINE}
    grid = frequency_grid(hardware.frame_rate_hz, truth.lines_hz, **density)
    n, m = hardware.modes, hardware.n_commands
    response = loop.system.frequency_response(grid)
    returned = response[:, n + m :, n:].diagonal(axis1=1, axis2=2).T
    stable, nothing = loop.is_stable, np.full(grid.size, np.nan)
    return LoopCurves(
        frequency_hz=grid,
        error_nm=largest_singular_values(design.error_system(), grid)
        if design.is_estimator
        else None,
        rejection=spectral_norms(response[:, :n, :n]) if stable else nothing,
        noise_transfer=spectral_norms(response[:, :n, n:]) if stable else nothing,
        spectrum_nm2_hz=exact_spectrum(loop, truth, grid, _SEGMENT) if stable else nothing,
        broken=1 / returned - 1,
        poles=loop.system.poles,
    )


def performance(
    name: str, design: Design, config: Config, start: Config, shift_hz: float
) -> Performance:
    """Return what a design leaves in a loop whose true lines moved by a shift from the start."""
    hardware = config.hardware
    lines = {n: getattr(start.truth, n) for n in ("vibrations", "frequency_errors_hz")}
    truth = replace(config.truth, **lines)
    shifts = np.unique(np.append(np.linspace(*shift_range_hz(start), _SHIFTS), shift_hz))
    found = robustness_map(
        design,
        truth,
        config.imaging,
        hardware=hardware,
        errors_hz=shifts,
        sensor_gains=[truth.sensor_gain],
    )
    loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
    now = int(np.searchsorted(shifts, shift_hz))
    row = ExploredRow(
        design=name,
        residual_nm=float(found.residual_nm[0, 0, now]),
        strehl=float(found.strehl[0, 0, now]),
        modulus=1 / float(hinf_norm(loop.output_sensitivity())) if loop.is_stable else np.nan,
    )
    return Performance(row=row, shift_hz=shifts, strehls=found.strehl[0, 0])
