"""Loop shaping: the best controller for a specification, reduced to few states, certified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.design.certificate import Certificate, Check, certify_loop
from lbt_synth.design.result import UNCERTIFIED, Design, SolverReport, with_certificate
from lbt_synth.design.shaping.channel import (
    Channel,
    SingleModeLoop,
    laguerre_basis,
    mode_loop,
)
from lbt_synth.design.shaping.objectives import VibrationBand, leaves
from lbt_synth.design.shaping.reduction import ModeSolution, reduce_poles, solve_mode
from lbt_synth.design.shaping.specification import (
    Specification,
    specified_limit,
    violated_demands,
)
from lbt_synth.errors import DimensionError, ProblemError, UnstableLoopError
from lbt_synth.linear import Controller
from lbt_synth.loop import close_loop, youla_controller
from lbt_synth.models import LoopHardware
from lbt_synth.storage.rows import column, fill_row, table_row
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    integer,
    number,
    require_instance,
    set_fields,
)

_MOST_FUNCTIONS = 400
_ROUNDED = 5e-7
_RMS_TOLERANCE = 1e-6
_CLAIM_TOLERANCE = 1e-5
_TEST_HZ = (0.0, 0.003, 0.02, 0.11, 0.37)  # parts of the frame rate


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
    >>> spec = lbt.design.shaping.Specification(
    ...     objective=lbt.design.shaping.ResidualVariance(turbulence=slow, noise_nm=20.0),
    ...     demands=[lbt.design.shaping.ModulusMargin(at_least=0.6)],
    ... )
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
    size = integer(functions, "functions", at_least=1, at_most=_MOST_FUNCTIONS)
    common = number(pole, "pole", at_least=0, below=1)
    tolerance = number(loss, "loss", at_least=0)
    require_separable(hardware)
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
                chosen = reduce_poles(spec, long, order, tolerance)
            solved[spec.key] = long, chosen
    longs, modes = zip(*(solved[spec.key] for spec in specifications), strict=True)
    parameters = tuple(mode.parameter for mode in modes)
    status, rounds = modes[0].sequence.status, max(long.sequence.programmes for long in longs)
    design = ShapedDesign(
        method="shaped",
        certificate=UNCERTIFIED,
        solver=SolverReport(route="youla", status=status, iterations=rounds),
        loop_hardware=hardware,
        specifications=specifications,
        parameters=parameters,
        objective_nm=tuple(mode.objective_nm * (1 + _ROUNDED) for mode in modes),
        long_objective_nm=tuple(long.objective_nm for long in longs),
        long_functions=size,
    )
    return with_certificate(design, "Try more functions, or looser demands.")


@table_row
class RobustFacts:
    """What a robust controller is, beside the limits over its bands."""

    states_per_mode: int = column("states of one mode, past commands included")
    loss: float = column("objective above the long parameter's", unit="%", scale=100)
    limit_nm: float = column("least worst residual over its bands, all modes", unit="nm")
    above_limit_percent: float = column("residual at unit sensor gain above it", unit="%")
    objective_nm: tuple[float, ...] = column(unit="nm")
    long_objective_nm: tuple[float, ...] = column(unit="nm")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapedDesign(Design):
    """A controller shaped in the closed loop, mode by mode.

    Attributes
    ----------
    loop_hardware : LoopHardware
        The loop.
    specifications : tuple of Specification
        One per mode.
    parameters : tuple of Controller
        Youla parameter of each mode, from its pseudo-open-loop measurement to its command.
    objective_nm : tuple of float
        Root of the objective of each mode that is claimed [nm].
    long_objective_nm : tuple of float
        The same of the long parameter, before it was reduced [nm].
    long_functions : int
        Functions of the long parameter.
    """

    controller: Controller = field(init=False)
    loop_hardware: LoopHardware
    specifications: tuple[Specification, ...]
    parameters: tuple[Controller, ...]
    objective_nm: tuple[float, ...]
    long_objective_nm: tuple[float, ...]
    long_functions: int

    def __post_init__(self) -> None:
        whole = controller_from_parameters(self.loop_hardware, self.parameters)
        set_fields(self, controller=whole)

    @property
    def hardware(self) -> LoopHardware | None:
        """Loop that the design is for."""
        return self.loop_hardware

    @property
    def poles(self) -> ComplexArray:
        """Poles of the closed loop: those of the parameters, and the delays."""
        return np.concatenate([p.to_statespace().poles for p in self.parameters])

    @property
    def states_per_mode(self) -> int:
        """Largest number of states of one mode's controller, its past commands included."""
        return max(loop.controller.n_states for loop in self._loops)

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

    @property
    def _loops(self) -> list[SingleModeLoop]:
        return [mode_loop(self.loop_hardware, parameter) for parameter in self.parameters]

    @property
    def loss(self) -> float:
        """Largest relative increase of a mode's objective by the reduction, of its root."""
        pairs = zip(self.objective_nm, self.long_objective_nm, strict=True)
        return max(short / long - 1 for short, long in pairs)

    @property
    def is_reduced(self) -> bool:
        """Whether the parameters have fewer poles than the long one."""
        return any(p.n_states < self.long_functions for p in self.parameters)

    def demand_labels(self) -> tuple[tuple[int, str], ...]:
        """Demands in words: mode, demand."""
        specs = enumerate(self.specifications)
        return tuple((mode, demand.label) for mode, spec in specs for demand in spec.demands)

    @property
    def expected_residual_nm(self) -> float:
        """Root of the sum of the squared objectives of the modes."""
        return float(np.linalg.norm(self.objective_nm))

    @property
    def vibration_bands(self) -> tuple[VibrationBand, ...]:
        """Bands of the specifications, mode by mode."""
        parts = (leaf for spec in self.specifications for leaf in leaves(spec.objective))
        return tuple(part for part in parts if isinstance(part, VibrationBand))

    def violated_demands(self, controller: Controller) -> tuple[str, ...]:
        """Return the demands that a controller violates, none where it couples the modes."""
        return violated_demands(self.specifications, self.loop_hardware, controller) or ()

    def facts(self) -> RobustFacts:
        """Return what the controller is, beside the limits over its bands."""
        limit_nm, above = specified_limit(self.specifications, self.loop_hardware, self.parameters)
        return fill_row(RobustFacts, self, limit_nm=limit_nm, above_limit_percent=above)

    def terms_nm(self) -> tuple[tuple[int, str, float], ...]:
        """Residual of each term in the real loop: mode, what it is, [nm rms]."""
        return tuple(
            (mode, leaf.label, float(np.sqrt(leaf.measured_nm2(loop))))
            for mode, (spec, loop) in enumerate(zip(self.specifications, self._loops, strict=True))
            for leaf in leaves(spec.objective)
        )

    def recertify(self) -> Certificate:
        """Compute the certificate again from the matrices."""
        claims = list(zip(self.specifications, self.parameters, self.objective_nm, strict=True))
        found = {
            first: _mode_checks(self.loop_hardware, *claims[first])
            for first in set(self.first_equal_modes)
        }
        checks: list[Check] = []
        for mode, first in enumerate(self.first_equal_modes):
            prefix = f"mode {mode + 1}: " if len(claims) > 1 else ""
            checks += [replace(c, name=prefix + c.name) for c in found[first]]
        checks.append(certify_loop(self.loop_hardware, self.controller))
        if checks[-1].passed:
            checks.append(self._decoupling_check())
        return replace(UNCERTIFIED, checks=tuple(checks))

    def _decoupling_check(self) -> Check:
        """Check that the whole loop rejects what the loops of the single modes reject."""
        f = np.array(_TEST_HZ) * self.loop_hardware.frame_rate_hz
        whole = close_loop(self.loop_hardware, self.controller).sensitivity(f)
        single = np.zeros_like(whole)
        for mode, loop in enumerate(self._loops):
            single[:, mode, mode] = loop.at(1.0).sensitivity(f)[:, 0, 0]
        apart = float(np.max(np.abs(whole - single)))
        how = f"sensitivity at {f.size} frequencies"
        return Check("whole loop against its modes", apart, 1e-6, how)


