"""How far designs are from the limits of performance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from lbt_synth.design import Design, EstimatorDesign, LqgDesign, ShapedDesign
from lbt_synth.design.shaping import ResidualVariance, VibrationBand
from lbt_synth.design.shaping.objectives import leaves
from lbt_synth.design.shaping.single_mode_loop import mode_hardware, mode_loop
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.loop import (
    BandLimit,
    ClosedLoop,
    Imaging,
    ResidualLimit,
    close_loop,
    least_residual,
    least_worst_residual,
    residual_budget,
    strehl,
)
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual
from lbt_synth.models import FullStatePlant, LoopHardware, SinusoidalVibration, TipTiltPlant, Truth
from lbt_synth.models.truth import stationary_vibrations
from lbt_synth.validation import FloatArray, frozen_copy, number

T = TypeVar("T")
_GRID = 65  # shifts over the range of errors, at least


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitRow:
    """One design beside the limits.

    Attributes
    ----------
    design : str
        Its name.
    method : str
        How it was made.
    residual_nm : float
        Residual under the truth [nm rms]; nan if the loop is unstable, as all that follows.
    strehl : float
        Strehl ratio in [0, 1].
    above_limit_percent : float
        Residual over the limit, less 1 [%]; nan where there is no limit, or it is 0.
    worst_nm : float
        Largest residual with all true vibrations moved within the range of errors [nm rms].
    above_band_limit_percent : float
        The same over the limit for the band, less 1 [%]; nan where there is none.
    stable : bool
        Whether the loop is stable with the real sensor gain.
    """

    design: str
    method: str
    residual_nm: float
    strehl: float
    above_limit_percent: float
    worst_nm: float
    above_band_limit_percent: float
    stable: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimitStudy:
    """Designs beside the limits, over the true frequency of the vibrations.

    Attributes
    ----------
    rows : tuple of LimitRow
        One per design.
    limit : ResidualLimit or None
        The least residual of any linear controller; None where the modes do not decouple.
    band : BandLimit or None
        The least worst residual with the sinusoid anywhere in the range of errors; None
        unless the truth has exactly one vibration, a sinusoid, and there is a range.
    band_hz : tuple of float or None
        That range [Hz].
    shift_hz : (s,) ndarray
        True frequency less that of the truth [Hz]; empty without vibrations.
    residual_nm : (designs, s) ndarray
        Residual of each design at each shift [nm rms]; nan if unstable.
    frequency_hz : float or None
        Frequency of the truth's vibrations, if it is one.
    """

    rows: tuple[LimitRow, ...]
    limit: ResidualLimit | None
    band: BandLimit | None
    band_hz: tuple[float, float] | None
    shift_hz: FloatArray
    residual_nm: FloatArray
    frequency_hz: float | None


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
        Errors of the model's frequency [Hz]: model less truth. The true vibrations move over
        the whole range between the extremes.

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
    limit = _limit_or_none(lambda: least_residual(hardware, truth))
    band_hz = _error_band(truth, shifts)
    band = None
    if band_hz is not None:
        line = vibrations[0]
        band = _limit_or_none(
            lambda: least_worst_residual(
                hardware, truth, band_hz=band_hz, rms_nm=line.rms_nm, direction=line.direction
            )
        )
    rows, curves = [], []
    for name, design in designs.items():
        loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
        residual_nm, ratio, curve = _evaluate_loop(loop, truth, imaging, shifts)
        worst_nm = float(np.max(curve)) if shifts.size else residual_nm
        rows.append(
            LimitRow(
                design=name,
                method=design.method,
                residual_nm=residual_nm,
                strehl=ratio,
                above_limit_percent=above_percent(residual_nm, limit.rms_nm if limit else np.nan),
                worst_nm=worst_nm,
                above_band_limit_percent=above_percent(worst_nm, band.rms_nm if band else np.nan),
                stable=loop.is_stable,
            )
        )
        curves.append(curve)
    frequencies = {line.frequency_hz for line in vibrations}
    return LimitStudy(
        rows=tuple(rows),
        limit=limit,
        band=band,
        band_hz=band_hz,
        shift_hz=frozen_copy(shifts),
        residual_nm=frozen_copy(curves),
        frequency_hz=frequencies.pop() if len(frequencies) == 1 else None,
    )


def _frequency_shifts(truth: Truth, errors_hz: Sequence[float]) -> FloatArray:
    """Return true frequencies less those of the truth; the model's error is their opposite."""
    if not truth.vibrations:
        return np.zeros(0)
    moved = -np.array(errors_hz)
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
    rest = np.trace(budget.turbulence_nm2 + budget.noise_nm2)
    still = replace(truth, turbulence=None, noise_nm=0.0)
    variance = np.empty(shifts.size)
    for i, shift in enumerate(shifts):
        moved = tuple(
            replace(line, frequency_hz=line.frequency_hz + float(shift))
            for line in stationary_vibrations(truth.vibrations)
        )
        own = residual_budget(loop, replace(still, vibrations=moved))
        variance[i] = rest + np.trace(own.vibration_nm2)
    return budget.rms_nm, strehl(budget, imaging), np.sqrt(variance)


