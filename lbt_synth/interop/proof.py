"""Proof of a controller as another program computes it: the loop closed around what is written.

The rounding of its sums is white noise that enters with the command.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.design import Check, Design
from lbt_synth.design.shaping.channel import SingleModeLoop
from lbt_synth.design.shaping.demands import CommandRms, Demand, LoopErrors
from lbt_synth.design.shaping.specification import Specification
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, StateSpace, hinf_norm
from lbt_synth.linear.controller import RunningController
from lbt_synth.linear.lyapunov import output_variances, stationary_root
from lbt_synth.loop import ClosedLoop, close_loop, stable_sensor_gains
from lbt_synth.loop.budget import residual_budget
from lbt_synth.loop.closed_loop import STABILITY_MARGIN, youla_controller
from lbt_synth.loop.disturbances import Disturbance
from lbt_synth.loop.simulation import Drop, SteppedController, simulate
from lbt_synth.loop.stable_range import affine_radii, parts_by_gain
from lbt_synth.models import ARModel, LoopHardware
from lbt_synth.validation import FloatArray

ROUNDOFF = {"double": 2.0**-53, "single": 2.0**-24}  # largest relative error of an operation
LOSS = 0.01  # of residual and of margins, relative
_SCENARIOS = (1.0, 0.7, 0.5, 0.358)  # sensor gains, where a design names none
_STEP = 1.01  # ratio of neighbouring sensor gains
_WIDEST = 10.0  # factor on the sensor gain, to either side
FRAMES = 2000  # of a rehearsal
POLE, NOISE = 0.99, 0.1  # of a reference disturbance of unit variance
EIGENVALUES = "eigenvalues of the monodromy, per frame"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Written:
    """A controller as a target computes it: numbers, the rounding of its sums, what it lacks."""

    controllers: Mapping[frozenset[str], Controller]  # for each set of sensors that are not read
    entry: Controller | None = None  # from the noise (r,) of the sums to the command
    # from the sensor gain and the rms of measurements (q,) and commands (m,) to that noise's
    variance: Callable[[float, FloatArray, FloatArray], FloatArray] | None = None
    signals: int = 0  # first states of the controller whose rms follow the measurements'
    # bounds on what is left out: from the sensor gain to the change of the residual's rms [nm], and
    # to that of the sensitivities
    residual_change_nm: Callable[[float], float] | None = None
    response_change: Callable[[float], float] | None = None
    checks: tuple[Check, ...] = ()  # of what has to hold besides, as stability without the loop


def sums_variance(
    whole: FloatArray, signals: int, roundoff: float
) -> Callable[[float, FloatArray, FloatArray], FloatArray]:
    """Return the variance of the rounding of each row's products and partial sums, left to right.

    The columns of ``whole`` (r, c) belong to signals of the state, to commands, to measurements.
    """

    def variance(_gain: float, measured: FloatArray, commands: FloatArray) -> FloatArray:
        direct = measured.size - signals
        terms = np.abs(whole) * np.concatenate([measured[direct:], commands, measured[:direct]])
        sums = np.where(terms > 0, np.cumsum(terms, axis=1), 0.0)
        return np.asarray(roundoff**2 / 3 * np.sum(terms**2 + sums**2, axis=1))

    return variance


def command_as_state(textbook: StateSpace) -> Controller:
    """Return the controller of a textbook form, whose command is a further state."""
    n, (m, q) = textbook.n_states, textbook.D.shape
    return Controller(
        A=np.block([[textbook.A, np.zeros((n, m))], [textbook.C, np.zeros((m, m))]]),
        B=np.vstack([textbook.B, textbook.D]),
        C=np.eye(m, n + m, k=n),
        D=np.zeros((m, q)),
        dt_s=textbook.dt_s,
    )


def filter_of_history(hardware: LoopHardware, system: StateSpace) -> tuple[Controller, Controller]:
    """Return the controller of a filter of pseudo-open-loop values, its command a further state.

    Beside it is what noise in the command and noise in these values become.
    """
    m, n = system.D.shape[0], system.n_states
    controller = youla_controller(hardware, command_as_state(system))
    command = np.eye(controller.n_states, m, k=-n)  # a part of the command that is sent
    B = np.hstack([command, controller.B])
    return controller, replace(controller, B=B, D=np.zeros((m, 2 * m)))


def prove_written(design: Design, written: Written) -> tuple[Check, ...]:
    """Check the loop around a controller as it is written; without a loop there is none."""
    if design.hardware is None:
        return written.checks
    checks, several = [], len(written.controllers) > 1
    if written.entry is not None or not several:
        checks += _prove_loop(design, design.hardware, written)
    if several:
        checks += _prove_sensors(design, design.hardware, written)
    return (*checks, *written.checks)


def _prove_sensors(design: Design, hardware: LoopHardware, written: Written) -> list[Check]:
    """Check the loops of all sensors and with some missing: stable, and the residual is kept."""
    checks = []
    for name, sets in (
        ("all sensors", [frozenset[str]()]),
        ("any sensors missing", [some for some in written.controllers if some]),
    ):
        radii, losses = [0.0], [0.0]
        for some in sets:
            loops = [
                close_loop(hardware, of[some], blind=tuple(some))
                for of in (written.controllers, design.controllers)
            ]
            radii.append(loops[0].system.radius_per_frame)
            if not loops[0].is_stable:
                losses.append(np.inf)
                break
            after, before = (_residual_nm(design, loop) for loop in loops)
            losses.append(after / before - 1)
        name_of_loss = f"residual with {name}, loss"
        checks += [
            Check(f"spectral radius with {name}", max(radii), 1 - STABILITY_MARGIN, EIGENVALUES),
            Check(name_of_loss, max(losses), LOSS, "Lyapunov equations"),
        ]
    return checks


def _residual_nm(design: Design, loop: ClosedLoop) -> float:
    """Return the rms residual of a loop under the plant of its design, or the reference."""
    if design.plant is not None:
        return float(residual_budget(loop, design.problem).rms_nm)
    return float(np.sqrt(np.sum(mode_variances(design, loop, slice(loop.hardware.modes)))))


def _prove_loop(design: Design, hardware: LoopHardware, written: Written) -> list[Check]:
    """Check stability, residual, modulus margin and demands of a loop over its sensor gains."""
    controller = written.controllers[frozenset()]
    low, high = proved_gains(design, hardware)
    count = 2 + int(np.log(high / low) / np.log(_STEP))
    gains = np.append(np.geomspace(low, high, count), 1.0)
    radius = float(np.max(affine_radii(parts_by_gain(hardware, controller), gains)))
    name = f"spectral radius at sensor gains {low:.4g} to {high:.4g}"
    checks = [Check(name, radius, 1 - STABILITY_MARGIN, f"eigenvalues at {gains.size} gains")]
    if not checks[0].passed:
        return checks
    inside = (gain for gain in scenario_gains(design) if low <= gain <= high)
    checks += (_residual_check(design, hardware, written, gain) for gain in inside)
    exact, other = (close_loop(hardware, c) for c in (design.controller, controller))
    before, after = (hinf_norm(loop.path("noise", "reading")).value for loop in (exact, other))
    change = written.response_change
    after += change(1.0) if change else 0.0
    checks.append(Check("modulus margin, loss", float(after / before) - 1, LOSS, "level sets"))
    return checks + _demand_checks(design, other, change)


def proved_gains(design: Design, hardware: LoopHardware) -> tuple[float, float]:
    """Return the sensor gains that are demanded, or 1 % less than the design holds."""
    if specifications := design.mode_specifications:
        return demanded_gains(specifications)
    low, high = stable_sensor_gains(hardware, design.controller)
    return min(max(low * _STEP, 1 / _WIDEST), 1.0), max(min(high / _STEP, _WIDEST), 1.0)


def demanded_gains(specifications: Iterable[Specification]) -> tuple[float, float]:
    """Return the least and the largest sensor gain that demands name, 1 among them."""
    demands = [demand for spec in specifications for demand in spec.demands]
    ranges = [d for d in demands if isinstance(d, LoopErrors)]
    return min([1.0, *(r.low for r in ranges)]), max([1.0, *(r.high for r in ranges)])


def scenario_gains(design: Design) -> tuple[float, ...]:
    """Return the sensor gains at which the residual is compared."""
    terms = [term for spec in design.mode_specifications for term in spec.terms]
    return tuple(sorted({term.sensor_gain for term in terms}, reverse=True)) or _SCENARIOS


def _residual_check(design: Design, hardware: LoopHardware, written: Written, gain: float) -> Check:
    """Compare the residual, with what the rounding of the arithmetic and what is left out add."""
    controller = written.controllers[frozenset()]
    n, m = hardware.modes, hardware.n_commands
    pair = design.controller, controller
    loops = [close_loop(hardware, c, sensor_gain=gain) for c in pair]
    before = mode_variances(design, loops[0], slice(n))
    change, how = written.residual_change_nm, "Lyapunov equations, level sets"
    how += ", and what is left out" if change else ""
    system, rows = loops[1].system, np.eye(written.signals, loops[1].system.n_states)
    D = np.vstack([system.D, np.zeros((len(rows), system.D.shape[1]))])
    seen = replace(loops[1], system=replace(system, C=np.vstack([system.C, rows]), D=D))
    outputs = mode_variances(design, seen, slice(None))
    sizes, after = np.sqrt(np.abs(outputs)), outputs[:n]  # below zero is the size of its rounding
    rounding_nm2 = np.zeros(n)
    if written.variance is not None and written.entry is not None:
        variance = written.variance(gain, sizes[n + m :], sizes[n : n + m])
        rounding_nm2 = _rounding_left(hardware, controller, written.entry, variance, gain)
    with np.errstate(invalid="ignore"):  # not a number: no accuracy, and the check fails
        after_nm = np.sqrt(after + rounding_nm2) + (change(gain) if change else 0.0)
        loss = float(np.max(after_nm / np.sqrt(before))) - 1
        share = float(np.sqrt(np.max(rounding_nm2 / before)))
    if written.variance is not None:
        how += f"; rounding at most {share:.1e} of it"
    return Check(f"residual at sensor gain {gain:g}, loss", loss, LOSS, how)


def mode_variances(design: Design, loop: ClosedLoop, rows: slice) -> FloatArray:
    """Variance of some outputs of the loop, one each, under what the design is for."""
    s, rate = loop.system, loop.hardware.frame_rate_hz
    seen = replace(loop, system=replace(s, C=s.C[rows], D=s.D[rows]))
    n, q = loop.hardware.modes, loop.controller.D.shape[-1]
    if design.mode_specifications:
        return _shaped_variances(design, seen)
    drive = np.sqrt(1 - POLE**2)
    slow = ARModel(coefficients=np.array([POLE]), driving_rms_nm=drive, frame_rate_hz=rate)
    sources, noise = [(slow, row) for row in np.eye(n)], NOISE * np.eye(q)
    if design.is_estimator and (plant := design.plant) is not None:
        sources = list(zip(plant.turbulence, np.eye(n), strict=True))
        sources += [(v.ar_model(rate), np.asarray(v.direction)) for v in plant.vibrations]
        noise = plant.D[:, -q:]
    return _gaussian_variances(seen, sources, noise)


def _gaussian_variances(
    loop: ClosedLoop, sources: list[tuple[ARModel, FloatArray]], noise: FloatArray
) -> FloatArray:
    """Variance of each output under AR processes along directions, and noise of a factor."""
    n, s = loop.hardware.modes, loop.system.balanced()
    firsts = [np.outer(direction, np.eye(1, model.order)) for model, direction in sources]
    shape = np.hstack(firsts)
    air = block_diag(*(model.companion for model, _ in sources))
    A = np.block([[s.A, s.B[:, :n] @ shape], [np.zeros((len(air), s.n_states)), air]])
    newest = block_diag(*(m.driving_rms_nm * np.eye(m.order, 1) for m, _ in sources))
    B = block_diag(s.B[:, n:] @ noise, newest)
    C, through = np.hstack([s.C, s.D[:, :n] @ shape]), s.D[:, n:] @ noise
    return output_variances(C, through, stationary_root(A, B))


def _shaped_variances(design: Design, loop: ClosedLoop) -> FloatArray:
    """Variance of each output under the terms of a shaped design, mode by mode."""
    variances = np.zeros(len(loop.system.C))
    for mode, spec in enumerate(design.mode_specifications):
        terms = [term for term in spec.terms if term.sensor_gain == loop.sensor_gain]
        for row in range(variances.size):
            one = _mode_of(loop, mode, slice(row, row + 1))
            variances[row] += sum(term.measured_nm2(one) for term in terms)
    return variances


def _rounding_left(
    hardware: LoopHardware,
    written: Controller,
    entry: Controller,
    variance: FloatArray,
    gain: float,
) -> FloatArray:
    """Variance of the residual that noise in the sums leaves, one per mode."""
    n, q = hardware.modes, written.D.shape[-1]
    # the noise is measured by a sensor of its own, which sees no phase, as channels see none
    silent = q - hardware.n_measurements + variance.size
    blind = np.vstack([hardware.sensor, np.zeros((silent, n))])
    both = replace(written, B=np.hstack([written.B, entry.B]), D=np.hstack([written.D, entry.D]))
    path = replace(hardware.own_sensor_alone(), sensor_matrix=blind)
    s = close_loop(path, both, sensor_gain=gain).system
    B, C, D = s.B[:, n + q :] * np.sqrt(variance), s.C[:n], s.D[:n, n + q :] * np.sqrt(variance)
    return output_variances(C, D, stationary_root(s.A, B))


def _mode_of(loop: ClosedLoop, mode: int, rows: slice) -> SingleModeLoop:
    """Take outputs of a loop as those of one mode; noise enters as the mode's own sensor."""
    hardware, s, n = loop.hardware, loop.system, loop.hardware.modes
    inputs = [s.B[:, mode], s.B[:, n:] @ hardware.sensor[:, mode]]
    direct = [s.D[:, mode], s.D[:, n:] @ hardware.sensor[:, mode]]
    system = replace(s, B=np.stack(inputs, axis=1), C=s.C[rows], D=np.stack(direct, axis=1)[rows])
    one = hardware.single_mode()
    loops = {loop.sensor_gain: replace(loop, system=system, hardware=one)}
    return SingleModeLoop(hardware=one, controller=loop.controller, in_frames=True, _loops=loops)


