"""What a failed sensor does to a loop: the filter as it is, and the filter of the others.

A sensor that is known to have failed is not read, and the filter of the remaining sensors takes
over; its state is the same, so that nothing jumps. A sensor that fails unseen goes on giving
readings that do not follow the phase: zeros, or its last one. As far as stability goes these two
are one case.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TypeGuard

import numpy as np

from lbt_synth.design.certificate import (
    GAIN_TOLERANCE,
    Check,
    stability_check,
    variance_distance,
)
from lbt_synth.errors import ProblemError
from lbt_synth.linear import EstimationProblem, StateSpace, kalman_riccati
from lbt_synth.loop import ClosedLoop, close_loop
from lbt_synth.loop.budget import model_readings, residual_budget
from lbt_synth.models import TipTiltPlant
from lbt_synth.storage.rows import column, nm_column, table_row
from lbt_synth.validation import BoolArray, FloatArray, frozen_copy

MOST_UNITS = 6  # sensors and channels of which every subset gets a filter
LONGEST_DWELL = 10_000  # periods
_REGULAR = 1e-2  # of the covariance's diagonal, added: some states are functions of others


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fallback:
    """The filter of the sensors that remain when some have failed."""

    missing: tuple[str, ...]  # sensors and channels that are not read
    gains: FloatArray  # (n, q) or (N, n, q): predictor gains, zero for what is missing


@table_row
class FailureRow:
    """A loop in which some sensors have failed."""

    missing: str = column("sensors that fail")
    unseen_radius: float = column("radius, unseen", format=".6f")
    zero_nm: float | None = nm_column("residual, zeros", unit="nm rms", format=".1f")
    frozen_nm: float | None = nm_column("residual, frozen", unit="nm rms", format=".1f")
    fallback_radius: float = column("radius, not read", format=".6f")
    fallback_nm: float = nm_column("residual, not read", unit="nm rms", format=".1f")
    must_switch: bool = column("must be seen")


def failure_sets(units: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return every set of sensors and channels that may fail together, small ones first."""
    if len(units) > MOST_UNITS:
        raise ProblemError(
            f"a design has a fall-back filter for every set of failed sensors and channels, of "
            f"which there may be {MOST_UNITS}; got {len(units)}: {', '.join(units)}. Leave out the "
            "channels that buy least."
        )
    return [some for size in range(1, len(units) + 1) for some in combinations(units, size)]


def make_fallbacks(problem: EstimationProblem) -> tuple[Fallback, ...]:
    """Return the filter of the remaining sensors for every set that may fail.

    Without any reading the plant's model predicts alone; where the loop has its own sensor alone
    there is no fall-back.
    """
    if not reads_several(problem):
        return ()
    return tuple(
        Fallback(missing=missing, gains=_fallback_gains(problem, missing))
        for missing in failure_sets(problem.hardware.suite.units)
    )


def reads_several(problem: EstimationProblem) -> TypeGuard[TipTiltPlant]:
    """Return whether a problem is the plant of a loop with other sensors beside its own."""
    hardware = getattr(problem, "hardware", None)
    return hardware is not None and bool(hardware.suite.sensors)


def _remaining(plant: TipTiltPlant, missing: tuple[str, ...]) -> BoolArray:
    """Return which measurements are left without some sensors, (q,)."""
    return ~plant.hardware.suite.marked(missing, plant.hardware)


def _fallback_gains(plant: TipTiltPlant, missing: tuple[str, ...]) -> FloatArray:
    """Return the Kalman gains without some sensors, zero for what is missing, (N, n, q)."""
    remaining = _remaining(plant, missing)
    if not np.any(plant.read & remaining):
        shape = (plant.period, plant.n_states, plant.n_measurements)
        return frozen_copy(np.zeros(shape)[0 if plant.period == 1 else slice(None)])
    return kalman_riccati(plant.restricted(remaining)).gain_predictor


def fallback_checks(problem: TipTiltPlant, fallbacks: tuple[Fallback, ...]) -> list[Check]:
    """Check all fall-backs: the worst radius and the gains that are furthest from the least."""
    name = "spectral radius of any loop with sensors missing"
    radii = [
        stability_check(name, failed_loop(problem, fallback.gains, fallback.missing))
        for fallback in fallbacks
    ]
    apart = [
        Check(
            "distance from the least-variance gains of any fall-back",
            _fallback_distance(problem, fallback),
            GAIN_TOLERANCE,
            "gains recomputed from the Lyapunov covariances",
        )
        for fallback in fallbacks
    ]
    worst = [
        max(part, key=lambda check: (not check.passed, check.value)) for part in (radii, apart)
    ]
    return [*worst, _set_check(problem, fallbacks)]


def _set_check(problem: TipTiltPlant, fallbacks: tuple[Fallback, ...]) -> Check:
    """Check that there is one fall-back for each set of sensors that may fail."""
    sets = failure_sets(problem.hardware.suite.units)
    missing = [fallback.missing for fallback in fallbacks]
    value = float(missing != sets)
    return Check("sets of failed sensors without a fall-back", value, 0.5, "comparison")


