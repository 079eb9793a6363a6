"""How far designs are from the limits of performance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.loop import (
    ClosedLoop,
    Imaging,
    broken_loops,
    least_residual,
    least_worst_residual,
    residual_budget,
    strehl,
)
from lbt_synth.loop.broken_loops import phase_margin_deg
from lbt_synth.loop.least_residuals.residual_limit import above_percent, limit_or_none
from lbt_synth.models import LoopHardware, SinusoidalVibration, Truth
from lbt_synth.models.vibration import stationary_vibrations
from lbt_synth.storage.rows import column, nm_column, percent_column, table_row
from lbt_synth.validation import FloatArray, frozen_copy, number

if TYPE_CHECKING:
    from lbt_synth.loop.least_residuals.band_limit import BandLimit
    from lbt_synth.loop.least_residuals.residual_limit import ResidualLimit

_GRID = 65  # shifts over the range of errors, at least


@table_row
class LimitRow:
    """One design beside the limits; what an unstable loop does not have is nan."""

    design: str = column("design", help="Its name")
    method: str = column(help="How it was made")
    residual_nm: float = nm_column(
        "residual",
        format=".2f",
        missing="unstable",
        help="Residual under the truth, rms",
    )
    strehl: float = percent_column("Strehl", help="Strehl ratio in [0, 1]")
    above_limit_percent: float = column(
        "above the limit",
        unit="%",
        format=".2f",
        help="Residual over the limit, less 1; nan where there is no limit, it is 0, or the design "
        "reads other sensors, which the limit does not",
    )
    worst_nm: float = nm_column(
        "worst residual",
        format=".2f",
        help="Largest residual with all true vibrations moved within the range of errors, rms",
    )
    above_band_limit_percent: float = column(
        "above the band limit",
        unit="%",
        format=".2f",
        help="The same over the limit for the band, less 1; nan likewise",
    )
    phase_margin_deg: float = column(
        "phase margin",
        unit="deg",
        format=".1f",
        help="Least phase margin of the loop in the truth, each measurement broken in turn",
    )
    stable: bool = column(help="Whether the loop is stable with the real sensor gain")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimitStudy:
    """Designs beside the limits, over the true frequency of the vibrations."""

    rows: tuple[LimitRow, ...]  # one per design
    # the least residual of any linear controller; None where the modes do not decouple
    limit: ResidualLimit | None
    # the least worst residual with the sinusoid anywhere in the range of errors; None unless the
    # truth has exactly one vibration, a sinusoid, and there is a range
    band: BandLimit | None
    band_hz: tuple[float, float] | None  # that range [Hz]
    # (s,): true frequency less that of the truth [Hz], of the vibration that moves most; empty
    # without vibrations
    shift_hz: FloatArray
    # (designs, s): residual of each design at each shift [nm rms]; nan if unstable
    residual_nm: FloatArray
    frequency_hz: float | None  # frequency of the truth's vibrations, if it is one


def limits(
    designs: Mapping[str, Design],
    hardware: LoopHardware,
    truth: Truth,
    imaging: Imaging,
    *,
    errors_hz: Sequence[float] = (0.0,),
) -> LimitStudy:
    """Evaluate designs exactly and compare them with the limits.

    Parameters
    ----------
    designs : mapping of str to Design
        Designs by name; each is left as it is while the truth moves.
    hardware : LoopHardware
        The loop in which all of them run.
    truth : Truth
        What the loop really meets.
    imaging : Imaging
        The camera.
    errors_hz : sequence of float, optional
        True frequency less that of the model [Hz], of the vibration that moves most; the others
        move in proportion (``truth.frequency_errors_hz``), over the whole range between the
        extremes.

    Returns
    -------
    LimitStudy
        Rows in the order of the designs.

    Raises
    ------
    ProblemError
        If a design or a vibration does not fit the loop, or there is no design.
    NumericalError
        If an integral does not settle.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=800)
    >>> study = lbt.studies.limits(
    ...     {"by hand": lbt.integrator(path, gain=0.5)},
    ...     path,
    ...     lbt.Truth(turbulence=slow, noise_nm=5.0),
    ...     lbt.Imaging(diameter_m=8.22),
    ... )
    >>> study.rows[0].above_limit_percent > 0
    True
    """
    if not designs:
        raise ProblemError("a study of limits needs at least one design; got none.")
    errors = [number(error, "errors_hz") for error in errors_hz]
    if not errors:
        raise ProblemError("errors_hz must hold at least one error; got none.")
    vibrations = stationary_vibrations(truth.vibrations)
    shifts = _frequency_shifts(truth, errors)
    alone = hardware.own_sensor_alone()
    limit = limit_or_none(lambda: least_residual(alone, truth))
    band_hz = _error_band(truth, shifts)
    band = None
    if band_hz is not None:
        line = vibrations[0]
        band = limit_or_none(
            lambda: least_worst_residual(
                alone, truth, band_hz=band_hz, rms_nm=line.rms_nm, direction=line.direction
            )
        )
    rows, curves = [], []
    for name, design in designs.items():
        loop = design.close(hardware, sensor_gain=truth.sensor_gain)
        residual_nm, ratio, curve = _evaluate_loop(loop, truth, imaging, shifts)
        worst_nm = float(np.max(curve)) if shifts.size else residual_nm
        limit_nm, band_nm = (_limit_nm(loop, found) for found in (limit, band))
        rows.append(
            LimitRow(
                design=name,
                method=design.method,
                residual_nm=residual_nm,
                strehl=ratio,
                above_limit_percent=above_percent(residual_nm, limit_nm),
                worst_nm=worst_nm,
                above_band_limit_percent=above_percent(worst_nm, band_nm),
                phase_margin_deg=_phase_margin_deg(loop),
                stable=loop.is_stable,
            )
        )
        curves.append(curve)
    return LimitStudy(
        rows=tuple(rows),
        limit=limit,
        band=band,
        band_hz=band_hz,
        shift_hz=frozen_copy(shifts),
        residual_nm=frozen_copy(curves),
        frequency_hz=truth.lines_hz[0] if len(truth.lines_hz) == 1 else None,
    )


def _limit_nm(loop: ClosedLoop, limit: ResidualLimit | BandLimit | None) -> float:
    """Return a limit of the loop's own sensor; nan where a loop reads others, or there is none."""
    return limit.rms_nm if limit is not None and not loop.reads_others else np.nan


