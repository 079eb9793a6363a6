"""How far designs are from limits and reference designs in the truth, and modes by themselves."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from lbt_synth.config import Config
from lbt_synth.config.samples import at_frame_rate
from lbt_synth.design import Design
from lbt_synth.errors import LbtSynthError, ProblemError, refuse_config
from lbt_synth.loop import ClosedLoop, Imaging, least_residual, residual_budget, strehl
from lbt_synth.loop.band_limit import BandLimit, least_worst_residual
from lbt_synth.loop.least_residual import ResidualLimit, above_percent, limit_or_none
from lbt_synth.loop.margins import phase_margin_deg
from lbt_synth.methods.registry import INTEGRATOR, KALMAN, design_label, reference_methods
from lbt_synth.models import (
    LoopHardware,
    SinusoidalVibration,
    Truth,
    Vibration,
    modal_turbulence,
    pyramid_modal_noise_nm,
)
from lbt_synth.models.turbulence.ar_models import noll_orders
from lbt_synth.models.vibration import stationary_vibrations
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import (
    Facts,
    column,
    fact,
    facts,
    fill_row,
    nm_column,
    percent_column,
    table_row,
)
from lbt_synth.studies.grid import loop_columns
from lbt_synth.validation import FloatArray, frozen_copy, number

_GRID = 65  # shifts over the range of errors, at least
_CLEAR = 0.01  # of the residual's variance by which a reference has to be better
# Residual in the truth over what the design expects: at least twice the variance. A mirror that is
# slower than a Kalman filter believes stays below (1.2 in examples/lbt_slow_mirror.yaml).
_SURPRISING = 1.5


@table_row
class LimitRow:
    """One design beside the limits; what an unstable loop does not have is nan."""

    design: str = column("design", help="Its name")
    method: str = column(help="How it was made")
    residual_nm: float = nm_column(
        "residual", format=".2f", missing="unstable", help="Residual under the truth, rms"
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
    band = band_hz = None
    if len(vibrations) == 1 and isinstance(vibrations[0], SinusoidalVibration) and shifts.size > 1:
        line = vibrations[0]
        band_hz = line.frequency_hz + float(shifts[0]), line.frequency_hz + float(shifts[-1])
        # that of the band stands for it
        rest = replace(truth, vibrations=(), motions=(), frequency_errors_hz=None)
        least_worst = partial(least_worst_residual, alone, rest, band_hz=band_hz)
        band = limit_or_none(partial(least_worst, rms_nm=line.rms_nm, direction=line.direction))
    bounds_nm = tuple(np.nan if bound is None else bound.rms_nm for bound in (limit, band))
    met = hardware, truth, imaging
    rows, curves = zip(
        *(_limit_row(name, design, met, shifts, bounds_nm) for name, design in designs.items()),
        strict=True,
    )
    return LimitStudy(
        rows=rows,
        limit=limit,
        band=band,
        band_hz=band_hz,
        shift_hz=frozen_copy(shifts),
        residual_nm=frozen_copy(curves),
        frequency_hz=truth.lines_hz[0] if len(truth.lines_hz) == 1 else None,
    )


def _limit_row(
    name: str,
    design: Design,
    met: tuple[LoopHardware, Truth, Imaging],
    shifts: FloatArray,
    bounds_nm: tuple[float, ...],
) -> tuple[LimitRow, FloatArray]:
    """Return the row of a design beside the two limits, and its residual at each shift, (s,)."""
    hardware, truth, imaging = met
    loop = design.close(hardware, sensor_gain=truth.sensor_gain)
    numbers = loop_columns(loop, truth, imaging)
    residual_nm = numbers["residual_nm"]
    curve = _residual_curve(loop, truth, shifts, residual_nm)
    worst_nm = float(np.max(curve)) if shifts.size else residual_nm
    margin_deg, (limit_nm, band_nm) = np.nan, bounds_nm
    if loop.reads_others:  # the limits are those of the loop's own sensor
        limit_nm = band_nm = np.nan
    elif loop.is_stable:
        margin_deg = phase_margin_deg(loop)
    row = {
        "design": name,
        "above_limit_percent": above_percent(residual_nm, limit_nm),
        "worst_nm": worst_nm,
        "above_band_limit_percent": above_percent(worst_nm, band_nm),
        "phase_margin_deg": margin_deg,
        "stable": loop.is_stable,
    }
    return fill_row(LimitRow, SimpleNamespace(**numbers), design, **row), curve


def _residual_curve(
    loop: ClosedLoop, truth: Truth, shifts: FloatArray, residual_nm: float
) -> FloatArray:
    """Return the residual at each shift [nm rms], (s,), of which only vibrations move."""
    if not (loop.is_stable and np.any(shifts)):
        return np.full(shifts.size, residual_nm)
    still = replace(truth, turbulence=None, noise_nm=0.0)
    moved = [still.with_frequency_error(float(shift)) for shift in (0.0, *shifts)]
    first, *others = (np.trace(residual_budget(loop, shaken).total_nm2) for shaken in moved)
    return np.asarray(np.sqrt(residual_nm**2 - first + np.array(others)))


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
        "noise_nm": fact(noise_nm, "noise", unit="nm", format=".1f"),
    }
    for name, (residual_nm, ratio) in leaves.items():
        cells[f"{name}_nm"] = fact(residual_nm, design_label(name), unit="nm", format=".1f")
        cells[f"{name}_strehl"] = fact(ratio, "Strehl", unit="%", scale=100, format=".2f")
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
    methods are left out, and so is one that leaves the same as a design. Warnings say what is wrong
    with a design in this truth: an unstable loop, a residual far above what the design expects, and
    demands that cost residual.
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
    design: Design, row: LimitRow, config: Config, others: Mapping[str, tuple[Design, float]]
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


def say_residual(name: str, row: LimitRow, limit: ResidualLimit | None) -> str:
    """Return the sentence on what a stable design leaves in the truth."""
    said = f"{name} leaves {nm_text(row.residual_nm, '.1f')} rms in the truth (Strehl ratio "
    said += f"{100 * row.strehl:.1f} %)"
    if limit is None or np.isnan(row.above_limit_percent):
        return f"{said}."
    least = nm_text(limit.rms_nm, ".1f")
    return f"{said}, {row.above_limit_percent:.0f} % above the {least} of the best linear one."


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalStudy:
    """What controllers leave of the turbulence in each of n modes."""

    turbulence_nm: FloatArray  # (n,): what comes in [nm rms]
    noise_nm: FloatArray  # (n,): per frame [nm]
    gains: FloatArray  # (n,): of the integrators
    residual_nm: Mapping[str, FloatArray]  # of integrators and of filters, (n,) [nm rms]

    def by_radial_order(self) -> list[Facts]:
        """Return a row for each radial order: root sums of squares over its modes."""
        radial, _ = noll_orders(self.noise_nm.size)
        rms = {"unit": "nm", "format": ".1f"}
        rows = []
        for order in np.unique(radial):
            which = radial == order
            turbulence_nm, optimised_nm, kalman_nm = (
                float(np.linalg.norm(series[which]))
                for series in (self.turbulence_nm, *self.residual_nm.values())
            )
            noise_nm = float(self.noise_nm[which][0])
            rows.append(
                facts(
                    radial_order=fact(int(order), "radial order"),
                    modes=fact(int(which.sum()), "modes"),
                    turbulence_nm=fact(turbulence_nm, "turbulence", **rms),
                    noise_nm=fact(noise_nm, "noise per mode", unit="nm", format=".2f"),
                    gain=fact(float(self.gains[which].mean()), "mean gain", format=".3f"),
                    optimised_nm=fact(optimised_nm, "optimised gains", **rms),
                    kalman_nm=fact(kalman_nm, "Kalman", **rms),
                )
            )
        return rows


def compare_modes(config: Config, modes: int) -> ModalStudy:
    """Compare integrators of the best gains with Kalman filters, for the first modes of a loop."""
    from lbt_synth.design.modal import modal_filters, modal_gains

    hardware, sensor_gain = config.hardware, config.settings.model.sensor_gain
    if config.atmosphere is None:
        reason = "the turbulence of hundreds of modes is computed from it"
        config.refuse_key("atmosphere", f"is missing: {reason}")
    rate_hz = hardware.frame_rate_hz
    air = modal_turbulence(config.atmosphere, modes=modes, frame_rate_hz=rate_hz)
    for key, value in (("sensor.noise_nm", config.noise_nm), ("model.sensor_gain", sensor_gain)):
        if np.ndim(value):
            config.refuse_key(key, "must be one number for hundreds of modes; got one per axis")
    pyramid, noise_nm = config.settings.sensor.pyramid, np.full(modes, float(config.noise_nm))
    if pyramid is not None:
        modulation = pyramid.modulation_lambda_over_d
        noise_nm = pyramid_modal_noise_nm(
            float(config.noise_nm), modes=modes, modulation_lambda_over_d=modulation
        )
    lines = dict[int, list[Vibration]]()
    for line in config.plant.vibrations:  # each axis by itself
        for axis, share in enumerate(line.direction):
            if abs(share) > 1e-9:  # more than rounding
                tilted = replace(line, rms_nm=abs(share) * line.rms_nm, direction=(1.0,))
                lines.setdefault(axis, []).append(tilted)
    loop: dict[str, Any] = {"hardware": hardware, "noise_nm": noise_nm, "vibrations": lines}
    loop["sensor_gain"] = config.sensor_gain
    gains = modal_gains(air, **loop)
    return ModalStudy(
        turbulence_nm=air.rms_nm,
        noise_nm=noise_nm,
        gains=gains.gains,
        residual_nm={
            "integrators, optimised gains": gains.rms_nm,
            "Kalman filters": modal_filters(air, **loop).rms_nm,
        },
    )