def _fallback_distance(plant: TipTiltPlant, fallback: Fallback) -> float:
    """Return how far the gains of a fall-back are from those of least variance, relative."""
    remaining = _remaining(plant, fallback.missing)
    if not np.any(plant.read & remaining):
        return float(np.max(np.abs(fallback.gains), initial=0.0))
    error = plant.error_system(fallback.gains)
    if not error.spectral_radius < 1:
        return float("inf")
    return variance_distance(plant.restricted(remaining), fallback.gains, error.covariances())


def failure_rows(
    plant: TipTiltPlant, gains: FloatArray, fallbacks: tuple[Fallback, ...]
) -> tuple[FailureRow, ...]:
    """Return stability and residual of the loop for every set of sensors that fail.

    The residual is the exact one of the loop where the plant's model is the truth. A frozen reading
    is that of a frame in which all sensors are read, and stays for ever.
    """
    rows = []
    readings = model_readings(failed_loop(plant, gains, ()), plant)
    for fallback in fallbacks:
        unseen = failed_loop(plant, gains, fallback.missing)
        zero_nm = frozen_nm = None
        if unseen.is_stable:
            zero_nm = residual_budget(unseen, plant, frame_means=True).rms_nm
            frozen_nm = float(np.hypot(zero_nm, _offset_nm(unseen, readings)))
        switched = failed_loop(plant, fallback.gains, fallback.missing)
        rows.append(
            FailureRow(
                missing=" + ".join(fallback.missing),
                unseen_radius=unseen.spectral_radius,
                zero_nm=zero_nm,
                frozen_nm=frozen_nm,
                fallback_radius=switched.spectral_radius,
                fallback_nm=residual_budget(switched, plant, frame_means=True).rms_nm,
                must_switch=not unseen.is_stable,
            )
        )
    return tuple(rows)


def _offset_nm(loop: ClosedLoop, readings: FloatArray) -> float:
    """Return what readings (q, q) that stay for ever leave of themselves [nm rms]."""
    n, rows = loop.hardware.modes, loop.hardware.suite.marked(loop.blind, loop.hardware)
    response = np.real(loop.system.phase_response(0.0)[0, :, :n, n:][:, :, rows])
    power = np.einsum("tij,jk,tik->t", response, readings[np.ix_(rows, rows)], response)
    return float(np.sqrt(np.mean(power)))


def failed_loop(plant: TipTiltPlant, gains: FloatArray, missing: tuple[str, ...]) -> ClosedLoop:
    """Return the loop of a plant in which some sensors read zero."""
    return close_loop(plant.hardware, plant.controller(gains), blind=missing)


def dwell_frames(
    plant: TipTiltPlant, gains: FloatArray, fallbacks: tuple[Fallback, ...]
) -> int | None:
    """Return frames that each filter must stay for any sequence of them to be stable.

    Stable filters that take turns need not be stable. Where the plant is its model, the estimation
    error does not depend on the commands; it shrinks in a fixed norm while a filter stays long
    enough, whichever filter came before. The norm weighs the error by the covariance of the
    plant's state, mean over the phases. If a filter shrinks it in any number of periods from m to
    2 m - 1, it does in any more.
    """
    P = plant.error_system(np.zeros_like(gains)).covariances().mean(axis=0)
    sizes = np.diag(P)
    if not sizes.all():  # states that the plant leaves at zero hold past innovations
        errors = plant.error_system(gains).covariances().mean(axis=0)
        sizes = np.where(sizes > 0, sizes, np.diag(errors) / _REGULAR)
    root = np.linalg.cholesky(P + _REGULAR * np.diag(sizes))
    filters = [gains, *(each.gains for each in fallbacks)]
    needed = [_periods(plant.error_system(own), root) for own in filters]
    periods = [each for each in needed if each is not None]
    return (max(periods) + 2) * plant.period - 2 if len(periods) == len(filters) else None


def _periods(error: StateSpace, root: FloatArray) -> int | None:
    """Return after how many whole periods an error has shrunk, wherever in a period it begins."""
    inverse, each = np.linalg.inv(root), np.eye(len(root))

    def size(transition: FloatArray) -> float:
        return float(np.linalg.norm(inverse @ transition @ root, 2))

    before = after = 1.0  # of the parts of a period at both ends
    head = tail = each
    transitions = error.stacks()[0]
    for A, last in zip(transitions[:-1], transitions[:0:-1], strict=True):
        head, tail = A @ head, tail @ last
        after, before = max(after, size(head)), max(before, size(tail))
    allowed, period = 1 / (before * after), error.monodromy
    transition, shrunk = each, 0
    for count in range(1, LONGEST_DWELL):
        transition = period @ transition
        shrunk = shrunk if size(transition) < allowed else count
        if count >= 2 * shrunk + 1:
            return shrunk + 1
    return None