def _phase_margin_deg(loop: ClosedLoop) -> float:
    """Return the least phase margin; nan if the loop is unstable, or of several sensors."""
    if not loop.is_stable or loop.reads_others:
        return np.nan
    return phase_margin_deg(broken_loops(loop))


def _frequency_shifts(truth: Truth, errors_hz: Sequence[float]) -> FloatArray:
    """Return the shifts over the range of errors, the errors and 0 among them."""
    if not truth.vibrations:
        return np.zeros(0)
    moved = np.array(errors_hz)
    grid = np.linspace(moved.min(), moved.max(), _GRID)
    inside = [0.0] if moved.min() <= 0 <= moved.max() else []
    return np.asarray(np.unique(np.concatenate([grid, moved, inside]) + 0.0))


def _error_band(truth: Truth, shifts: FloatArray) -> tuple[float, float] | None:
    """Return the range of the true frequency [Hz] if there is one sinusoid and a range."""
    lines = truth.vibrations
    if len(lines) != 1 or not isinstance(lines[0], SinusoidalVibration) or shifts.size < 2:
        return None
    return lines[0].frequency_hz + float(shifts[0]), lines[0].frequency_hz + float(shifts[-1])


def _evaluate_loop(
    loop: ClosedLoop, truth: Truth, imaging: Imaging, shifts: FloatArray
) -> tuple[float, float, FloatArray]:
    """Return residual [nm], Strehl ratio and residual at each shift [nm]; nan if unstable."""
    if not loop.is_stable:
        return np.nan, np.nan, np.full(shifts.size, np.nan)
    budget = residual_budget(loop, truth)
    if not np.any(shifts):
        return budget.rms_nm, strehl(budget, imaging), np.full(shifts.size, budget.rms_nm)
    still = replace(truth, turbulence=None, noise_nm=0.0)
    shaken = [
        residual_budget(loop, still.with_frequency_error(float(shift))) for shift in [0.0, *shifts]
    ]
    first, *others = (np.trace(one.total_nm2) for one in shaken)
    variance = np.array([np.trace(budget.total_nm2) - first + other for other in others])
    return budget.rms_nm, strehl(budget, imaging), np.sqrt(variance)
