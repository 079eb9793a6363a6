"""The least variance under a bound on the H-infinity norm, by the free parameter."""

from __future__ import annotations

import numpy as np

from lbt_synth.design.output_feedback.hinf_controller import Bracket
from lbt_synth.design.output_feedback.result import (
    ControllerDesign,
    certified_controller,
    checked_loop,
    first_certified,
)
from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.norms import hinf_norm
from lbt_synth.linear.output_feedback.two_riccati import (
    ScaledPlant,
    TwoRiccati,
    free_parameter,
    scaled_plant,
)
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.validation import integer, number

_POINTS = 33  # frequencies of the first programme, from 0 to the Nyquist frequency
_ROUNDS = 12
_INSIDE = 1e-3  # share of gamma that is kept for what lies between the frequencies


def mixed_controller(plant: GeneralizedPlant, *, gamma: float, taps: int = 24) -> ControllerDesign:
    """Design the controller of least variance among those with a bounded H-infinity norm.

    Both norms are those from w to z. The controller is that of least variance and a filter with
    finite response of its innovations, the optimum of a convex programme; peaks between its
    frequencies are added until the computed norm meets the bound.

    Parameters
    ----------
    plant : GeneralizedPlant
        The plant.
    gamma : float
        Bound on the H-infinity norm.
    taps : int
        Length of the filter; each tap adds a state per measurement. The variance decreases
        with it, and bounds next to the least gamma need more.

    Returns
    -------
    ControllerDesign
        Certified: ``gamma`` at most the bound, ``rms`` recomputed.

    Raises
    ------
    InfeasibleError
        If no controller reaches the bound, or none with so many taps was found.
    DetectabilityError, ProblemError, NumericalError, CertificateError
        As :func:`h2_controller`.

    References
    ----------
    C. W. Scherer, "Multiobjective H2/H-infinity control", IEEE Trans. Autom. Control 40, 1054
    (1995), doi:10.1109/9.388684.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> P = lbt.linear.GeneralizedPlant(
    ...     A=1.0,
    ...     B1=[[1.0, 0.0]],
    ...     B2=1.0,
    ...     C1=[[1.0], [0.0]],
    ...     C2=1.0,
    ...     D12=[[0.0], [1.0]],
    ...     D21=[[0.0, 1.0]],
    ... )
    >>> least, quiet = lbt.hinf_controller(P), lbt.h2_controller(P)
    >>> K = lbt.mixed_controller(P, gamma=1.05 * least.gamma)
    >>> K.gamma <= 1.05 * least.gamma < quiet.gamma and quiet.rms < K.rms < least.rms
    True
    """
    gamma = number(gamma, "gamma", above=0)
    taps = integer(taps, "taps", at_least=1, at_most=400)
    scaled = scaled_plant(plant)

    def design(equations: TwoRiccati, share: float) -> ControllerDesign:
        checked = checked_loop(scaled, equations.least_variance())
        if checked.certificate.gamma > gamma:
            checked = checked_loop(scaled, _quietest(scaled, equations, gamma, taps))
        return certified_controller(
            scaled,
            checked,
            method="mixed",
            route="free parameter",
            claims={"gamma_requested": gamma},
            regularised=share,
            hint="Try a larger gamma, or more taps.",
        )

    return first_certified(scaled, design)


def _quietest(scaled: ScaledPlant, equations: TwoRiccati, gamma: float, taps: int) -> StateSpace:
    """Return the controller of least variance below a level, if there is one."""
    bracket = Bracket(scaled, equations)
    bracket.require(gamma)
    loop, level = free_parameter(equations), gamma * scaled.unit
    frequency_hz = np.linspace(0, 0.5 / loop.T11.dt_s, _POINTS)
    from lbt_synth.linear.lmi.output_feedback import least_variance_below

    for _ in range(_ROUNDS):
        try:
            found = least_variance_below(loop, level * (1 - _INSIDE), taps, frequency_hz)
        except NumericalError as error:
            raise InfeasibleError(
                f"no controller with {taps} taps was found below gamma = {gamma:.6g}; the "
                f"least gamma of any controller is {bracket.least:.6g}. Try more taps, "
                "or a larger gamma.",
                gamma=gamma,
                gamma_least=bracket.least,
            ) from error
        controller = loop.controller(found)
        peak = hinf_norm(scaled.plant.closed_loop(controller))
        if peak.upper <= level:
            break
        frequency_hz = np.unique(np.append(frequency_hz, peak.peak_frequency_hz))
    return controller
