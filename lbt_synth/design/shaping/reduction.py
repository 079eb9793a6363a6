"""Reduction of a long Youla parameter to few poles, with its programme solved again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.design.shaping.basis import orthonormal_basis
from lbt_synth.design.shaping.channel import Channel
from lbt_synth.design.shaping.objectives import frequency_costs, noise_level, vibration_bands
from lbt_synth.design.shaping.pole_fitting import (
    WeightedResponse,
    drop_cheapest_pair,
    fit_poles,
    starting_poles,
)
from lbt_synth.design.shaping.programme_sequence import SequenceSolution, solve_sequence
from lbt_synth.design.shaping.single_mode_loop import mode_loop
from lbt_synth.design.shaping.specification import Specification
from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.linear import Controller
from lbt_synth.validation import ComplexArray, FloatArray

_FLAT = 0.3  # weight of the whole response in the fit of poles, beside the spectra
_INTEGRAL = 2e-3  # by which the objective over the grid may miss that of the real loop
_SLOW_HZ = (0.002, 0.004, 0.008)  # where turbulence meets the noise, of the frame rate: starts


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModeSolution:
    """A specification solved in one basis."""

    sequence: SequenceSolution
    objective_nm: float  # root of the objective in the real loop

    @property
    def parameter(self) -> Controller:
        """The Youla parameter."""
        return self.sequence.channel.basis.parameter(self.sequence.coefficients)


def solve_mode(
    spec: Specification, channel: Channel, *, start: FloatArray | None = None
) -> ModeSolution:
    """Solve a specification in a basis, on a grid that is fine enough for its objective."""
    miss = np.inf
    for fineness in (1, 2, 4):
        sequence = solve_sequence(spec, channel, start=start, fineness=fineness)
        parameter = channel.basis.parameter(sequence.coefficients)
        loop = mode_loop(channel.hardware, parameter)
        exact = spec.objective.measured_nm2(loop)
        miss = abs(sequence.objective_nm2 / exact - 1)
        if miss < _INTEGRAL and all(check.passed for check in spec.checks(loop)):
            return ModeSolution(sequence=sequence, objective_nm=float(np.sqrt(exact)))
    raise NumericalError(
        f"the objective over the frequencies of the programme misses that of the real loop by "
        f"{miss:.2g}, expected {_INTEGRAL:g}, or a bound is exceeded between them. Try "
        "fewer functions, a smoother spectrum, or wider bands.",
        status="quadrature",
    )


def reduce_poles(
    spec: Specification, long: ModeSolution, order: int, tolerance: float, *, fewest: bool = True
) -> ModeSolution:
    """Find the fewest poles whose programme keeps the objective within a tolerance."""
    hardware, response = long.sequence.channel.hardware, _response_to_fit(spec, long.sequence)
    bands = 2 * np.pi * np.array(vibration_bands(spec.objective)).reshape(-1, 2) * hardware.dt_s
    starts = [starting_poles(order, bands=bands, noise_rad=2 * np.pi * slow) for slow in _SLOW_HZ]
    fits = [fit_poles(response, start) for start in starts]
    candidates = [min(fits, key=lambda fit: fit[1])[0]]
    while fewest and candidates[-1].size > 2 and np.any(candidates[-1].imag):
        fewer = drop_cheapest_pair(response, candidates[-1])
        candidates.append(fit_poles(response, fewer)[0])

    def attempt(index: int) -> tuple[ModeSolution | None, float]:
        found = _solve_with_poles(spec, long.sequence, candidates[index], response)
        return found, np.inf if found is None else found.objective_nm / long.objective_nm - 1

    accepted, loss = attempt(0)
    if accepted is None or loss > tolerance:
        best = f"the best lost {100 * loss:.3g} %" if np.isfinite(loss) else "none was feasible"
        raise InfeasibleError(
            f"no controller of {order + hardware.mirror_system.whole.n_states} states per mode "
            f"came within {100 * tolerance:.3g} % of the long parameter's "
            f"{long.objective_nm:.4g} nm (root of the whole objective): {best}. "
            "Allow more states or a larger loss."
        )
    kept, failed = 0, len(candidates)
    while failed - kept > 1:  # fewer poles lose more: bisection
        middle = (kept + failed) // 2
        found, loss = attempt(middle)
        if found is not None and loss <= tolerance:
            kept, accepted = middle, found
        else:
            failed = middle
    return accepted


def _solve_with_poles(
    spec: Specification, long: SequenceSolution, poles: ComplexArray, response: WeightedResponse
) -> ModeSolution | None:
    """Solve the specification with given poles, from the fit of a response; None if it fails."""
    hardware = long.channel.hardware
    channel = Channel(hardware=hardware, basis=orthonormal_basis(poles, dt_s=hardware.dt_s))
    start = response.coefficients(channel.command_rows(long.grid.nodes_hz))
    try:
        return solve_mode(spec, channel, start=start)
    except (InfeasibleError, NumericalError):
        return None


def _response_to_fit(spec: Specification, long: SequenceSolution) -> WeightedResponse:
    """Response of the long parameter at the nodes; the weight is spectra, and some everywhere."""
    f, w, nyquist = long.grid.nodes_hz, long.grid.weights_hz, long.channel.nyquist_hz
    cost = w * (frequency_costs(spec.objective, f) + noise_level(spec.objective) ** 2 / nyquist)
    return WeightedResponse(
        angles=2 * np.pi * f * long.channel.hardware.dt_s,
        target=long.channel.command_rows(f) @ long.coefficients,
        weight=np.sqrt(cost / np.sum(cost) + _FLAT**2 * w / nyquist),
    )
