"""Move the poles of a short Youla parameter until its objective is least.

Fitted poles are those of a response, not of the objective. All that coefficients and poles change
to first order lies in the span of the functions with each pole doubled, in which the programme is
as before. What it changes is projected on the changes of poles, and the programme solved again
with the moved ones, as far as that lowers the objective (Gauss and Newton's method).
"""

from __future__ import annotations

import numpy as np

from lbt_synth.design.shaping.channel import Channel, orthonormal_basis
from lbt_synth.design.shaping.programme_sequence import (
    SequenceSolution,
    merge_groups,
    solve_sequence,
)
from lbt_synth.design.shaping.reduction import (
    ModeSolution,
    log_slopes,
    poles_from_vector,
    response_to_fit,
    solve_mode,
    vector_from_poles,
)
from lbt_synth.design.shaping.specification import Specification
from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.validation import ComplexArray, FloatArray

_STEPS = 20
_DECREASE = 4e-4  # of the objective, below which a step is the last
_LEAST_SHARE = 0.1  # of a step that is tried


def settle_poles(spec: Specification, found: ModeSolution) -> ModeSolution:
    """Return the solution with its poles moved to a local minimum of the objective."""
    x, pairs = vector_from_poles(found.sequence.channel.basis.poles)
    best = found.sequence
    for _ in range(_STEPS):
        step, share, last = _pole_step(spec, best, *poles_from_vector(x, pairs)), 1.0, best
        if step is None:
            break
        while best is last and share > _LEAST_SHARE:
            best = _moved(spec, last, *poles_from_vector(x + share * step, pairs))
            x, share = (x, share / 2) if best is last else (x + share * step, share)
        if last.objective_nm2 - best.objective_nm2 <= _DECREASE * last.objective_nm2:
            break
    try:
        settled = solve_mode(spec, best.channel, start=best.coefficients)
    except NumericalError:  # the frequencies are too few for the moved poles
        return found
    return min(settled, found, key=lambda solution: solution.objective_nm)


def _moved(
    spec: Specification, last: SequenceSolution, upper: ComplexArray, single: FloatArray
) -> SequenceSolution:
    """Return the solution with other poles if its objective is less, or else the last one."""
    channel = _channel(last, upper, single)
    response = response_to_fit(spec, last)
    start = response.coefficients(channel.command_rows(last.grid.nodes_hz))
    try:
        found = solve_sequence(spec, channel, start=start)
    except (InfeasibleError, NumericalError):
        return last
    return found if found.objective_nm2 < last.objective_nm2 else last


def _pole_step(
    spec: Specification, found: SequenceSolution, upper: ComplexArray, single: FloatArray
) -> FloatArray | None:
    """Step of the vector of poles to the optimum with doubled poles; None if it gains nothing."""
    from lbt_synth.linear.lmi.conic_program import minimize

    f, short = found.grid.nodes_hz, found.channel
    double = _channel(found, np.tile(upper, 2), np.tile(single, 2))
    response = response_to_fit(spec, found)
    start = response.coefficients(double.command_rows(f))
    function, groups = spec.compile(double, found.grid)
    end, _ = minimize(
        function,
        merge_groups(groups),
        size=double.basis.size,
        scale=found.objective_nm2,
        start=start,
    )
    if end is None or function.value(end) > found.objective_nm2 * (1 - _DECREASE):
        return None
    rows = short.command_rows(f)
    moves = (rows @ found.coefficients)[:, None] * log_slopes(response.z, upper, single)
    target = response.weight * (double.command_rows(f) @ (end - start))
    change = type(response)(response.z, target, response.weight)
    return change.coefficients(np.hstack([rows, moves]))[short.basis.size :]


def _channel(found: SequenceSolution, upper: ComplexArray, single: FloatArray) -> Channel:
    """Return the channel of a solution with the functions of other poles."""
    hardware = found.channel.hardware
    poles = np.concatenate([upper, upper.conj(), single])
    return Channel(hardware=hardware, basis=orthonormal_basis(poles, dt_s=hardware.dt_s))
