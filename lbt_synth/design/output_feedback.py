"""Controllers from measurements for any generalised plant: H2, H-infinity, and both at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np

from lbt_synth.design.certificate import (
    INFEASIBLE_TOLERANCE,
    LEVEL_SETS,
    TOLERANCE,
    Certificate,
    Check,
    Claim,
    Evidence,
    certify_error,
    measured_claim,
)
from lbt_synth.design.hinf import AT_LEAST, LARGEST_LMI, checked_bounds
from lbt_synth.design.result import Design, SolverReport, with_certificate
from lbt_synth.errors import (
    CertificateError,
    InfeasibleError,
    NumericalError,
    ProblemError,
    SynthesisError,
)
from lbt_synth.linear import StateSpace, hinf_norm
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.output_feedback.lower_bound import (
    NO_PROOF,
    ControlWitness,
    infeasible_control_level,
)
from lbt_synth.linear.output_feedback.two_riccati import (
    ScaledPlant,
    TwoRiccati,
    free_parameter,
    scaled_plant,
)
from lbt_synth.validation import integer, number

_certify_loop = partial(certify_error, stability="spectral radius of the closed loop")
# a controller in the units of the plant as given, and the checks of its loop
_CheckedLoop: TypeAlias = tuple[StateSpace, Certificate]

_SHARES = (0.0, 1e-6, 1e-5, 1e-4)  # of the errors and disturbances, added in turn
_SMALLER_SHARES = (1e-7, 1e-8)  # for plants of which the others leave more than there is
_LESS = 0.99  # of a level: what is not below it is as good, and has the same reason
_LOOSE = 1e-7  # a proof further from the least level is tried by the inequality as well
_APART = np.logspace(-9, -2, 8)  # of levels tried next to the least
_FAR = 0.1  # and of the least shares, whose level is above that of the plant in any case
_POINTS = 33  # frequencies of the first programme, from 0 to the Nyquist frequency
_ROUNDS = 12
_INSIDE = 1e-3  # share of gamma that is kept for what lies between the frequencies


def _check_bound(evidence: Evidence, gamma: float) -> Iterator[Check]:
    """Check that the norm keeps its bound."""
    above = evidence.certificate.gamma / gamma - 1
    yield Check("norm of the closed loop over its bound, less 1", above, TOLERANCE, LEVEL_SETS)


def _check_least_rms(evidence: Evidence, least: float) -> Iterator[Check]:
    """Check that the variance is what the equations say the least one is."""
    above = evidence.certificate.rms / max(least, 1e-300) - 1
    how = "closed loop against the Riccati equations"
    yield Check("rms over the least, less 1", above, TOLERANCE, how)


def _check_infeasible(evidence: Evidence, level: float) -> Iterator[Check]:
    """Check that the witness proves the level."""
    design = evidence.design
    scaled = scaled_plant(design.problem)
    above = level / max(_proved(scaled, design.witness), 1e-300) - 1
    how = "pairs that no measurement shows and no control moves"
    name = "infeasible level over the level proved, less 1"
    yield Check(name, above, INFEASIBLE_TOLERANCE, how)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControllerDesign(Design):
    """A certified controller of a generalised plant, ``u = K y``."""

    CLAIMS: ClassVar[tuple[Claim, ...]] = (
        measured_claim("gamma", "gamma, the norm from w to z"),
        measured_claim("rms", "rms of z for white w of unit variance"),
        Claim(name="rms_least", heading="least rms of any controller", checks=_check_least_rms),
        Claim(name="gamma_requested", heading="gamma requested", checks=_check_bound),
        Claim(name="gamma_least", heading="least gamma, reached by a controller"),
        Claim(
            name="gamma_infeasible",
            heading="gamma that no controller reaches",
            checks=_check_infeasible,
        ),
    )

    problem: GeneralizedPlant
    controller: StateSpace  # type: ignore[assignment]  # from y to u, in textbook form
    witness: ControlWitness = NO_PROOF  # of ``gamma_infeasible``; its reason says why in words
    # share of the errors and disturbances that was added because the plant's own equations are
    # singular, or leave rounding alone; the certificate is that of the plant as given
    regularised: float = 0.0

    def make_controller(self) -> StateSpace:  # type: ignore[override]
        """Return the controller as it was computed."""
        return self.controller

    @property
    def closed_loop(self) -> StateSpace:
        """System from w to z: ``gamma`` is its norm, ``rms`` that of z for white w of size one."""
        return self.problem.closed_loop(self.controller)

    def examine(self) -> Evidence:
        """Compute the norms of the closed loop."""
        return Evidence(design=self, certificate=_certify_loop(self.closed_loop))

    def notes(self) -> list[str]:
        """Return why no controller is below the level, and what was added to a singular plant."""
        notes = [f"below: {self.witness.reason}"] if "gamma_infeasible" in self.claims else []
        if self.regularised:
            notes.append(f"singular problem, regularised by a share of {self.regularised:g}")
        return notes


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
    >>> sides = {"B1": [[1.0, 0]], "D21": [[0, 1.0]], "C1": [[1.0], [0]], "D12": [[0], [1.0]]}
    >>> P = lbt.linear.GeneralizedPlant(A=1.0, B2=1.0, C2=1.0, **sides)
    >>> round(lbt.h2_controller(P).rms ** 4, 6)
    5.0
    """
    return _first_certified(plant, _design_h2)