def _demand_checks(
    design: Design, loop: ClosedLoop, change: Callable[[float], float] | None
) -> list[Check]:
    """Check the demands on each mode in the loop as written; equal modes once."""
    checks = []
    for mode in sorted(set(design.first_equal_modes)):
        mode_alone = SingleModeLoop(
            hardware=loop.hardware, controller=loop.controller, mode=mode, in_frames=True
        )
        for demand in design.mode_specifications[mode].demands:
            more = _demand_change(demand, change) if change else 0.0
            for check in demand.checks(mode_alone):
                name, value = f"mode {mode + 1}: {check.name}", check.value + more
                limit = check.limit + LOSS * abs(check.limit)
                checks.append(replace(check, name=name, value=value, limit=limit))
    return checks


def _demand_change(demand: Demand, change: Callable[[float], float]) -> float:
    """Bound how much what is left out moves the value of a demand."""
    # no bound on a response
    if isinstance(demand, CommandRms) or (isinstance(demand, LoopErrors) and demand.moving):
        raise ProblemError(
            "a filter that is cut is proved for demands on responses of the loop; got "
            f"{demand.label}. Use a target with states, such as c or pyrtc."
        )
    if isinstance(demand, LoopErrors):  # taps of two loops
        return (1 + demand.high) * change(1.0)
    return change(demand.sensor_gain)


