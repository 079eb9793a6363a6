"""Proof of a controller as another program computes it: the loop closed around what is written.

Rounded coefficients are put back into the loop exactly. The rounding of the arithmetic is white
noise that enters with the command; its variance bounds that of the target's order of sums.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.design import Check, Design, ShapedDesign
from lbt_synth.design.result import EstimatorDesign
from lbt_synth.design.shaping.channel import SingleModeLoop
from lbt_synth.design.shaping.objectives import leaves
from lbt_synth.design.shaping.uncertainty import SensorGainRange
from lbt_synth.linear import Controller, hinf_norm
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.loop import ClosedLoop, close_loop, stable_sensor_gains
from lbt_synth.loop.budget import ar_covariance, plant_budget
from lbt_synth.loop.closed_loop import STABILITY_MARGIN, radii_by_gain
from lbt_synth.models import ARModel, LoopHardware, TipTiltPlant
from lbt_synth.validation import FloatArray

_LOSS = 0.01  # of residual and of margins, relative
_SCENARIOS = (1.0, 0.7, 0.5, 0.358)  # sensor gains, where a design names none
_STEP = 1.01  # ratio of neighbouring sensor gains
_WIDEST = 10.0  # factor on the sensor gain, to either side
_POLE, _NOISE = 0.99, 0.1  # of a reference disturbance of unit variance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rounding:
    """Rounding of the arithmetic, as noise.

    Attributes
    ----------
    entry : Controller
        From the noise (m,) of the sums to the command; A and C are those of the controller.
    variance : callable
        From the rms of measurements and commands, (m,) each, to the variance of the noise, (m,).
    """

    entry: Controller
    variance: Callable[[FloatArray, FloatArray], FloatArray]


def prove_written(
    design: Design, written: Controller, rounding: Rounding | None = None
) -> tuple[Check, ...]:
    """Check the loop around a controller as it is written, against that of its design.

    Parameters
    ----------
    design : Design
        The design, of a loop.
    written : Controller
        The controller with the numbers of the file.
    rounding : Rounding, optional
        What the arithmetic adds; for a loop with as many modes as measurements and commands.

    Returns
    -------
    tuple of Check
        Stability over the design's sensor gains; residual, arithmetic included, and modulus margin
        within 1 % of the design's; the demands of a shaped design, each within 1 % of its limit.
    """
    hardware = design.hardware
    assert hardware is not None  # the callers refuse a design without a loop
    low, high = _gain_interval(design, hardware)
    count = 2 + int(np.log(high / low) / np.log(_STEP))
    gains = np.append(np.geomspace(low, high, count), 1.0)
    radius = float(np.max(radii_by_gain(hardware, written)(gains)))
    name = f"spectral radius at sensor gains {low:.4g} to {high:.4g}"
    checks = [Check(name, radius, 1 - STABILITY_MARGIN, f"eigenvalues at {gains.size} gains")]
    if not checks[0].passed:
        return tuple(checks)
    inside = (gain for gain in _scenarios(design) if low <= gain <= high)
    checks += (_residual_check(design, written, rounding, gain) for gain in inside)
    own, other = (close_loop(hardware, c) for c in (design.controller, written))
    lost = hinf_norm(other.output_sensitivity()).value / hinf_norm(own.output_sensitivity()).value
    checks.append(Check("modulus margin, loss", float(lost) - 1, _LOSS, "level sets"))
    if isinstance(design, ShapedDesign):
        checks += _demand_checks(design, other)
    return tuple(checks)


def _gain_interval(design: Design, hardware: LoopHardware) -> tuple[float, float]:
    """Return the sensor gains that are demanded, or 1 % less than the design holds."""
    if isinstance(design, ShapedDesign):
        demands = [d for spec in design.specifications for d in spec.demands]
        ranges = [d for d in demands if isinstance(d, SensorGainRange)]
        return min([1.0, *(r.low for r in ranges)]), max([1.0, *(r.high for r in ranges)])
    low, high = stable_sensor_gains(hardware, design.controller)
    return min(max(low * _STEP, 1 / _WIDEST), 1.0), max(min(high / _STEP, _WIDEST), 1.0)


def _scenarios(design: Design) -> tuple[float, ...]:
    if not isinstance(design, ShapedDesign):
        return _SCENARIOS
    terms = [leaf for spec in design.specifications for leaf in leaves(spec.objective)]
    return tuple(sorted({leaf.sensor_gain for leaf in terms}, reverse=True))


def _residual_check(
    design: Design, written: Controller, rounding: Rounding | None, gain: float
) -> Check:
    """Compare the residual, with what the rounding of the arithmetic adds."""
    hardware = design.hardware
    assert hardware is not None
    n, m = hardware.modes, hardware.n_commands
    loops = [close_loop(hardware, c, sensor_gain=gain) for c in (design.controller, written)]
    before, after = (_variances(design, loop, slice(n)) for loop in loops)
    how = "Lyapunov equations, level sets"
    if rounding is not None:
        commands = np.sqrt(_variances(design, loops[1], slice(n, n + m)))
        measured = np.sqrt(_variances(design, loops[1], slice(n + m, None)))
        variance = rounding.variance(measured, commands)
        after = after + _rounding_left(hardware, written, rounding.entry, variance, gain)
        how += "; rounding as white noise"
    loss = float(np.max(np.sqrt(after / before))) - 1
    return Check(f"residual at sensor gain {gain:g}, loss", loss, _LOSS, how)


def _variances(design: Design, loop: ClosedLoop, rows: slice) -> FloatArray:
    """Variance of some outputs of the loop, one per mode, under what the design is for."""
    n, s = loop.hardware.modes, loop.system
    seen = replace(loop, system=replace(s, C=s.C[rows], D=s.D[rows]))
    if isinstance(design, ShapedDesign):
        return np.array(
            [
                sum(
                    leaf.measured_nm2(_mode_of(seen, mode))
                    for leaf in leaves(spec.objective)
                    if leaf.sensor_gain == loop.sensor_gain
                )
                for mode, spec in enumerate(design.specifications)
            ]
        )
    if isinstance(design, EstimatorDesign) and isinstance(design.problem, TipTiltPlant):
        return np.diag(plant_budget(seen, design.problem).total_nm2)
    drive = np.sqrt(1 - _POLE**2)
    rate = loop.hardware.frame_rate_hz
    slow = ARModel(coefficients=np.array([_POLE]), driving_rms_nm=drive, frame_rate_hz=rate)
    B, D = s.B[:, n:] * _NOISE, seen.system.D[:, n:] * _NOISE
    noise = seen.system.C @ stationary_covariance(s.A, B @ B.T) @ seen.system.C.T + D @ D.T
    return np.asarray(np.diag(ar_covariance(seen, slow, np.eye(n)) + noise))


def _rounding_left(
    hardware: LoopHardware,
    written: Controller,
    entry: Controller,
    variance: FloatArray,
    gain: float,
) -> FloatArray:
    """Variance of the residual that noise in the sums leaves, one per mode."""
    n, q = hardware.modes, hardware.n_measurements
    # the noise is measured by a sensor of its own, which sees no phase
    blind = np.vstack([hardware.sensor, np.zeros((variance.size, n))])
    both = replace(written, B=np.hstack([written.B, entry.B]), D=np.hstack([written.D, entry.D]))
    s = close_loop(replace(hardware, sensor_matrix=blind), both, sensor_gain=gain).system
    B, C, D = s.B[:, n + q :] * np.sqrt(variance), s.C[:n], s.D[:n, n + q :] * np.sqrt(variance)
    return np.asarray(np.diag(C @ stationary_covariance(s.A, B @ B.T) @ C.T + D @ D.T))


def _mode_of(loop: ClosedLoop, mode: int) -> SingleModeLoop:
    """Take one mode of a loop, whose outputs may be any; noise enters as the mode's own sensor."""
    hardware, s, n = loop.hardware, loop.system, loop.hardware.modes
    inputs = [s.B[:, mode], s.B[:, n:] @ hardware.sensor[:, mode]]
    direct = [s.D[:, mode], s.D[:, n:] @ hardware.sensor[:, mode]]
    rows = slice(mode, None, n)  # the mode's residual, command and measurement
    system = replace(s, B=np.stack(inputs, axis=1), C=s.C[rows], D=np.stack(direct, axis=1)[rows])
    one = hardware.single_mode()
    own = replace(loop, system=system, hardware=one)
    return SingleModeLoop(hardware=one, controller=loop.controller, _loops={loop.sensor_gain: own})


def _demand_checks(design: ShapedDesign, loop: ClosedLoop) -> list[Check]:
    """Check the demands of each mode in the loop as written; equal modes once."""
    hardware, s = loop.hardware, loop.system
    n, m = hardware.modes, hardware.n_commands
    to_modes = np.zeros((3 * n, len(s.C)))
    to_modes[:n, :n] = np.eye(n)
    to_modes[n : 2 * n, n : n + m] = hardware.influence
    to_modes[2 * n :, n + m :] = np.linalg.pinv(hardware.sensor)
    modal = replace(loop, system=replace(s, C=to_modes @ s.C, D=to_modes @ s.D))
    checks, found = [], set()
    for mode, (spec, parameter) in enumerate(
        zip(design.specifications, design.parameters, strict=True)
    ):
        if (id(spec), id(parameter)) not in found:
            found.add((id(spec), id(parameter)))
            for check in spec.checks(_mode_of(modal, mode)):
                limit = check.limit + _LOSS * abs(check.limit)
                name = f"mode {mode + 1}: {check.name}"
                checks.append(replace(check, name=name, limit=limit))
    return checks