def _design_h2(scaled: ScaledPlant, equations: TwoRiccati, share: float) -> ControllerDesign:
    """Return the controller of least variance of a scaled plant's equations."""
    checked = _checked_loop(scaled, equations.least_variance())
    claims = {} if share else {"rms_least": _least_rms(equations) / scaled.unit}
    return _certified(scaled, checked, share, claims, method="h2")


def _least_rms(equations: TwoRiccati) -> float:
    """Return the least standard deviation of z: with known state, and of the control's error."""
    P, control, estimation = equations.plant, equations.control, equations.estimation
    F, F0, Y = control.feedback, control.feedforward, estimation.least
    seen = F @ Y @ P.C2.T + F0 @ P.D21.T
    error = F @ Y @ F.T + F0 @ F0.T - seen @ np.linalg.solve(estimation.weight, seen.T)
    return float(np.sqrt(np.trace(control.pushed) + np.trace(control.weight @ error)))


def hinf_controller(
    plant: GeneralizedPlant,
    *,
    gamma: float | None = None,
    gamma_ratio: float | None = None,
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
    NumericalError, CertificateError
        As :func:`h2_controller`.

    References
    ----------
    M. Green, D. J. N. Limebeer, "Linear Robust Control", Prentice-Hall (1995), appendix B;
    P. Gahinet, P. Apkarian, Int. J. Robust Nonlinear Control 4, 421 (1994),
    doi:10.1002/rnc.4590040403.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> sides = {"B1": [[1.0, 0]], "D21": [[0, 1.0]], "C1": [[1.0], [0]], "D12": [[0], [1.0]]}
    >>> P = lbt.linear.GeneralizedPlant(A=1.0, B2=1.0, C2=1.0, **sides)
    >>> K = lbt.hinf_controller(P, gamma_ratio=1.1)
    >>> K.gamma_infeasible <= K.gamma_least < K.gamma <= K.gamma_requested
    True
    """
    far_above = "the controller is that of least variance"
    gamma, gamma_ratio = checked_bounds(gamma, gamma_ratio, far_above=far_above)
    return _first_certified(
        plant, partial(_design_hinf, gamma=gamma, gamma_ratio=gamma_ratio or 1.0)
    )


def _design_hinf(
    scaled: ScaledPlant,
    equations: TwoRiccati,
    share: float,
    *,
    gamma: float | None,
    gamma_ratio: float,
) -> ControllerDesign:
    """Return the central controller of a level, or the one next to the least level."""
    bracket = _Bracket.of(scaled, equations, share)
    requested = bracket.least * gamma_ratio if gamma is None else gamma
    bracket.require(requested)
    above = None
    if requested > bracket.least * (1 + AT_LEAST):
        above = _central(equations, requested * scaled.unit)
    claims = {
        "gamma_requested": max(requested, bracket.least),
        "gamma_least": bracket.least,
        "gamma_infeasible": bracket.infeasible,
    }
    checked = bracket.reached if above is None else _checked_loop(scaled, above)
    return _certified(scaled, checked, share, claims, method="hinf", witness=bracket.witness)


class _Bracket(NamedTuple):
    """The least gamma between the norm of a controller and a level that is proved infeasible."""

    reached: _CheckedLoop  # the loop of that controller
    infeasible: float
    witness: ControlWitness

    @property
    def least(self) -> float:
        """The norm that a controller reaches."""
        return self.reached[1].gamma

    @classmethod
    def of(cls, scaled: ScaledPlant, equations: TwoRiccati, share: float) -> _Bracket:
        """Find a controller next to the least level, and the best proof of a lower one."""
        solution = equations.least_level()
        aparts = [*_APART.tolist(), _FAR] if share in _SMALLER_SHARES else _APART.tolist()
        reached = _least_controller(scaled, equations, solution.gamma, aparts)
        least, size = reached[1].gamma, len(scaled.plant.A)
        candidates = [NO_PROOF, *equations.proofs(solution, scaled.plant)]
        proofs = [max(((_proved(scaled, x), x) for x in candidates), key=lambda proof: proof[0])]
        level, closed = proofs[0]
        if level < least * (1 - _LOOSE) and size <= LARGEST_LMI:
            from lbt_synth.linear.lmi.output_feedback import least_level_lmi

            with suppress(NumericalError):
                _, dual = least_level_lmi(scaled.plant, solution.gamma)
                proofs.append((_proved(scaled, dual), dual))
        proved, witness = max(proofs, key=lambda proof: proof[0])
        if level > _LESS * least:  # an inequality gives no reason in words
            witness = replace(witness, reason=closed.reason)
        if proved > least * (1 + _LOOSE):
            raise NumericalError(
                f"no controller should have a norm below {proved:.9g}, yet one achieves "
                f"{least:.9g}. Scale states and signals to similar sizes.",
                status="contradiction",
            )
        return cls(reached, min(proved, least), witness)

    def require(self, gamma: float) -> None:
        """Refuse a level that no controller was found at, with the reason."""
        if gamma < self.least * (1 - AT_LEAST):
            raise InfeasibleError(
                f"no controller was found at gamma = {gamma:.9g}: the least is {self.least:.9g}, "
                f"and none reaches {self.infeasible:.9g}, because {self.witness.reason}. Try "
                "gamma_ratio=1.1.",
                gamma=gamma,
                gamma_least=self.least,
            )


def _proved(scaled: ScaledPlant, witness: ControlWitness) -> float:
    """Return the level of the plant that a witness proves infeasible."""
    return infeasible_control_level(scaled.plant, witness) / scaled.unit


def _least_controller(
    scaled: ScaledPlant, equations: TwoRiccati, least: float, aparts: Sequence[float]
) -> _CheckedLoop:
    """Return the loop next to the least level, as near as its numbers allow."""
    best: _CheckedLoop | None = None
    for apart in aparts:
        controller = _central(equations, least * (1 + apart))
        if controller is None:
            continue
        with suppress(NumericalError):  # a loop that is not well posed
            checked = _checked_loop(scaled, controller)
            if not checked[1].passed:
                continue
            if best is None or checked[1].gamma < best[1].gamma:
                best = checked
            if checked[1].gamma * scaled.unit <= least * (1 + 2 * apart):
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
    >>> sides = {"B1": [[1.0, 0]], "D21": [[0, 1.0]], "C1": [[1.0], [0]], "D12": [[0], [1.0]]}
    >>> P = lbt.linear.GeneralizedPlant(A=1.0, B2=1.0, C2=1.0, **sides)
    >>> least, quiet = lbt.hinf_controller(P), lbt.h2_controller(P)
    >>> K = lbt.mixed_controller(P, gamma=1.05 * least.gamma)
    >>> K.gamma <= 1.05 * least.gamma < quiet.gamma and quiet.rms < K.rms < least.rms
    True
    """
    gamma = number(gamma, "gamma", above=0)
    taps = integer(taps, "taps", at_least=1, at_most=400)
    return _first_certified(plant, partial(_design_mixed, gamma=gamma, taps=taps))


def _design_mixed(
    scaled: ScaledPlant, equations: TwoRiccati, share: float, *, gamma: float, taps: int
) -> ControllerDesign:
    """Return the controller of least variance, or the quietest that meets the bound."""
    checked = _checked_loop(scaled, equations.least_variance())
    if checked[1].gamma > gamma:
        checked = _checked_loop(scaled, _quietest(scaled, equations, gamma, taps))
    claims = {"gamma_requested": gamma}
    return _certified(scaled, checked, share, claims, method="mixed")


def _quietest(scaled: ScaledPlant, equations: TwoRiccati, gamma: float, taps: int) -> StateSpace:
    """Return the controller of least variance below a level, if there is one."""
    bracket = _Bracket.of(scaled, equations, 0.0)
    bracket.require(gamma)
    loop, level = free_parameter(equations), gamma * scaled.unit
    frequency_hz = np.linspace(0, 0.5 / loop.T11.dt_s, _POINTS)
    from lbt_synth.linear.lmi.output_feedback import least_variance_below

    for _ in range(_ROUNDS):
        try:
            parameter = least_variance_below(loop, level * (1 - _INSIDE), taps, frequency_hz)
        except NumericalError as error:
            raise InfeasibleError(
                f"no controller with {taps} taps was found below gamma = {gamma:.6g}; the "
                f"least gamma of any controller is {bracket.least:.6g}. Try more taps, "
                "or a larger gamma.",
                gamma=gamma,
                gamma_least=bracket.least,
            ) from error
        controller = loop.controller(parameter)
        peak = hinf_norm(scaled.plant.closed_loop(controller))
        if peak.upper <= level:
            break
        frequency_hz = np.unique(np.append(frequency_hz, peak.peak_frequency_hz))
    return controller


def _checked_loop(scaled: ScaledPlant, controller: StateSpace) -> _CheckedLoop:
    """Return a controller of the scaled plant in the given units, and the checks of its loop."""
    K, loop = scaled.closed_loop(controller)
    return K, _certify_loop(loop)


def _level(design: ControllerDesign) -> float:
    """Return what a design minimises."""
    return float(design.claims.get("gamma_least", design.rms))


def _first_certified(
    plant: GeneralizedPlant,
    synthesise: Callable[[ScaledPlant, TwoRiccati, float], ControllerDesign],
) -> ControllerDesign:
    """Return the design of the first equations that lead to one, the plant's own or next to it."""
    # equations are singular where a control costs nothing or a measurement has no noise; what was
    # added may be what is left: a smaller share is taken where it leaves less
    scaled = scaled_plant(plant)
    refusal: ValueError | SynthesisError
    for share in _SHARES:
        try:
            equations = scaled.equations(share)
        except (ProblemError, SynthesisError, np.linalg.LinAlgError) as error:
            refusal = error
            continue
        try:
            best = synthesise(scaled, equations, share)
        except (NumericalError, CertificateError, np.linalg.LinAlgError) as error:
            refusal = error
            continue
        for smaller in _SMALLER_SHARES if share else ():
            with suppress(ProblemError, SynthesisError, np.linalg.LinAlgError):
                other = synthesise(scaled, scaled.equations(smaller), smaller)
                best = other if _level(other) < _LESS * _level(best) else best
        return best
    if isinstance(refusal, np.linalg.LinAlgError):
        raise NumericalError(
            f"the plant and all next to it are singular to working accuracy: {refusal}. Scale "
            "states and signals to similar sizes.",
            status="singular",
        ) from refusal
    raise refusal


def _certified(
    scaled: ScaledPlant,
    checked: _CheckedLoop,
    share: float,
    claims: dict[str, float],
    *,
    method: str,
    witness: ControlWitness = NO_PROOF,
) -> ControllerDesign:
    """Check what is claimed of a loop, and return the design; CertificateError if it fails."""
    controller, certificate = checked
    route = "free parameter" if method == "mixed" else "riccati"
    design = ControllerDesign(
        method=method,
        problem=scaled.given,
        controller=controller,
        claims=claims,
        witness=witness,
        solver=SolverReport(route=route, status="solved"),
        regularised=share,
    )
    evidence = Evidence(design=design, certificate=certificate)
    return with_certificate(design, "Try a larger gamma, or more taps.", evidence=evidence)
