"""Loop shaping: the best controller for a specification, reduced to few states, certified.

The robust design is shaped for vibrations anywhere in bands and an uncertain sensor gain.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.design.certificate import ORIGIN_TOLERANCE, TOLERANCE, Check, Claim, Evidence
from lbt_synth.design.result import UNCERTIFIED, Design, RowTable, SolverReport, with_certificate
from lbt_synth.design.shaping.channel import Channel, SingleModeLoop, laguerre_basis, mode_loop
from lbt_synth.design.shaping.demands import Bound, Demand, LoopErrors
from lbt_synth.design.shaping.solution import ModeSolution, reduce_mode, solve_mode
from lbt_synth.design.shaping.specification import Specification, violated_demands
from lbt_synth.design.shaping.terms import ResidualVariance, Term, VibrationBand
from lbt_synth.errors import DimensionError, ProblemError, UnstableLoopError
from lbt_synth.linear import Controller
from lbt_synth.loop import close_loop
from lbt_synth.loop.closed_loop import youla_controller
from lbt_synth.models import LoopHardware, Spectrum, TipTiltPlant, Vibration
from lbt_synth.models.resonance_spectrum import WIDE_DAMPING
from lbt_synth.storage.rows import Column, fact, facts
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    integer,
    number,
    require_instance,
    sequence,
)

_DELAY_ERROR = 0.1  # frames, at which a loop has to be stable: 100 us at 1 kHz


def shape(
    hardware: LoopHardware,
    specification: Specification | Sequence[Specification],
    *,
    functions: int = 60,
    pole: float = 0.7,
    states: int | None = 20,
    loss: float = 0.1,
) -> ShapedDesign:
    """Design the controller that minimises an objective under demands on the closed loop.

    The path from command to measurement is a delay, so the loop is affine in the Youla
    parameter, a stable filter from the pseudo-open-loop measurement to the command. A long
    parameter, of many fixed functions, is found by convex programmes; then one of few
    states, by fitting the poles to the long one's response and solving the same programmes
    with these poles.

    Parameters
    ----------
    hardware : LoopHardware
        The loop; its modes are controlled one by one.
    specification : Specification or sequence of them
        One for all modes, or one for each.
    functions : int, optional
        Functions of the long parameter.
    pole : float, optional
        Their common pole (Laguerre functions), in [0, 1); 0 makes them taps of an impulse
        response. A larger one resolves lower frequencies with fewer functions.
    states : int or None, optional
        Largest number of states of one mode's controller, its past commands included; None
        keeps the long parameter.
    loss : float, optional
        Tolerated increase of the objective's root by the reduction, relative; the fewest
        states that keep to it are taken.

    Returns
    -------
    ShapedDesign
        Certified design: each demand is checked on the real loop, over all frequencies.

    Raises
    ------
    ProblemError
        If an argument is out of its range.
    InfeasibleError
        If the demands cannot hold together; ``conflict`` on the error names a smallest set
        that cannot. Or if no controller of so few states keeps to the loss.
    NumericalError
        If a programme fails.
    CertificateError
        If the design does not pass its checks.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
    >>> air = lbt.design.shaping.ResidualVariance(turbulence=slow, noise_nm=20.0)
    >>> margin = lbt.design.shaping.Bound(response="rejection", at_most=1 / 0.6)
    >>> spec = lbt.design.shaping.Specification(terms=[air], demands=[margin])
    >>> design = lbt.design.shape(path, spec, functions=12, states=None)
    >>> loop = lbt.close_loop(path, design.controller)
    >>> lbt.loop_margins(loop).modulus > 0.6
    True
    """
    require_instance(hardware, LoopHardware, "hardware, such as plant.hardware,")
    given: Any = specification
    given = tuple(given) if isinstance(given, list | tuple) else (given,) * hardware.modes
    for spec in given:
        require_instance(spec, Specification)
    if len(given) != hardware.modes:
        raise ProblemError(
            f"give one specification, or one for each of {hardware.modes} modes; got {len(given)}."
        )
    specifications: tuple[Specification, ...] = given
    size = integer(functions, "functions", at_least=1, at_most=400)
    common = number(pole, "pole", at_least=0, below=1)
    tolerance = number(loss, "loss", at_least=0)
    for name in ("sensor", "influence"):
        response, n = getattr(hardware, name), hardware.modes
        if (rank := np.linalg.matrix_rank(response)) < n:
            raise DimensionError(
                f"{name}_matrix must have rank {n}, one for each mode, for a loop that is shaped "
                f"mode by mode; got {response.shape} of rank {rank}."
            )
    single = hardware.single_mode()
    stored = single.mirror_system.whole.n_states
    order = None if states is None else integer(states, "states", at_least=stored + 1) - stored
    for spec in specifications:
        spec.require_fitting(hardware)
    solved: dict[str, tuple[ModeSolution, ModeSolution]] = {}  # equal modes are solved once
    for spec in specifications:
        if spec.key not in solved:
            basis = laguerre_basis(size, common, dt_s=single.dt_s)
            chosen = long = solve_mode(spec, Channel(hardware=single, basis=basis))
            if order is not None and order < size:
                chosen = reduce_mode(spec, long, order, tolerance)
            solved[spec.key] = long, chosen
    longs, modes = zip(*(solved[spec.key] for spec in specifications), strict=True)
    parameters = tuple(mode.parameter for mode in modes)
    status = modes[0].status
    design = ShapedDesign(
        method="robust",
        solver=SolverReport(route="youla", status=status),
        problem=hardware,
        specifications=specifications,
        parameters=parameters,
        claims={"objective_nm": tuple(mode.objective_nm * (1 + TOLERANCE / 2) for mode in modes)},
        long_objective_nm=tuple(long.objective_nm for long in longs),
    )
    return with_certificate(design, "Try more functions, or looser demands.")


def _check_objective(evidence: Evidence, claimed: tuple[float, ...]) -> Iterator[Check]:
    """Compare the objective of each mode with the one claimed, the whole loop with its modes."""
    design = evidence.design
    for prefix, mode in design.distinct_modes():
        loop = mode_loop(design.problem, design.parameters[mode])
        try:
            objective = float(np.sqrt(design.specifications[mode].measured_nm2(loop)))
        except UnstableLoopError:
            objective = np.inf
        above, below = _excess(objective, claimed[mode]), _excess(claimed[mode], objective)
        how, name = "closed loops in state space", f"{prefix}objective"
        yield Check(f"{name} found over the one claimed, less 1", above, TOLERANCE, how)
        yield Check(f"{name} claimed over the one found, less 1", below, ORIGIN_TOLERANCE, how)
    f = np.linspace(0, 0.4, 5) * design.problem.frame_rate_hz
    joint = close_loop(design.problem, design.controller).sensitivity(f)
    single = np.zeros_like(joint)
    for mode, parameter in enumerate(design.parameters):
        closed = mode_loop(design.problem, parameter).at(1.0)
        single[:, mode, mode] = closed.sensitivity(f)[:, 0, 0]
    apart = float(np.max(np.abs(joint - single)))
    how = f"sensitivity at {f.size} frequencies"
    yield Check("whole loop against its modes", apart, TOLERANCE, how)


def _excess(value: float, other: float) -> float:
    """Return by how much a value is above another, in parts of it; 0 where both are nothing."""
    return value / other - 1 if other > 0 else (np.inf if value > 0 else 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapedDesign(Design):
    """A controller shaped in the closed loop; it claims the root of each objective [nm]."""

    CLAIMS: ClassVar[tuple[Claim, ...]] = (
        Claim(name="objective_nm", unit="nm", checks=_check_objective),
    )
    DERIVED: ClassVar[tuple[Column, ...]] = (
        Column(name="states_per_mode", heading="states of one mode, past commands included"),
        Column(name="loss", heading="objective above the long parameter's", unit="%", scale=100),
        Column(name="long_objective_nm", unit="nm"),
    )

    problem: LoopHardware
    specifications: tuple[Specification, ...]  # one per mode
    # Youla parameter of each mode, from its pseudo-open-loop measurement to its command
    parameters: tuple[Controller, ...]
    long_objective_nm: tuple[float, ...]  # before the reduction [nm]; the solver's word

    def __post_init__(self) -> None:
        per_mode = self.specifications, self.parameters, self.objective_nm, self.long_objective_nm
        if {len(part) for part in per_mode} != {self.problem.modes}:
            raise DimensionError(
                f"a design must have {self.problem.modes} specifications, parameters and claims, "
                "one for each mode."
            )
        for spec in self.specifications:
            require_instance(spec, Specification)
            spec.require_fitting(self.problem)
        Design.__post_init__(self)

    def make_controller(self) -> Controller:
        """Return the controller of the parameters of all modes."""
        hardware = self.problem
        back, out = np.linalg.pinv(hardware.sensor), hardware.projector
        A, B, C, D = (block_diag(*(getattr(p, name) for p in self.parameters)) for name in "ABCD")
        joint = Controller(A=A, B=B @ back, C=out @ C, D=out @ D @ back, dt_s=hardware.dt_s)
        return youla_controller(hardware, joint)

    @property
    def objective_nm(self) -> tuple[float, ...]:
        """Root of the objective of each mode that is claimed [nm]."""
        return tuple(self.claims.get("objective_nm", ()))

    @property
    def poles(self) -> ComplexArray:
        """Poles of the closed loop: those of the parameters, and the delays."""
        return np.concatenate([p.to_statespace().poles for p in self.parameters])

    @property
    def states_per_mode(self) -> int:
        """Largest number of states of one mode's controller, its past commands included."""
        return max(loop.controller.n_states for loop in self._loops)

    @property
    def mode_specifications(self) -> tuple[Specification, ...]:
        """Specification of each mode."""
        return self.specifications

    @property
    def first_equal_modes(self) -> list[int]:
        """First mode of the same specification, parameter and objective, for each mode."""
        keys = [
            (spec.key, *(getattr(parameter, name).tobytes() for name in "ABCD"), claimed)
            for spec, parameter, claimed in zip(
                self.specifications, self.parameters, self.objective_nm, strict=True
            )
        ]
        return [keys.index(key) for key in keys]

    def distinct_modes(self) -> list[tuple[str, int]]:
        """Return the modes that differ, each with what its checks' names begin with."""
        first, many = self.first_equal_modes, self.problem.modes > 1
        return [(f"mode {mode + 1}: " * many, mode) for mode in sorted(set(first))]

    @property
    def _loops(self) -> list[SingleModeLoop]:
        return [mode_loop(self.problem, parameter) for parameter in self.parameters]

    @property
    def loss(self) -> float:
        """Largest relative increase of a mode's objective by the reduction, of its root."""
        pairs = zip(self.objective_nm, self.long_objective_nm, strict=True)
        return max(short / long - 1 for short, long in pairs)

    @property
    def expected_residual_nm(self) -> float:
        """Root of the sum of the squared objectives of the modes."""
        return float(np.linalg.norm(self.objective_nm))

    def violated_demands(self, controller: Controller) -> tuple[str, ...]:
        """Return the demands that a controller violates, none where it couples the modes."""
        return violated_demands(self.specifications, self.problem, controller) or ()

    def derived(self) -> dict[str, Any]:
        """Return what the reduction cost, and from what."""
        return {column.name: getattr(self, column.name) for column in self.DERIVED}

    def terms_nm(self) -> tuple[tuple[int, str, float], ...]:
        """Residual of each term in the real loop: mode, what it is, [nm rms]."""
        return tuple(
            (mode, term.label, float(np.sqrt(term.measured_nm2(loop))))
            for mode, (spec, loop) in enumerate(zip(self.specifications, self._loops, strict=True))
            for term in spec.terms
        )

    def tables(self) -> tuple[RowTable, ...]:
        """Return the demands, and the residual of each term."""
        demands = [
            facts(demand=fact(demand.label, "demand"), mode=fact(mode, "mode"))
            for mode, spec in enumerate(self.specifications, 1)
            for demand in spec.demands
        ]
        terms = [
            facts(
                term=fact(label, "term"),
                mode=fact(mode + 1, "mode"),
                rms_nm=fact(rms_nm, "residual", unit="nm rms", format=".1f"),
            )
            for mode, label, rms_nm in self.terms_nm()
        ]
        return (
            RowTable(key="demands", title="Demands", rows=demands),
            RowTable(key="terms", title="Residual of each term", rows=terms),
        )

    def notes(self) -> list[str]:
        """Return a warning where the long parameter is not long enough."""
        if not self.loss < 0:
            return []
        return [
            f"note: the long parameter is not long enough: one of {self.states_per_mode} states "
            "is better. Try more functions, or another pole."
        ]

    def examine(self) -> Evidence:
        """Compute whether each parameter is stable and its loop keeps its demands."""
        checks: list[Check] = []
        for prefix, mode in self.distinct_modes():
            parameter = self.parameters[mode]
            radius = parameter.to_statespace().spectral_radius
            name = f"{prefix}spectral radius of the parameter"
            checks.append(Check(name, radius, 1 - 1e-9, "eigenvalues"))
            if checks[-1].passed:
                loop = mode_loop(self.problem, parameter)
                demands = self.specifications[mode].checks(loop)
                checks += [replace(check, name=prefix + check.name) for check in demands]
        return Evidence(design=self, certificate=replace(UNCERTIFIED, checks=tuple(checks)))