def rehearsal_error(design: Design, twin: SteppedController) -> float:
    """Largest difference of commands from the controller's, over the largest command.

    Both close the loop of the design around the same disturbance, in which each further sensor is
    missing for a while; without a loop they get noise.
    """
    with np.errstate(all="ignore"):  # what overflows is found to be infinite
        expected = _rehearse(design, design.controller.start(design.controllers))
        try:
            differences = np.abs(_rehearse(design, twin) - expected)
        except ProblemError:
            return float("inf")
        error = float(np.max(differences)) / (float(np.max(np.abs(expected))) or 1.0)
    return error if np.isfinite(error) else float("inf")


def _rehearse(design: Design, controller: SteppedController | RunningController) -> FloatArray:
    """Return the commands (frames, m) of a controller that takes the place of a design's own."""
    hardware, rng = design.hardware, np.random.default_rng(0)
    if hardware is None:
        controller.reset()
        noise = rng.standard_normal((FRAMES, design.controller.D.shape[1]))
        return np.array([controller.step(y) for y in noise])
    units, period = sorted(frozenset().union(*design.controllers)), design.controller.period
    turns, rate = 2 * len(units) + 1, hardware.frame_rate_hz
    length = period * int(np.ceil(FRAMES / turns / period))  # all are due at its begin
    absent = {unit: (2 * i + 1) * length / rate for i, unit in enumerate(units)}
    total = rng.standard_normal((1, turns * length, hardware.modes))
    for k in range(1, turns * length):  # a slow phase
        total[0, k] = POLE * total[0, k - 1] + np.sqrt(1 - POLE**2) * total[0, k]
    noise = NOISE * rng.standard_normal((1, turns * length, hardware.n_readings))
    run = simulate(
        controller,
        Disturbance(phase_nm=total, noise=noise, frame_means=True),
        hardware=hardware,
        drops=[Drop(unit=u, start_s=s, end_s=s + length / rate) for u, s in absent.items()],
    )
    return np.asarray(run.commands[0])
