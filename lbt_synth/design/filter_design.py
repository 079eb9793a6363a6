"""The design of a filter: its gains, what is claimed of bounds, and what a failed sensor does.

A sensor that is known to have failed is not read, and the filter of the remaining sensors takes
over; its state is the same, so that nothing jumps. A sensor that fails unseen goes on giving
readings that do not follow the phase: zeros, or its last one. As far as stability goes these two
are one case.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, ClassVar, TypeAlias, TypeGuard, cast

import numpy as np

from lbt_synth.design.certificate import (
    INFEASIBLE_TOLERANCE,
    LEVEL_SETS,
    ORIGIN_TOLERANCE,
    TOLERANCE,
    Check,
    Claim,
    Evidence,
    certify_filter,
    certify_infeasible,
    measured_claim,
    stability_check,
    variance_distance,
)
from lbt_synth.design.result import (
    MODEL_LIMITS,
    SENSOR_FACTS,
    Design,
    RowTable,
    SolverReport,
    model_limits,
    sensor_facts,
    with_certificate,
)
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.linear import Controller, EstimationProblem, StateSpace
from lbt_synth.linear.infeasibility_proof import Witness
from lbt_synth.linear.matrix_functions import relative_distance
from lbt_synth.linear.riccati.filtering import GammaEquation, gamma_riccati, kalman_riccati
from lbt_synth.loop import ClosedLoop, close_loop
from lbt_synth.loop.budget import model_covariances
from lbt_synth.models import TipTiltPlant
from lbt_synth.storage.rows import Column, Facts, fact, facts
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy, set_fields

MOST_UNITS = 6  # sensors and channels of which every subset gets a filter
ORIGIN = "distance from its Riccati filter"


def _check_bound(evidence: Evidence, gamma: float) -> Iterator[Check]:
    """Check that the norm keeps its bound, and that the filter is one of this bound."""
    design, norm = evidence.design, evidence.certificate.gamma
    name = "norm of the estimation error over its bound, less 1"
    yield Check(name, norm / gamma - 1, TOLERANCE, LEVEL_SETS)
    origins = [evidence.kalman]
    with suppress(NumericalError):
        central = gamma_riccati(design.problem, gamma, start=evidence.kalman)
        origins += [] if central is None else [central]
    distance = min(relative_distance(design.gain_predictor, x.gain_predictor) for x in origins)
    name = f"{ORIGIN}, or of the norm from its bound"
    value = min(distance, abs(norm / gamma - 1))
    yield Check(name, value, ORIGIN_TOLERANCE, "relative")


def _check_least(evidence: Evidence, least: float) -> Iterator[Check]:
    """Check the least norm on both sides: the level above is met, the level below is not."""
    equation = GammaEquation(evidence.design.problem, evidence.kalman)
    levels = least * (1 - TOLERANCE), least * (1 + TOLERANCE)
    meets = [equation.trial(level).P is not None for level in levels]
    off = 0.0 if meets == [False, True] else np.inf
    how = "gamma-Riccati equation on both sides"
    yield Check("least norm of any filter, error", off, TOLERANCE, how)


def _check_infeasible(evidence: Evidence, level: float) -> Iterator[Check]:
    """Check that the witness proves the level, and that no filter contradicts it."""
    problem = evidence.design.problem
    value = level / evidence.certificate.gamma - 1
    name = "infeasible level over the norm achieved, less 1"
    yield Check(name, value, INFEASIBLE_TOLERANCE, LEVEL_SETS)
    proved = certify_infeasible(problem, level, evidence.design.witness)
    below = -proved.value / (1 + proved.value)
    yield proved
    name = "level proved over the infeasible level, less 1"
    yield Check(name, below, TOLERANCE, proved.computed_by)


# predictor gains (n, q) or (N, n, q) of the filters of the sensors that remain, by the sensors and
# channels that have failed; they are zero for these
Fallbacks: TypeAlias = Mapping[tuple[str, ...], FloatArray]


def failure_sets(units: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return every set of sensors and channels that may fail together, small ones first."""
    if len(units) > MOST_UNITS:
        raise ProblemError(
            f"a design has a fall-back filter for every set of failed sensors and channels, of "
            f"which there may be {MOST_UNITS}; got {len(units)}: {', '.join(units)}. Leave out the "
            "channels that buy least."
        )
    return [some for size in range(1, len(units) + 1) for some in combinations(units, size)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterDesign(Design):
    """A Kalman or H-infinity filter, and the controller made of it.

    Attributes
    ----------
    problem : EstimationProblem
        The problem (a plant, for a telescope).
    gain_predictor : (n, q) ndarray
        ``(A P C' + S) (C P C' + R)^-1``: of ``x(k+1|k) = A x(k|k-1) + gain (y(k) - C x(k|k-1))``.
    witness : Witness or None
        Disturbances that no measurement shows: the proof that no filter reaches
        ``gamma_infeasible``.
    fallbacks : mapping of tuple of str to ndarray
        Where the loop has other sensors beside its own: the predictor gains of the remaining ones,
        for each set of sensors and channels that may fail.

    The gain is (N, n, q) where the sensors have a common period of N frames.
    """

    CLAIMS: ClassVar[tuple[Claim, ...]] = (
        measured_claim("rms", "estimation error, rms"),
        measured_claim("gamma", "estimation error, H-infinity norm"),
        Claim(name="gamma_requested", heading="bound asked for", unit="nm", checks=_check_bound),
        Claim(
            name="gamma_least",
            heading="least norm of any filter, upper bound",
            unit="nm",
            format=".9g",
            checks=_check_least,
        ),
        Claim(
            name="gamma_infeasible",
            heading="least norm of any filter, lower bound",
            unit="nm",
            format=".9g",
            checks=_check_infeasible,
        ),
    )
    DERIVED: ClassVar[tuple[Column, ...]] = (
        *MODEL_LIMITS,
        *SENSOR_FACTS,
        Column(name="period", heading="common period", unit="frames"),
    )
    is_estimator: ClassVar[bool] = True
    knows_mirror: ClassVar[bool] = False

    problem: EstimationProblem
    gain_predictor: FloatArray
    witness: Witness | None = None
    fallbacks: Fallbacks = field(default_factory=dict)

    def __post_init__(self) -> None:
        gain = self.problem.checked_gain(self.gain_predictor, "gain_predictor")
        set_fields(self, gain_predictor=gain)
        Design.__post_init__(self)

    def make_controller(self) -> Controller:
        """Return the controller of the predictor gain."""
        return self.problem.controller(self.gain_predictor)

    def error_system(self) -> StateSpace:
        """System from w to the estimation error."""
        return self.problem.error_system(self.gain_predictor)

    def derived(self) -> dict[str, Any]:
        """Return residual and limit in the own model, or what holds with several sensors."""
        plant = self.problem
        if not reads_several(plant):
            return dict(model_limits(self))
        return {**sensor_facts(self, plant.hardware), "period": plant.period}

    @property
    def controllers(self) -> dict[frozenset[str], Controller]:
        """The controller for each set of sensors and channels that are not read, none included."""
        pairs = self.fallbacks.items()
        others = {frozenset(missing): self.problem.controller(gains) for missing, gains in pairs}
        return {frozenset(): self.controller, **others}

    def tables(self) -> tuple[RowTable, ...]:
        """Return what becomes of the loop when sensors fail."""
        if not reads_several(self.problem):
            return ()
        rows = failure_rows(self.problem, self.gain_predictor, self.fallbacks)
        note = (
            "unseen: the readings are zero, or frozen, and the filter believes them: a reading "
            "that stays leaves an offset, which counts to the residual. Not read: the fall-back "
            "filter of this file for the remaining sensors, with the same state."
        )
        return (RowTable(key="failures", title="When sensors fail", rows=rows, notes=[note]),)

    def notes(self) -> list[str]:
        """Return which failures the loop has to see, of which none holds another."""
        fatal: list[tuple[str, ...]] = []
        for missing in self.fallbacks:  # small ones first
            loop = failed_loop(cast("TipTiltPlant", self.problem), self.gain_predictor, missing)
            if not any({*fewer} <= {*missing} for fewer in fatal) and not loop.is_stable:
                fatal.append(missing)
        sets = "; ".join(" + ".join(missing) for missing in fatal)
        warning = (
            f"warning: unstable if these fail unseen, alone or with others: {sets}. The loop's "
            "computer has to see such a failure, and take the fall-back filter."
        )
        return [warning] * bool(fatal)

    @property
    def poles(self) -> ComplexArray:
        """Poles of the estimation error, (n,)."""
        return self.error_system().poles

    def examine(self) -> Evidence:
        """Compute the norms of the error, and check the gains of fall-backs."""
        least = "gamma_requested" not in self.claims
        certificate = certify_filter(self.problem, self.gain_predictor, least_variance=least)
        if not certificate.checks[0].passed:
            return Evidence(design=self, certificate=certificate)
        kalman = kalman_riccati(self.problem)
        checks = list(certificate.checks)
        if reads_several(self.problem):
            checks += fallback_checks(self.problem, self.fallbacks)
        if least:
            distance = relative_distance(self.gain_predictor, kalman.gain_predictor)
            checks.append(Check(ORIGIN, distance, ORIGIN_TOLERANCE, "relative"))
        certificate = replace(certificate, checks=tuple(checks))
        return Evidence(design=self, certificate=certificate, kalman=kalman)


def filter_design(
    problem: EstimationProblem,
    gain_predictor: FloatArray,
    *,
    method: str,
    solver: SolverReport,
    witness: Witness | None = None,
    **claims: Any,
) -> FilterDesign:
    """Make a design and certify it; raise CertificateError if it fails."""
    design = FilterDesign(
        method=method,
        solver=solver,
        problem=problem,
        gain_predictor=gain_predictor,
        witness=witness,
        fallbacks=make_fallbacks(problem),
        claims={name: value for name, value in claims.items() if value is not None},
    )
    return with_certificate(design, "Try the other route, or scale the states to similar sizes.")


def make_fallbacks(problem: EstimationProblem) -> Fallbacks:
    """Return the filter of the remaining sensors for every set that may fail.

    Without any reading the plant's model predicts alone; where the loop has its own sensor alone
    there is no fall-back.
    """
    if not reads_several(problem):
        return {}
    sets = failure_sets(problem.hardware.suite.units)
    return {missing: _fallback_gains(problem, missing) for missing in sets}


def reads_several(problem: EstimationProblem) -> TypeGuard[TipTiltPlant]:
    """Return whether a problem is the plant of a loop with other sensors beside its own."""
    hardware = getattr(problem, "hardware", None)
    return hardware is not None and bool(hardware.suite.sensors)


def _fallback_gains(plant: TipTiltPlant, missing: tuple[str, ...]) -> FloatArray:
    """Return the Kalman gains without some sensors, zero for what is missing, (N, n, q)."""
    remaining = ~plant.hardware.suite.marked(missing, plant.hardware)
    if not np.any(plant.read & remaining):
        shape = (plant.period, plant.n_states, plant.n_measurements)
        return frozen_copy(np.zeros(shape)[0 if plant.period == 1 else slice(None)])
    return kalman_riccati(plant.restricted(remaining)).gain_predictor


def fallback_checks(problem: TipTiltPlant, fallbacks: Fallbacks) -> list[Check]:
    """Check all fall-backs: the worst radius and the gains that are furthest from the least."""
    name = "spectral radius of any loop with sensors missing"
    radii = [
        stability_check(name, failed_loop(problem, gains, missing))
        for missing, gains in fallbacks.items()
    ]
    apart = [
        Check(
            "distance from the least-variance gains of any fall-back",
            _fallback_distance(problem, missing, gains),
            TOLERANCE,
            "gains recomputed from the Lyapunov covariances",
        )
        for missing, gains in fallbacks.items()
    ]
    worst = [
        max(part, key=lambda check: (not check.passed, check.value)) for part in (radii, apart)
    ]
    sets = failure_sets(problem.hardware.suite.units)
    value = float(list(fallbacks) != sets)
    name = "sets of failed sensors without a fall-back"
    return [*worst, Check(name, value, 0.5, "comparison")]


def _fallback_distance(plant: TipTiltPlant, missing: tuple[str, ...], gains: FloatArray) -> float:
    """Return how far the gains of a fall-back are from those of least variance, relative."""
    remaining = ~plant.hardware.suite.marked(missing, plant.hardware)
    if not np.any(plant.read & remaining):
        return float(np.max(np.abs(gains), initial=0.0))
    error = plant.error_system(gains)
    if not error.spectral_radius < 1:
        return float("inf")
    return variance_distance(plant.restricted(remaining), gains, error.covariances())


def failure_rows(plant: TipTiltPlant, gains: FloatArray, fallbacks: Fallbacks) -> list[Facts]:
    """Return stability and residual of the loop for every set of sensors that fail.

    The residual is the exact one of the loop where the plant's model is the truth. A frozen reading
    is that of a frame in which all sensors are read, and stays for ever.
    """
    n, rows, rms = plant.hardware.modes, [], {"unit": "nm rms", "format": ".1f"}
    radius = {"format": ".6f"}
    readings = model_covariances(failed_loop(plant, gains, ()), plant)[0, n:, n:]

    def left_nm(loop: ClosedLoop) -> float:
        covariances = model_covariances(loop, plant)[:, :n, :n]
        return float(np.sqrt(np.trace(covariances.mean(axis=0))))

    for missing, fallback_gains in fallbacks.items():
        unseen = failed_loop(plant, gains, missing)
        zero_nm = frozen_nm = None
        if unseen.is_stable:
            zero_nm = left_nm(unseen)
            frozen_nm = float(np.hypot(zero_nm, _offset_nm(unseen, readings)))
        switched = failed_loop(plant, fallback_gains, missing)
        rows.append(
            facts(
                missing=fact(" + ".join(missing), "sensors that fail"),
                unseen_radius=fact(unseen.spectral_radius, "radius, unseen", **radius),
                zero_nm=fact(zero_nm, "residual, zeros", **rms),
                frozen_nm=fact(frozen_nm, "residual, frozen", **rms),
                fallback_radius=fact(switched.spectral_radius, "radius, not read", **radius),
                fallback_nm=fact(left_nm(switched), "residual, not read", **rms),
                must_switch=fact(not unseen.is_stable, "must be seen"),
            )
        )
    return rows


def _offset_nm(loop: ClosedLoop, readings: FloatArray) -> float:
    """Return what readings (q, q) that stay for ever leave of themselves [nm rms]."""
    n, rows = loop.hardware.modes, loop.hardware.suite.marked(loop.blind, loop.hardware)
    response = np.real(loop.system.phase_response(0.0)[0, :, :n, n:][:, :, rows])
    power = np.einsum("tij,jk,tik->t", response, readings[np.ix_(rows, rows)], response)
    return float(np.sqrt(np.mean(power)))


def failed_loop(plant: TipTiltPlant, gains: FloatArray, missing: tuple[str, ...]) -> ClosedLoop:
    """Return the loop of a plant in which some sensors read zero."""
    return close_loop(plant.hardware, plant.controller(gains), blind=missing)