def noise_per_mode(hardware: LoopHardware, covariance: FloatArray) -> FloatArray:
    """Return the deviation of each mode's noise, (n,), from the covariance of the measurements."""
    back = np.linalg.pinv(hardware.sensor)
    return np.asarray(np.sqrt(np.diag(back @ covariance @ back.T)))


def robust(
    plant: TipTiltPlant,
    *,
    bands: Sequence[VibrationBand] | Sequence[Sequence[VibrationBand]] = (),
    sensor_gain: tuple[float, float] = (1.0, 1.0),
    moving_gain: bool = False,
    scenarios: Sequence[float] = (1.0,),
    modulus_margin: float = 0.45,
    delay_error_frames: float | None = None,
    turbulence: Spectrum | None = None,
    demands: Sequence[Demand] = (),
    functions: int = 60,
    pole: float = 0.7,
    states: int | None = 20,
    loss: float = 0.1,
) -> ShapedDesign:
    """Design one controller for vibrations anywhere in bands and an uncertain sensor gain.

    For each mode it minimises, summed over some sensor gains, the variance of turbulence and
    noise plus the worst residual of a vibration in each band; under a modulus margin at unit
    sensor gain, and stability for every sensor gain of an interval. ``config.design("robust")``
    makes one of the section ``design.robust`` of a configuration.

    Parameters
    ----------
    plant : TipTiltPlant
        Loop, noise and turbulence. The bands take the place of its vibrations, but for resonances
        with a damping above 0.1 that no band covers: these are disturbances like the turbulence.
    bands : sequence of VibrationBand, or one sequence per mode, optional
        Bands, each with the rms of its vibration. In one sequence, every mode may have all of
        them.
    sensor_gain : tuple of float, optional
        Interval of sensor gains, around 1, for which the loop stays stable.
    moving_gain : bool, optional
        Whether it also stays stable while the gain moves in that interval, at any speed.
    scenarios : sequence of float, optional
        Sensor gains whose residuals are added up.
    modulus_margin : float, optional
        Modulus margin at unit sensor gain.
    delay_error_frames : float, optional
        Error of the delay, late or early, at which the loop stays stable at every sensor gain of
        the interval [frames]. By default 0.1 where the mirror settles at once, and none for a
        mirror with dynamics.
    turbulence : Atmosphere, ARModel or TabulatedSpectrum, optional
        Spectrum of each mode instead of the plant's models.
    demands : sequence of demands, optional
        Further demands, as :class:`Specification` takes them.
    functions, pole, states, loss
        As :func:`shape`.

    Returns
    -------
    ShapedDesign
        Certified design.

    Raises
    ------
    ProblemError, InfeasibleError, NumericalError, CertificateError
        As :func:`shape`.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=20.0, modes=1)
    >>> line = lbt.design.shaping.VibrationBand(low_hz=18, high_hz=22, rms_nm=100)
    >>> design = lbt.robust(plant, bands=[line], sensor_gain=(0.5, 1.2), functions=16, states=None)
    >>> low, high = lbt.loop.stable_sensor_gains(plant.hardware, design.controller)
    >>> low < 0.5 and high > 1.2
    True
    """
    require_instance(plant, TipTiltPlant, "plant")
    plant.require_own_sensor("robust")
    lines = _bands_per_mode(bands, plant.hardware.modes)
    gains = tuple(number(g, "scenarios", above=0) for g in sequence(scenarios, "scenarios"))
    if not gains:
        raise ProblemError("scenarios must name at least one sensor gain; got none.")
    ends = sequence(sensor_gain, "sensor_gain")
    if len(ends) != 2:
        raise ProblemError(f"sensor_gain must be (low, high); got {sensor_gain!r}.")
    low, high = ends
    further = sequence(demands, "demands")
    margin = number(modulus_margin, "modulus_margin", above=0, below=1)
    fixed: list[Demand] = [Bound(response="rejection", at_most=1 / margin)]
    late = delay_error_frames
    if late is None:
        late = _DELAY_ERROR if plant.hardware.mirror is None else 0.0
    if moving_gain and (low, high) == (1, 1):
        raise ProblemError("moving_gain needs the interval in which it moves; give sensor_gain.")
    if late or (low, high) != (1, 1):
        fixed.append(LoopErrors(low=low, high=high, delay_frames=late, moving=moving_gain))
    deviations = noise_per_mode(plant.hardware, plant.R).tolist()
    # modes that differ by rounding are equal, and solved once
    deviations = [next(d for d in deviations if abs(d - nm) <= 1e-9 * nm) for nm in deviations]
    specifications = []
    each = zip(deviations, plant.turbulence, lines, strict=True)
    for mode, (noise_nm, model, own) in enumerate(each):
        spectrum, wide = model if turbulence is None else turbulence, _uncovered(plant, mode, own)
        air = ResidualVariance(turbulence=spectrum, noise_nm=noise_nm)
        # the spectrum of a resonance is known as that of turbulence is
        rate_hz = plant.hardware.frame_rate_hz
        models = (line.ar_model(rate_hz) for line in wide)
        resonances = (ResidualVariance(turbulence=model, noise_nm=0.0) for model in models)
        terms: tuple[Term, ...] = (air, *resonances, *own)
        terms = tuple(replace(term, sensor_gain=g) for g in gains for term in terms)
        specifications.append(Specification(terms=terms, demands=(*fixed, *further)))
    path = plant.hardware
    return shape(path, specifications, functions=functions, pole=pole, states=states, loss=loss)


