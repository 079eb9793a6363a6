"""H2 control from measurements: the least variance of the errors (LQG)."""

from __future__ import annotations

import numpy as np

from lbt_synth.design.output_feedback.result import (
    ControllerDesign,
    certified_controller,
    checked_loop,
    first_certified,
)
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.output_feedback.two_riccati import TwoRiccati, scaled_plant


def h2_controller(plant: GeneralizedPlant) -> ControllerDesign:
    """Design the controller of least variance of a generalised plant, ``u = K y``.

    Parameters
    ----------
    plant : GeneralizedPlant
        The plant. w is white, of unit variance per sample.

    Returns
    -------
    ControllerDesign
        Certified; ``rms`` is the standard deviation of z, which no controller makes less.

    Raises
    ------
    DetectabilityError
        If no controller stabilises the plant; with the mode and its eigenvector.
    ProblemError
        If it is no plant.
    NumericalError
        If an equation was not solved.
    CertificateError
        If the controller does not pass its checks.

    References
    ----------
    T. Chen, B. Francis, "Optimal Sampled-Data Control Systems", Springer (1995), chapter 6.

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
    >>> round(lbt.h2_controller(P).rms ** 4, 6)
    5.0
    """
    scaled = scaled_plant(plant)

    def design(equations: TwoRiccati, share: float) -> ControllerDesign:
        return certified_controller(
            scaled,
            checked_loop(scaled, equations.least_variance()),
            method="h2",
            route="riccati",
            regularised=share,
            claims={} if share else {"rms_least": _least_rms(equations) / scaled.unit},
        )

    return first_certified(scaled, design)


def _least_rms(equations: TwoRiccati) -> float:
    """Return the least standard deviation: that with known state, and that of estimating the law.

    ``|z|^2`` is the cost with known state and disturbance, plus that of the distance of the
    control from ``F x + F0 w``, of which the measurements leave an error.
    """
    P, control, estimation = equations.plant, equations.control, equations.estimation
    F, F0, Y = control.feedback, control.feedforward, estimation.least
    seen = F @ Y @ P.C2.T + F0 @ P.D21.T
    error = F @ Y @ F.T + F0 @ F0.T - seen @ np.linalg.solve(estimation.weight, seen.T)
    return float(np.sqrt(np.trace(control.pushed) + np.trace(control.weight @ error)))
