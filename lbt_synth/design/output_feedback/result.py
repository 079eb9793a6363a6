"""A controller of a generalised plant, with its certificate."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from lbt_synth.design.certificate import (
    INFEASIBLE_TOLERANCE,
    LEVEL_SETS,
    NORM_TOLERANCE,
    VARIANCE_TOLERANCE,
    Certificate,
    Check,
    certify_error,
)
from lbt_synth.design.claims import Claim, Evidence, measured_claim
from lbt_synth.design.result import Design, SolverReport, with_certificate, without_units
from lbt_synth.errors import (
    CertificateError,
    NumericalError,
    ProblemError,
    SynthesisError,
)
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.output_feedback.lower_bound import (
    NO_PROOF,
    ControlWitness,
    infeasible_control_level,
)
from lbt_synth.linear.output_feedback.two_riccati import ScaledPlant, TwoRiccati, scaled_plant
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.storage.rows import fact_table, row_table
from lbt_synth.storage.summaries import Summary

_SHARES = (0.0, 1e-6, 1e-5, 1e-4)  # of the errors and disturbances, added in turn
SMALLER_SHARES = (1e-7, 1e-8)  # for plants of which the others leave more than there is
_LESS = 0.99  # of what is left, so that a smaller share is better


def _check_bound(evidence: Evidence, gamma: float) -> Iterator[Check]:
    """Check that the norm keeps its bound."""
    above = evidence.certificate.gamma / gamma - 1
    yield Check("norm of the closed loop over its bound, less 1", above, NORM_TOLERANCE, LEVEL_SETS)


def _check_least_rms(evidence: Evidence, least: float) -> Iterator[Check]:
    """Check that the variance is what the equations say the least one is."""
    above = evidence.certificate.rms / max(least, 1e-300) - 1
    how = "closed loop against the Riccati equations"
    yield Check("rms over the least, less 1", above, VARIANCE_TOLERANCE, how)


def _check_infeasible(evidence: Evidence, level: float) -> Iterator[Check]:
    """Check that the witness proves the level."""
    design = evidence.design
    scaled = scaled_plant(design.problem)
    proved = infeasible_control_level(scaled.plant, design.witness) / scaled.unit
    above = level / max(proved, 1e-300) - 1
    how = "pairs that no measurement shows and no control moves"
    name = "infeasible level over the level proved, less 1"
    yield Check(name, above, INFEASIBLE_TOLERANCE, how)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControllerDesign(Design):
    """A certified controller of a generalised plant, ``u = K y``.

    Attributes
    ----------
    problem : GeneralizedPlant
        The plant.
    controller : StateSpace
        From y to u, in textbook form.
    closed_loop : StateSpace
        From w to z; ``gamma`` is its norm, ``rms`` that of z for white w of unit variance.
    witness : ControlWitness
        The proof that ``gamma_infeasible`` cannot be reached; its ``reason`` says why in words.
    regularised : float
        Share of the errors and disturbances that was added because the plant's own equations are
        singular, or leave rounding alone; mostly 0. The certificate is that of the plant as given.
    """

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
    controller: StateSpace  # type: ignore[assignment]
    closed_loop: StateSpace
    witness: ControlWitness = NO_PROOF
    regularised: float = 0.0

    def make_controller(self) -> StateSpace:  # type: ignore[override]
        """Return the controller as it was computed."""
        return self.controller

    def examine(self) -> Evidence:
        """Compute the norms of the closed loop."""
        name = "spectral radius of the closed loop"
        return Evidence(design=self, certificate=certify_error(self.closed_loop, stability=name))

    def notes(self) -> list[str]:
        """Return why no controller is below the level, and what was added to a singular plant."""
        notes = [f"below: {self.witness.reason}"] if "gamma_infeasible" in self.claims else []
        if self.regularised:
            notes.append(f"singular problem, regularised by a share of {self.regularised:g}")
        return notes

    def _summarise(self) -> Summary:
        tables = [
            without_units(fact_table("Controller", self.facts())),
            row_table("Certificate", self.certificate.checks),
        ]
        return Summary(tables=tables, notes=self.notes())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CheckedLoop:
    """A controller and its loop, with the checks of the loop."""

    controller: StateSpace
    loop: StateSpace
    certificate: Certificate


def checked_loop(scaled: ScaledPlant, controller: StateSpace) -> CheckedLoop:
    """Close the loop of a controller of the scaled plant, and check it."""
    K, loop = scaled.closed_loop(controller)
    certificate = certify_error(loop, stability="spectral radius of the closed loop")
    return CheckedLoop(controller=K, loop=loop, certificate=certificate)


def _level(design: ControllerDesign) -> float:
    """Return what a design minimises."""
    return float(design.claims.get("gamma_least", design.rms))


def first_certified(
    scaled: ScaledPlant, design: Callable[[TwoRiccati, float], ControllerDesign]
) -> ControllerDesign:
    """Return the design of the first equations that lead to one, the plant's own or next to it.

    Equations are singular where a control costs nothing or a measurement has no noise. Where
    perfect control leaves rounding alone, no norm can be certified either. What was added may be
    what is left: a smaller share is taken where it leaves less.
    """
    refusal: ValueError | SynthesisError
    for share in _SHARES:
        try:
            equations = scaled.equations(share)
        except (ProblemError, SynthesisError, np.linalg.LinAlgError) as error:
            refusal = error
            continue
        try:
            best = design(equations, share)
        except (NumericalError, CertificateError, np.linalg.LinAlgError) as error:
            refusal = error
            continue
        for smaller in SMALLER_SHARES if share else ():
            with suppress(ProblemError, SynthesisError, np.linalg.LinAlgError):
                other = design(scaled.equations(smaller), smaller)
                best = other if _level(other) < _LESS * _level(best) else best
        return best
    if isinstance(refusal, np.linalg.LinAlgError):
        raise NumericalError(
            f"the plant and all next to it are singular to working accuracy: {refusal}. Scale "
            "states and signals to similar sizes.",
            status="singular",
        ) from refusal
    raise refusal


def certified_controller(
    scaled: ScaledPlant,
    checked: CheckedLoop,
    *,
    method: str,
    route: str,
    witness: ControlWitness = NO_PROOF,
    regularised: float = 0.0,
    hint: str = "",
    claims: Mapping[str, float] = MappingProxyType({}),
) -> ControllerDesign:
    """Check what is claimed of a loop, and return the design; CertificateError if it fails."""
    design = ControllerDesign(
        method=method,
        problem=scaled.given,
        controller=checked.controller,
        closed_loop=checked.loop,
        claims=claims,
        witness=witness,
        solver=SolverReport(route=route, status="solved", iterations=0),
        regularised=regularised,
    )
    evidence = Evidence(design=design, certificate=checked.certificate)
    return with_certificate(design, hint, evidence=evidence)