def _uncovered(
    plant: TipTiltPlant, mode: int, bands: tuple[VibrationBand, ...]
) -> tuple[Vibration, ...]:
    """Return the wide resonances of a mode that no band covers, with their rms on it."""
    return tuple(
        replace(line, rms_nm=line.rms_nm * abs(line.direction[mode]), direction=(1.0,))
        for line in plant.vibrations
        if line.damping > WIDE_DAMPING
        and line.direction[mode]
        and not any(
            band.low_hz <= line.frequency_hz <= band.high_hz and band.damping > line.damping / 2
            for band in bands
        )
    )


def _bands_per_mode(
    bands: Sequence[VibrationBand] | Sequence[Sequence[VibrationBand]], modes: int
) -> list[tuple[VibrationBand, ...]]:
    """Return the bands of each mode: those of all modes, or one sequence per mode."""
    given: tuple[Any, ...] = sequence(bands, "bands")
    nested = bool(given) and all(isinstance(own, list | tuple) for own in given)
    if nested and len(given) != modes:
        raise ProblemError(
            f"bands must be one sequence, or one per mode ({modes}); got {len(given)} of them."
        )
    out = [tuple(own) for own in given] if nested else [given] * modes
    for line in (line for own in out for line in own):
        require_instance(line, VibrationBand, "each of bands")
    return out