def above_percent(rms_nm: float, limit_nm: float) -> float:
    """Return how far a residual is above a limit [%]; nan where the limit is 0 or nan."""
    return 100 * (rms_nm / limit_nm - 1) if limit_nm > 0 else np.nan


def limit_or_nan(limit: Callable[[], ResidualLimit | BandLimit]) -> float:
    """Return the least residual [nm rms], nan where it cannot be computed."""
    found = _limit_or_none(limit)
    return np.nan if found is None else found.rms_nm


def _limit_or_none(limit: Callable[[], T]) -> T | None:
    try:
        return limit()
    except LbtSynthError:
        return None


def model_limit(design: EstimatorDesign) -> tuple[float, float]:
    """Return the limit of a filter's own model [nm rms], and how far its error is above it [%].

    Both are nan where the limit cannot be computed. The second is nan also for a fractional
    delay or a moving mirror: there only an LQG's estimation error is its residual.
    """
    plant = design.problem
    if not isinstance(plant, TipTiltPlant | FullStatePlant):
        return np.nan, np.nan
    limit_nm = limit_or_nan(lambda: least_model_residual(plant))
    delay = plant.hardware.delay_frames
    settled = delay == round(delay) and plant.hardware.mirror is None
    exact = settled or isinstance(design, LqgDesign)
    return limit_nm, above_percent(design.rms, limit_nm) if exact else np.nan


def shaped_limit(design: ShapedDesign) -> tuple[float, float]:
    """Return the limit of a shaped design's own spectra [nm rms], and its residual above it [%].

    Both are over all modes at unit sensor gain: the variance plus the worst of the band. They
    are nan where a mode has no variance at unit gain, or several bands, as the limit of their
    sum is not known.
    """
    limit_nm2, residual_nm2 = 0.0, 0.0
    for spec, parameter in zip(design.specifications, design.parameters, strict=True):
        at_unit = [leaf for leaf in leaves(spec.objective) if leaf.sensor_gain == 1]
        variances = [leaf for leaf in at_unit if isinstance(leaf, ResidualVariance)]
        bands = [leaf for leaf in at_unit if isinstance(leaf, VibrationBand)]
        if len(variances) != 1 or len(bands) > 1:
            return np.nan, np.nan
        hardware = mode_hardware(design.loop_hardware)
        truth = Truth(turbulence=variances[0].turbulence, noise_nm=variances[0].noise_nm)
        found = limit_or_nan(partial(_mode_limit, hardware, truth, bands))
        loop = mode_loop(design.loop_hardware, parameter)
        limit_nm2 += found**2
        residual_nm2 += variances[0].measured_nm2(loop)
        residual_nm2 += sum(band.measured_nm2(loop) for band in bands)
    limit_nm = float(np.sqrt(limit_nm2))
    return limit_nm, above_percent(float(np.sqrt(residual_nm2)), limit_nm)


def _mode_limit(
    hardware: LoopHardware, truth: Truth, bands: list[VibrationBand]
) -> ResidualLimit | BandLimit:
    if not bands:
        return least_residual(hardware, truth)
    return least_worst_residual(
        hardware,
        truth,
        band_hz=(bands[0].low_hz, bands[0].high_hz),
        rms_nm=bands[0].rms_nm,
        direction=(1.0,),
    )
