"""The exact numbers of one design in the loop of a configuration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lbt_synth.config import Config
from lbt_synth.design import Check, Design
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.interop import frame_cost
from lbt_synth.interop.c.terms import FrameCost
from lbt_synth.linear import Controller, largest_singular_values
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.loop import (
    ClosedLoop,
    LoopMargins,
    ResidualBudget,
    close_loop,
    loop_margins,
    moving_gain,
    residual_budget,
    stable_sensor_gains,
    strehl,
)
from lbt_synth.loop.closed_loop import STABILITY_MARGIN, radii_by_gain
from lbt_synth.loop.moving_gain import MovingGain
from lbt_synth.models import LoopHardware
from lbt_synth.models.loop_hardware import loop_differences
from lbt_synth.studies import RobustnessMap, robustness_map
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy

_GAINS = np.geomspace(0.01, 100.0, 400)  # where stable intervals are looked for


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DesignAssessment:
    """What is known exactly of one design in the loop of a configuration."""

    name: str  # its name in the report
    design: Design  # the design
    notes: tuple[str, ...]  # how the loop that it was made for differs from this one
    stable: bool  # whether the loop is stable at the real sensor gain
    spectral_radius: float  # largest modulus of the closed loop's poles
    # (n,): poles of the closed loop, and of the controller alone
    loop_poles: ComplexArray
    controller_poles: ComplexArray
    # norm and standard deviation of the estimation error in its own model; nan for a design that
    # estimates nothing
    gamma: float
    estimation_rms: float
    budget: ResidualBudget | None  # exact residual; None where the loop is unstable
    strehl: float  # Strehl ratio in [0, 1]; nan where the loop is unstable
    margins: LoopMargins | None  # margins at the real sensor gain; None where the loop is unstable
    # intervals of real sensor gains for which the loop is stable, relative to the sensor matrix of
    # the configuration; searched for between 0.01 and 100 times the assumed one
    sensor_gains: tuple[tuple[float, float], ...]
    # intervals of a sensor gain that moves, around the real one; None where the loop is unstable
    moving: MovingGain | None
    checks: tuple[Check, ...]  # the certificate, recomputed
    certificate_error: str  # why it could not be; empty if it could
    cost: FrameCost  # arithmetic of one frame, as exported to C
    # (f,): largest singular values of the estimation error at the frequencies of the report
    error_norms: FloatArray | None
    # (f,): those of the loop, from phase to residual and from noise to residual; None where the
    # loop is unstable
    rejection: FloatArray | None
    noise_transfer: FloatArray | None
    curve: RobustnessMap  # Strehl ratio over the frequency error at the real sensor gain
    map: RobustnessMap  # the same over frequency error and real sensor gain

    @property
    def certified(self) -> bool:
        """Whether the certificate could be recomputed, and every check passed."""
        return not self.certificate_error and all(check.passed for check in self.checks)

    @property
    def residual_nm(self) -> float:
        """Exact residual [nm rms]; nan where the loop is unstable."""
        return float("nan") if self.budget is None else self.budget.rms_nm


def assess_design(
    name: str, design: Design, config: Config, *, frequency_hz: FloatArray, errors_hz: FloatArray
) -> DesignAssessment:
    """Assess a design; its transfer functions are taken at frequency_hz (f,)."""
    hardware, truth, assumed_gain = config.hardware, config.truth, config.sensor_gain
    sensor_gains = np.unique(config.settings.robustness.sensor_gains)
    loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
    budget = residual_budget(loop, truth) if loop.is_stable else None
    margins = loop_margins(loop) if loop.is_stable else None
    rejection, noise_transfer = (
        frozen_copy(spectral_norms(response(frequency_hz))) if loop.is_stable else None
        for response in (loop.sensitivity, loop.noise_transfer)
    )
    checks, complaint = _recertify(design)
    own = design.hardware
    mapped = partial(robustness_map, design, truth, config.imaging, hardware=hardware)
    curve, found = (
        mapped(errors_hz=errors_hz, sensor_gains=gains)
        for gains in ([truth.sensor_gain], sensor_gains / assumed_gain)
    )
    return DesignAssessment(
        name=name,
        design=design,
        notes=() if own is None else tuple(loop_differences(own, hardware)),
        stable=loop.is_stable,
        spectral_radius=loop.spectral_radius,
        loop_poles=loop.system.poles,
        controller_poles=np.linalg.eigvals(design.controller.A).astype(np.complex128),
        gamma=design.gamma,
        estimation_rms=design.rms,
        budget=budget,
        strehl=float("nan") if budget is None else strehl(budget, config.imaging),
        margins=margins,
        sensor_gains=tuple(
            (low * assumed_gain, high * assumed_gain)
            for low, high in stable_intervals(loop, design.controller, margins)
        ),
        moving=moving_gain(loop) if loop.is_stable else None,
        checks=checks,
        certificate_error=complaint,
        cost=frame_cost(design),
        error_norms=largest_singular_values(design.error_system(), frequency_hz)
        if design.is_estimator
        else None,
        rejection=rejection,
        noise_transfer=noise_transfer,
        curve=curve,
        map=replace(found, sensor_gains=frozen_copy(sensor_gains)),  # the real ones again
    )


def require_compatible(name: str, design: Design, hardware: LoopHardware) -> None:
    """Refuse a design that cannot be run in a loop."""
    own = design.hardware
    if own is None:
        raise ProblemError(
            f"{name} is a filter of a bare estimation problem; expected a design for a loop. "
            "Design it for the plant of a configuration."
        )
    for what, mine, theirs in (
        ("axes", own.modes, hardware.modes),
        ("measurements", own.n_measurements, hardware.n_measurements),
        ("commands", own.n_commands, hardware.n_commands),
    ):
        if mine != theirs:
            raise ProblemError(
                f"{name} must be for the configuration's {theirs} {what}; got a design for {mine}. "
                "Design it for this configuration."
            )
    if not np.isclose(own.frame_rate_hz, hardware.frame_rate_hz, rtol=1e-9):
        raise ProblemError(
            f"{name} must run at the configuration's {hardware.frame_rate_hz:g} Hz; got a design "
            f"for {own.frame_rate_hz:g} Hz. Design it for this frame rate."
        )


def stable_intervals(
    loop: ClosedLoop, controller: Controller, margins: LoopMargins | None
) -> list[tuple[float, float]]:
    """Intervals of sensor gains for which a loop is stable, in increasing order.

    The interval around the loop's own gain comes from its margins; others are looked for at 400
    gains from 0.01 to 100.
    """
    found = []
    if margins is not None:
        found.append((margins.gain_low * loop.sensor_gain, margins.gain_high * loop.sensor_gain))
    radii = radii_by_gain(loop.hardware, controller)(_GAINS)
    inside = np.nonzero(radii < 1 - STABILITY_MARGIN)[0]
    for run in np.split(inside, np.nonzero(np.diff(inside) > 1)[0] + 1):
        if not run.size:
            continue
        nominal = float(_GAINS[run[np.argmin(radii[run])]])
        if not any(low < nominal < high for low, high in found):
            found.append(stable_sensor_gains(loop.hardware, controller, nominal=nominal))
    return sorted(found)


def _recertify(design: Design) -> tuple[tuple[Check, ...], str]:
    """Return the checks of the recomputed certificate, or why that failed."""
    try:
        return design.recertify().checks, ""
    except (LbtSynthError, ArithmeticError) as error:
        return (), str(error)
