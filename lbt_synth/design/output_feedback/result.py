"""A controller of a generalised plant, with its certificate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

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
from lbt_synth.errors import (
    CertificateError,
    NumericalError,
    ProblemError,
    SynthesisError,
)
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.output_feedback.lower_bound import ControlWitness, infeasible_control_level
from lbt_synth.linear.output_feedback.scaled_plant import ScaledPlant
from lbt_synth.linear.output_feedback.two_riccati import TwoRiccati
from lbt_synth.linear.state_space import StateSpace, sigma_sparkline
from lbt_synth.storage.rows import column, fact_table, row_table, table_row
from lbt_synth.storage.summaries import Summarised, Summary

_SHARES = (0.0, 1e-6, 1e-5, 1e-4)  # of the errors and disturbances, added in turn


@table_row
class ControllerFacts:
    """What a controller of a generalised plant is, and what it leaves."""

    method: str = column("method")
    route: str = column("route")
    n_states: int = column("states of the controller")
    gamma: float = column("gamma, the norm from w to z")
    gamma_requested: float | None = column("gamma requested")
    gamma_least: float | None = column("least gamma, reached by a controller")
    gamma_infeasible: float | None = column("gamma that no controller reaches")
    rms: float = column("rms of z for white w of unit variance")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControllerDesign(Summarised):
    """A certified controller of a generalised plant."""

    plant: GeneralizedPlant  # the plant
    controller: StateSpace  # from y to u, in textbook form: ``u = K y``
    closed_loop: StateSpace  # from w to z
    gamma: float  # H-infinity norm of the closed loop, recomputed
    rms: float  # standard deviation of z for white w of unit variance per sample
    # the bound that was given; the norm that a controller achieves; and a level that none reaches,
    # proved by ``witness``. Where they were not computed they are nan
    gamma_requested: float = np.nan
    gamma_least: float = np.nan
    gamma_infeasible: float = np.nan
    # the proof that ``gamma_infeasible`` cannot be reached; its ``reason`` says why in words
    witness: ControlWitness | None = None
    certificate: Certificate  # the checks, computed from the matrices of plant and controller alone
    method: str  # "h2", "hinf" or "mixed", and how it was solved
    route: str
    # share of the errors and disturbances that was added because the plant's own equations are
    # singular, or leave rounding alone; mostly 0. The certificate is that of the plant as given
    regularised: float = 0.0

    def _brief(self) -> str:
        return f"{self.method}, {len(self.controller.A)} states, gamma {self.gamma:.6g}"

    def _summarise(self) -> Summary:
        facts = ControllerFacts(
            method=self.method,
            route=self.route,
            n_states=len(self.controller.A),
            gamma=self.gamma,
            gamma_requested=_given(self.gamma_requested),
            gamma_least=_given(self.gamma_least),
            gamma_infeasible=_given(self.gamma_infeasible),
            rms=self.rms,
        )
        notes = [] if self.witness is None else [f"below: {self.witness.reason}"]
        if self.regularised:
            notes.append(f"singular problem, regularised by a share of {self.regularised:g}")
        curve = sigma_sparkline(self.closed_loop, "largest singular value from w to z")
        tables = [
            fact_table("Controller", facts),
            row_table("Certificate", self.certificate.checks),
        ]
        return Summary(tables=tables, notes=notes, curve=curve)


def _given(value: float) -> float | None:
    return None if np.isnan(value) else value


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


def first_certified(
    scaled: ScaledPlant, design: Callable[[TwoRiccati, float], ControllerDesign]
) -> ControllerDesign:
    """Return the design of the first equations that lead to one, the plant's own or next to it.

    Equations are singular where a control costs nothing or a measurement has no noise. Where
    perfect control leaves rounding alone, no norm can be certified either.
    """
    refusal: ValueError | SynthesisError
    for share in _SHARES:
        try:
            equations = scaled.equations(share)
        except (ProblemError, SynthesisError, np.linalg.LinAlgError) as error:
            refusal = error
            continue
        try:
            return design(equations, share)
        except (NumericalError, CertificateError, np.linalg.LinAlgError) as error:
            refusal = error
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
    gamma_requested: float = np.nan,
    gamma_least: float = np.nan,
    gamma_infeasible: float = np.nan,
    witness: ControlWitness | None = None,
    regularised: float = 0.0,
    least_rms: float = np.nan,
    hint: str = "",
) -> ControllerDesign:
    """Check what is claimed of a loop, and return the design.

    ``least_rms`` is what the least variance is known to be. Raises a CertificateError if a check
    fails.
    """
    certificate = checked.certificate
    checks = list(certificate.checks)
    if np.isfinite(certificate.gamma):
        if np.isfinite(gamma_requested):
            limit = gamma_requested * (1 + NORM_TOLERANCE)
            checks.append(Check("norm of the closed loop", certificate.gamma, limit, LEVEL_SETS))
        if np.isfinite(least_rms):
            above = certificate.rms / max(least_rms, 1e-300) - 1
            how = "closed loop against the Riccati equations"
            checks.append(Check("rms over the least, less 1", above, VARIANCE_TOLERANCE, how))
        if witness is not None:
            proved = infeasible_control_level(scaled.plant, witness)
            above = gamma_infeasible / max(proved, 1e-300) - 1
            how = "pairs that no measurement shows and no control moves"
            name = "infeasible level over the level proved, less 1"
            checks.append(Check(name, above, INFEASIBLE_TOLERANCE, how))
    certificate = replace(certificate, checks=tuple(checks)).require(hint)
    return ControllerDesign(
        plant=scaled.given,
        controller=checked.controller,
        closed_loop=checked.loop,
        gamma=certificate.gamma,
        rms=certificate.rms,
        gamma_requested=gamma_requested,
        gamma_least=gamma_least,
        gamma_infeasible=gamma_infeasible,
        witness=witness,
        certificate=certificate,
        method=method,
        route=route,
        regularised=regularised,
    )
