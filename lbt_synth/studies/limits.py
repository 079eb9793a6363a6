"""How far designs are from the limits of performance, and from reference designs in the truth."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from lbt_synth.config import Config
from lbt_synth.config.samples import at_frame_rate
from lbt_synth.design import Design
from lbt_synth.errors import LbtSynthError, ProblemError, refuse_config
from lbt_synth.loop import Imaging, least_residual, residual_budget, strehl
from lbt_synth.loop.band_limit import BandLimit, least_worst_residual
from lbt_synth.loop.least_residual import ResidualLimit, above_percent, limit_or_none
from lbt_synth.loop.margins import phase_margin_deg
from lbt_synth.methods.registry import INTEGRATOR, KALMAN, design_label, reference_methods
from lbt_synth.models import LoopHardware, SinusoidalVibration, Truth
from lbt_synth.models.vibration import stationary_vibrations
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import NM, PERCENT, Facts, fact, facts
from lbt_synth.studies.grid import evaluate, loop_columns
from lbt_synth.validation import FloatArray, frozen_copy, number

_GRID = 65  # shifts over the range of errors, at least
_CLEAR = 0.01  # of the residual's variance by which a reference has to be better
# Residual in the truth over what the design expects: at least twice the variance. A mirror that is
# slower than a Kalman filter believes stays below (1.2 in examples/lbt_slow_mirror.yaml).
_SURPRISING = 1.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimitStudy:
    """Designs beside the limits, over the true frequency of the vibrations."""

    # one per design: its residual and Strehl ratio in the truth; the residual over the limit, less
    # 1, and the largest one with all true vibrations moved within the range of errors, over the
    # limit for the band; the phase margin. What there is not is nan: of an unstable loop, of a
    # limit of 0, of a design that reads other sensors than the limits do
    rows: tuple[Facts, ...]
    # the least residual of any linear controller; None where the modes do not decouple
    limit: ResidualLimit | None
    # the least worst residual with the sinusoid anywhere in the range of errors; None unless the
    # truth has exactly one vibration, a sinusoid, and there is a range
    band: BandLimit | None
    # (s,): true frequency less that of the truth [Hz], of the vibration that moves most; empty
    # without vibrations
    shift_hz: FloatArray
    # (designs, s): residual of each design at each shift [nm rms]; nan if unstable
    residual_nm: FloatArray
    frequency_hz: float | None  # frequency of the truth's vibrations, if it is one
    # beside reference designs: what is wrong with a design in this truth, by its name, and why
    # references are missing
    warnings: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def limits(
    designs: Mapping[str, Design],
    hardware: LoopHardware,
    truth: Truth,
    imaging: Imaging,
    *,
    errors_hz: Sequence[float] = (0.0,),
    executor: Executor | None = None,
) -> LimitStudy:
    """Evaluate designs exactly under a truth, and compare them with the limits.

    The errors are true frequencies less those of the model [Hz], of the vibration that moves most;
    the others move in proportion, over the whole range between the extremes.
    """
    if not designs:
        raise ProblemError("a study of limits needs at least one design; got none.")
    errors = [number(error, "errors_hz") for error in errors_hz]
    if not errors:
        raise ProblemError("errors_hz must hold at least one error; got none.")
    vibrations = stationary_vibrations(truth.vibrations)
    shifts = np.zeros(0)  # the range of errors, the errors and 0 among them
    if vibrations:
        zero = [0.0] if min(errors) <= 0 <= max(errors) else []
        grid = np.linspace(min(errors), max(errors), _GRID)
        shifts = np.unique(np.concatenate([grid, errors, zero]) + 0.0)
    alone = hardware.own_sensor_alone()
    limit = limit_or_none(lambda: least_residual(alone, truth))
    band = None
    if len(vibrations) == 1 and isinstance(vibrations[0], SinusoidalVibration) and shifts.size > 1:
        line = vibrations[0]
        band_hz = line.frequency_hz + float(shifts[0]), line.frequency_hz + float(shifts[-1])
        # that of the band stands for it
        rest = replace(truth, vibrations=(), motions=(), frequency_errors_hz=None)
        least_worst = partial(least_worst_residual, alone, rest, band_hz=band_hz)
        band = limit_or_none(partial(least_worst, rms_nm=line.rms_nm, direction=line.direction))
    bounds_nm = tuple(np.nan if bound is None else bound.rms_nm for bound in (limit, band))
    loop = hardware, truth, imaging
    samples = ((name, design, loop, shifts, bounds_nm) for name, design in designs.items())
    rows, curves = zip(*evaluate(_limit_row, samples, executor), strict=True)
    return LimitStudy(
        rows=rows,
        limit=limit,
        band=band,
        shift_hz=frozen_copy(shifts),
        residual_nm=frozen_copy(curves),
        frequency_hz=truth.lines_hz[0] if len(truth.lines_hz) == 1 else None,
    )


def _limit_row(
    name: str,
    design: Design,
    seen: tuple[LoopHardware, Truth, Imaging],
    shifts: FloatArray,
    bounds_nm: tuple[float, ...],
) -> tuple[Facts, FloatArray]:
    """Return the row of a design beside the two limits, and its residual at each shift, (s,)."""
    hardware, truth, imaging = seen
    loop = design.close(hardware, sensor_gain=truth.sensor_gain)
    numbers = loop_columns(loop, truth, imaging)
    residual_nm = numbers["residual_nm"]
    curve = np.full(shifts.size, residual_nm)
    if loop.is_stable and np.any(shifts):  # only vibrations move
        still = replace(truth, turbulence=None, noise_nm=0.0)
        moved = [still.with_frequency_error(float(shift)) for shift in (0.0, *shifts)]
        first, *others = (np.trace(residual_budget(loop, shaken).total_nm2) for shaken in moved)
        curve = np.sqrt(residual_nm**2 - first + np.array(others))
    worst_nm = float(np.max(curve)) if shifts.size else residual_nm
    margin_deg, (limit_nm, band_nm) = np.nan, bounds_nm
    if hardware.suite.sensors:  # the limits are those of the loop's own sensor
        limit_nm = band_nm = np.nan
    if loop.is_stable and not loop.reads_others:
        margin_deg = phase_margin_deg(loop)
    above, above_band = above_percent(residual_nm, limit_nm), above_percent(worst_nm, band_nm)
    rms, over = {"unit": "nm", "format": ".2f"}, {"unit": "%", "format": ".2f"}
    row = facts(
        design=fact(name, "design"),
        method=fact(design.method),
        residual_nm=fact(residual_nm, "residual", missing="unstable", **rms),
        strehl=fact(numbers["strehl"], "Strehl", **PERCENT),
        above_limit_percent=fact(above, "above the limit", **over),
        worst_nm=fact(worst_nm, "worst residual", **rms),
        above_band_limit_percent=fact(above_band, "above the band limit", **over),
        phase_margin_deg=fact(margin_deg, "phase margin", unit="deg", format=".1f"),
        stable=fact(loop.is_stable),
    )
    return row, curve


def limits_at_rate(config: Config, frame_rate_hz: float) -> Facts:
    """Return what designs, and the limit, leave of the same star at another frame rate.

    The Strehl ratio of the limit is that of a Gaussian motion; what there is not is nan.
    """
    with refuse_config(f"at {frame_rate_hz:.6g} Hz"):
        here = at_frame_rate(config, frame_rate_hz)
        designs = {m.name: here.design(m.name, **m.compared_options) for m in (INTEGRATOR, KALMAN)}
        study = limits(designs, here.hardware, here.truth, here.imaging)
    leaves = {row.design: (row.residual_nm, row.strehl) for row in study.rows}
    leaves["limit"] = np.nan, np.nan
    if study.limit is not None:
        axes = study.limit.directions
        covariance = axes.T @ (study.limit.variance_nm2[:, None] * axes)
        leaves["limit"] = study.limit.rms_nm, strehl(covariance, here.imaging)
    noise_nm = float(np.sqrt(np.mean(np.square(here.noise_nm))))
    cells = {
        "frame_rate_hz": fact(frame_rate_hz, "rate", unit="Hz", format=".0f"),
        "noise_nm": fact(noise_nm, "noise", **NM),
    }
    for name, (residual_nm, ratio) in leaves.items():
        cells[f"{name}_nm"] = fact(residual_nm, design_label(name), **NM)
        cells[f"{name}_strehl"] = fact(ratio, "Strehl", **PERCENT)
    return facts(**cells)


def compare_in_truth(
    designs: Mapping[str, Design],
    config: Config,
    *,
    without: Collection[str] = (),
    errors_hz: Sequence[float] = (0.0,),
) -> LimitStudy:
    """Compare designs in the stationary truth of a configuration with its reference designs.

    These are the integrator of least residual, the Kalman filter and the H-infinity filter; some
    methods are left out, and so is one that leaves the same as a design. Warnings are of unstable
    loops, of a residual far above what the design expects, and of demands that cost residual.
    """
    references: dict[str, Design] = {}
    notes = []
    for method in reference_methods():
        if method.name in without:
            continue
        name = f"{method.name} (reference)" if method.name in designs else method.name
        try:
            references[name] = config.design(method.name, **method.reference_options)
        except LbtSynthError as error:
            notes.append(f"{method.name} is left out: {error}")
    loop = config.hardware, config.truth, config.imaging
    study = limits({**designs, **references}, *loop, errors_hz=errors_hz)
    ours, theirs = study.rows[: len(designs)], study.rows[len(designs) :]
    there = np.array([row.residual_nm for row in ours])
    others = [row for row in theirs if not np.isclose(row.residual_nm, there, rtol=1e-6).any()]
    better = {row.design: (references[row.design], row.residual_nm) for row in others}
    rows = (*ours, *others)
    return replace(
        study,
        rows=rows,
        residual_nm=frozen_copy(study.residual_nm[[study.rows.index(row) for row in rows]]),
        warnings={
            row.design: tuple(_warnings(designs[row.design], row, config, better)) for row in ours
        },
        notes=tuple(notes),
    )


def _warnings(
    design: Design, row: Facts, config: Config, others: Mapping[str, tuple[Design, float]]
) -> Iterator[str]:
    """Yield what is wrong with a design in the truth of a configuration."""
    if not row.stable:
        yield "the loop is unstable in the truth"
        return
    expected_nm = np.inf if design.expected_residual_nm is None else design.expected_residual_nm
    means_nm = 0.0
    if row.residual_nm > _SURPRISING * expected_nm:  # means leave hardly more
        loop = design.close(config.hardware, sensor_gain=config.truth.sensor_gain)
        means_nm = float(residual_budget(loop, config.truth, frame_means=True).rms_nm)
    if surprises := means_nm > _SURPRISING * expected_nm:
        yield (
            f"the truth leaves {nm_text(means_nm)} in means over frames, where the design expects "
            f"{nm_text(expected_nm)}: it has power that the design was not made for"
        )
    for name, (other, residual_nm) in others.items():
        if not residual_nm**2 < (1 - _CLEAR) * row.residual_nm**2:
            continue
        violated = design.violated_demands(other.controller)
        if violated is None:
            return
        if violated:
            yield f"{name} leaves less in the truth; it violates: {'; '.join(violated)}"
        elif not surprises:
            yield (
                f"{name} leaves less in the truth, where each vibration is at one frequency; "
                "this design is for all frequencies of its bands"
            )