def _mode_checks(
    hardware: LoopHardware, spec: Specification, parameter: Controller, objective_nm: float
) -> list[Check]:
    """Check the parameter of one mode: stable, its demands met, its objective as claimed."""
    radius = parameter.to_statespace().spectral_radius
    stable = Check("spectral radius of the parameter", radius, 1 - 1e-9, "eigenvalues")
    if not stable.passed:
        return [stable]
    loop = mode_loop(hardware, parameter)
    checks = spec.checks(loop)
    try:
        found = float(np.sqrt(spec.objective.measured_nm2(loop)))
    except UnstableLoopError:
        found = np.inf
    how = "closed loops in state space"
    above = found / objective_nm - 1 if objective_nm > 0 else np.inf
    below = objective_nm / found - 1 if found > 0 else np.inf
    return [
        stable,
        *checks,
        Check("objective found over the one claimed, less 1", above, _RMS_TOLERANCE, how),
        Check("objective claimed over the one found, less 1", below, _CLAIM_TOLERANCE, how),
    ]


def require_separable(hardware: LoopHardware) -> None:
    """Refuse a loop whose modes cannot be controlled one by one."""
    n = hardware.modes
    named = {"sensor_matrix": hardware.sensor, "influence_matrix": hardware.influence}
    for name, response in named.items():
        rank = np.linalg.matrix_rank(response)
        if rank < n:
            raise DimensionError(
                f"{name} must have rank {n}, one for each mode, for a loop that is shaped mode by "
                f"mode; got {response.shape} of rank {rank}."
            )


def controller_from_parameters(
    hardware: LoopHardware, parameters: tuple[Controller, ...]
) -> Controller:
    """Join the Youla parameters of all modes in the controller of the whole loop."""
    back, out = np.linalg.pinv(hardware.sensor), hardware.projector
    A, B, C, D = (block_diag(*(getattr(p, name) for p in parameters)) for name in "ABCD")
    whole = Controller(A=A, B=B @ back, C=out @ C, D=out @ D @ back, dt_s=hardware.dt_s)
    return youla_controller(hardware, whole)


def noise_per_mode(hardware: LoopHardware, covariance: FloatArray) -> FloatArray:
    """Return the deviation of each mode's noise, (n,), from the covariance of the measurements."""
    back = np.linalg.pinv(hardware.sensor)
    return np.asarray(np.sqrt(np.diag(back @ covariance @ back.T)))
