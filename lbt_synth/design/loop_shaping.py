"""Loop shaping: the best controller for a specification, reduced to few states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from lbt_synth.design.result import UNCERTIFIED, SolverReport, with_certificate
from lbt_synth.design.shaped_design import (
    ShapedDesign,
    controller_from_parameters,
    require_separable,
)
from lbt_synth.design.shaping.basis import laguerre_basis
from lbt_synth.design.shaping.channel import Channel
from lbt_synth.design.shaping.reduction import ModeSolution, reduce_poles, solve_mode
from lbt_synth.design.shaping.single_mode_loop import mode_hardware
from lbt_synth.design.shaping.specification import Specification
from lbt_synth.errors import ProblemError
from lbt_synth.models import LoopHardware
from lbt_synth.validation import integer, number, require_instance

_MOST_FUNCTIONS = 400
_ROUNDED = 5e-7


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
    if not isinstance(hardware, LoopHardware):
        raise ProblemError(
            "hardware must be a LoopHardware, such as plant.hardware; got "
            f"{type(hardware).__name__}."
        )
    specifications = _specification_per_mode(specification, hardware.modes)
    size = integer(functions, "functions", at_least=1)
    if size > _MOST_FUNCTIONS:
        raise ProblemError(f"functions must be at most {_MOST_FUNCTIONS}; got {size}.")
    common = number(pole, "pole", at_least=0, below=1)
    tolerance = number(loss, "loss", at_least=0)
    require_separable(hardware)
    single = mode_hardware(hardware)
    stored = single.mirror_system.whole.n_states
    order = None if states is None else integer(states, "states", at_least=stored + 1) - stored
    for spec in specifications:
        spec.require_fitting(hardware.frame_rate_hz)
    solved: dict[int, tuple[ModeSolution, ModeSolution]] = {}  # equal modes share a specification
    for spec in specifications:
        if id(spec) not in solved:
            basis = laguerre_basis(size, common, dt_s=single.dt_s)
            chosen = long = solve_mode(spec, Channel(hardware=single, basis=basis))
            if order is not None and order < size:
                chosen = reduce_poles(spec, long, order, tolerance)
            solved[id(spec)] = long, chosen
    longs, modes = zip(*(solved[id(spec)] for spec in specifications), strict=True)
    parameters = tuple(mode.parameter for mode in modes)
    design = ShapedDesign(
        method="shaped",
        controller=controller_from_parameters(hardware, parameters),
        certificate=UNCERTIFIED,
        solver=SolverReport(
            route="youla",
            status=modes[0].sequence.status,
            iterations=max(long.sequence.programmes for long in longs),
        ),
        loop_hardware=hardware,
        specifications=specifications,
        parameters=parameters,
        objective_nm=tuple(mode.objective_nm * (1 + _ROUNDED) for mode in modes),
        long_objective_nm=tuple(long.objective_nm for long in longs),
        long_functions=size,
    )
    return with_certificate(design, "Try more functions, or looser demands.")


def _specification_per_mode(
    specification: Specification | Sequence[Specification], modes: int
) -> tuple[Specification, ...]:
    given: Any = specification
    given = tuple(given) if isinstance(given, list | tuple) else (given,) * modes
    for spec in given:
        require_instance(spec, Specification)
    if len(given) != modes:
        raise ProblemError(
            f"give one specification, or one for each of {modes} modes; got {len(given)}."
        )
    return cast(tuple[Specification, ...], given)
