"""H-infinity control from measurements: the least energy gain from disturbances to errors."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from lbt_synth.design.hinf import checked_bounds
from lbt_synth.design.output_feedback.result import (
    SMALLER_SHARES,
    CheckedLoop,
    ControllerDesign,
    certified_controller,
    checked_loop,
    first_certified,
)
from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.output_feedback.lower_bound import NO_PROOF, infeasible_control_level
from lbt_synth.linear.output_feedback.two_riccati import ScaledPlant, TwoRiccati, scaled_plant
from lbt_synth.validation import choice

if TYPE_CHECKING:
    from lbt_synth.linear.output_feedback.lower_bound import ControlWitness
    from lbt_synth.linear.state_space import StateSpace

_AT_LEAST = 1e-9  # a level this close to the least one counts as the least one itself
_SAME_REASON = 0.99  # of the least level, at which a looser proof has the same reason
_LOOSE = 1e-7  # a proof further from the least level is tried by the inequality as well
_LARGEST_LMI = 20  # states
_APART = (1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # of levels tried next to the least
_FAR = 0.1  # and of the least shares, whose level is above that of the plant in any case


def hinf_controller(
    plant: GeneralizedPlant,
    *,
    gamma: float | None = None,
    gamma_ratio: float | None = None,
    route: str = "riccati",
) -> ControllerDesign:
    """Design an H-infinity controller of a generalised plant, ``u = K y``.

    With neither ``gamma`` nor ``gamma_ratio`` the controller is that of the least gamma, at which
    the closed loop is all-pass and every other property suffers: ratios from 1.05 to 1.5 are
    for use.

    Parameters
    ----------
    plant : GeneralizedPlant
        The plant. D11 and D22 may be anything, D12 and D21 singular.
    gamma : float, optional
        Bound on the H-infinity norm from w to z.
    gamma_ratio : float, optional
        The same bound as a multiple, at least 1, of the least gamma.
    route : {"riccati", "lmi"}
        How the least gamma is found: by two Riccati equations, or by linear matrix
        inequalities. Both give the central controller.

    Returns
    -------
    ControllerDesign
        Certified. ``gamma_least`` is the norm that a controller achieves, ``gamma_infeasible`` a
        level that no controller reaches, proved by ``witness``.

    Raises
    ------
    DetectabilityError
        If no controller stabilises the plant; with the mode and its eigenvector.
    InfeasibleError
        If the bound is below the least gamma; with the least, and the reason.
    ProblemError
        If both bounds are given, or a value is out of its range.
    NumericalError
        If the equations or the inequality were not solved.
    CertificateError
        If the controller does not pass its checks.

    References
    ----------
    M. Green, D. J. N. Limebeer, "Linear Robust Control", Prentice-Hall (1995), appendix B;
    P. Gahinet, P. Apkarian, Int. J. Robust Nonlinear Control 4, 421 (1994),
    doi:10.1002/rnc.4590040403.

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
    >>> K = lbt.hinf_controller(P, gamma_ratio=1.1)
    >>> K.gamma_infeasible <= K.gamma_least < K.gamma <= K.gamma_requested
    True
    """
    choice(route, "route", ("riccati", "lmi"))
    far_above = "the controller is that of least variance"
    gamma, gamma_ratio = checked_bounds(gamma, gamma_ratio, far_above=far_above)
    scaled = scaled_plant(plant)

    def design(equations: TwoRiccati, share: float) -> ControllerDesign:
        bracket = Bracket(scaled, equations, route, share)
        requested = bracket.least * (gamma_ratio or 1.0) if gamma is None else gamma
        bracket.require(requested)
        above = None
        if requested > bracket.least * (1 + _AT_LEAST):
            above = _central(equations, requested * scaled.unit)
        return certified_controller(
            scaled,
            bracket.reached if above is None else checked_loop(scaled, above),
            method="hinf",
            route=route,
            claims={
                "gamma_requested": max(requested, bracket.least),
                "gamma_least": bracket.least,
                "gamma_infeasible": bracket.infeasible,
            },
            witness=bracket.witness,
            regularised=share,
            hint="Try a larger gamma_ratio.",
        )

    return first_certified(scaled, design)


class Bracket:
    """The least gamma between the norm of a controller and a level that is proved infeasible."""

    def __init__(
        self,
        scaled: ScaledPlant,
        equations: TwoRiccati,
        route: str = "riccati",
        share: float = 0.0,
    ) -> None:
        solution = equations.least_level()
        aparts = (*_APART, _FAR) if share in SMALLER_SHARES else _APART
        self.reached = _least_controller(scaled, equations, solution.gamma, aparts)
        self.least = self.reached.certificate.gamma
        candidates = [NO_PROOF, *equations.proofs(solution, scaled.plant)]
        unit = scaled.unit
        levels = [
            (infeasible_control_level(scaled.plant, each) / unit, each) for each in candidates
        ]
        proofs = [max(levels, key=lambda each: each[0])]
        loose = proofs[0][0] < self.least * (1 - _LOOSE)
        if route == "lmi":
            proofs.append(_inequality_proof(scaled, solution.gamma))
        elif loose and len(scaled.plant.A) <= _LARGEST_LMI:
            with suppress(NumericalError):
                proofs.append(_inequality_proof(scaled, solution.gamma))
        proved, self.witness = max(proofs, key=lambda each: each[0])
        if proofs[0][0] > _SAME_REASON * self.least:  # an inequality gives no reason in words
            self.witness = replace(self.witness, reason=proofs[0][1].reason)
        if proved > self.least * (1 + _LOOSE):
            raise NumericalError(
                f"no controller should have a norm below {proved:.9g}, yet one achieves "
                f"{self.least:.9g}. Scale states and signals to similar sizes.",
                status="contradiction",
            )
        self.infeasible = min(proved, self.least)

    def require(self, gamma: float) -> None:
        """Refuse a level that no controller was found at, with the reason."""
        if gamma < self.least * (1 - _AT_LEAST):
            raise InfeasibleError(
                f"no controller was found at gamma = {gamma:.9g}: the least is {self.least:.9g}, "
                f"and none reaches {self.infeasible:.9g}, because {self.witness.reason}. Try "
                "gamma_ratio=1.1.",
                gamma=gamma,
                gamma_least=self.least,
            )


def _inequality_proof(scaled: ScaledPlant, level: float) -> tuple[float, ControlWitness]:
    """Return the level that the dual of the matrix inequalities proves, and the proof."""
    from lbt_synth.linear.lmi.output_feedback import least_level_lmi

    _, witness = least_level_lmi(scaled.plant, level)
    return infeasible_control_level(scaled.plant, witness) / scaled.unit, witness


def _least_controller(
    scaled: ScaledPlant, equations: TwoRiccati, least: float, aparts: Sequence[float]
) -> CheckedLoop:
    """Return the loop next to the least level, as near as its numbers allow."""
    best: CheckedLoop | None = None
    for apart in aparts:
        controller = _central(equations, least * (1 + apart))
        if controller is None:
            continue
        with suppress(NumericalError):  # a loop that is not well posed
            found = checked_loop(scaled, controller)
            if not found.certificate.passed:
                continue
            if best is None or found.certificate.gamma < best.certificate.gamma:
                best = found
            if found.certificate.gamma * scaled.unit <= least * (1 + 2 * apart):
                break
    if best is None:
        raise NumericalError(
            f"no controller next to the least gamma, {least:.9g}, is stable and passes its checks "
            "in working accuracy. Scale states and signals to similar sizes.",
            status="search",
        )
    return best


def _central(equations: TwoRiccati, gamma: float) -> StateSpace | None:
    """Return the central controller of a level, or None where it has none to be computed."""
    _, solution = equations.solve(gamma)
    if solution is None:
        return None
    with suppress(NumericalError):
        return equations.controller(solution)
    return None
