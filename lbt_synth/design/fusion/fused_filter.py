"""Filters of several sensors: Kalman, H-infinity and mixed, periodic where the rates differ."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import brentq

from lbt_synth.design.certificate import (
    BY_DISTURBANCES,
    GAIN_TOLERANCE,
    INFEASIBLE_TOLERANCE,
    NORM_TOLERANCE,
    Certificate,
    Check,
    bound_check,
    certify_error,
)
from lbt_synth.design.fusion.failures import Fallback, failed_loop, make_fallbacks, stacked_gains
from lbt_synth.design.hinf import checked_bounds, require_reachable
from lbt_synth.design.result import UNCERTIFIED, Design, SolverReport, with_certificate
from lbt_synth.errors import InfeasibleError
from lbt_synth.linear import Controller, StateSpace, hinf_norm, infeasible_level
from lbt_synth.linear.infeasibility_proof import worst_invisible_disturbance
from lbt_synth.linear.matrix_functions import relative_distance
from lbt_synth.linear.riccati.filtering import (
    FilterRiccati,
    gamma_riccati,
    kalman_riccati,
    least_gamma,
)
from lbt_synth.linear.riccati.periodic import kalman_gain
from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.loop.fusion.fused_loop import (
    FusedLoop,
    close_fused_loop,
    fused_radii_by_gain,
)
from lbt_synth.loop.margins import stable_interval
from lbt_synth.models import LoopHardware
from lbt_synth.models.fusion.plant import FusedPlant
from lbt_synth.storage.rows import column, fact_table, table_row
from lbt_synth.storage.summaries import Summary
from lbt_synth.validation import ComplexArray, FloatArray, require_instance, set_fields

LONGEST_DWELL = 10_000  # periods
_REGULAR = 1e-2  # of the covariance's diagonal, added: some states are functions of others
_DECADES = 4.0  # of gamma, over which a central filter is searched
_INSIDE = 1e-7  # by which the norm of a mixed filter stays below its bound


def fused_name(claims: Collection[str]) -> str:
    """Return ``Design.method`` of a filter of several sensors, by what it claims."""
    if "gamma_central" in claims:
        return "fused mixed"
    return "fused hinf" if "gamma_requested" in claims else "fused kalman"


@table_row
class FusedFacts:
    """What a filter of several sensors achieves."""

    sensors: str = column("sensors and channels")
    period: int = column("common period", unit="frames")
    rms: float = column("estimation error, rms", unit="nm")
    gamma: float = column("estimation error, H-infinity norm over a period", unit="nm")
    gamma_requested: float | None = column("bound asked for", unit="nm")
    gamma_least: float | None = column("least norm of any filter", unit="nm", format=".9g")
    gamma_infeasible: float | None = column("no filter has a norm below", unit="nm", format=".9g")
    loop_radius: float = column("spectral radius of the loop, over a period", format=".6f")
    gain_low: float = column("stable sensor gains, from", format=".4g")
    gain_high: float = column("stable sensor gains, to", format=".4g")
    dwell_frames: int | None = column(
        "stable if sensors fail or return no sooner than after",
        unit="frames",
        help="Whatever the order: a proof, where the plant is its model; sooner may be stable, too",
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusedFilter(Design):
    """A filter of several sensors, with the filters that take over when some fail.

    Attributes
    ----------
    problem : FusedPlant
        The plant that the sensors see.
    gains : (N, n, q) ndarray
        Predictor gains of each phase; zero for measurements that are not read.
    fallbacks : tuple of Fallback
        Filter of the remaining sensors, for each set of sensors and channels that may fail.
    gamma_requested : float or None
        Bound that an H-infinity design was given.
    gamma_least : float or None
        Norm that a filter of the problem achieves, the least one to 1e-9.
    gamma_infeasible : float or None
        Norm that no filter reaches, proved by disturbances that no measurement shows.
    gamma_central : float or None
        Level of the central filter that just meets the bound, of a mixed design.
    """

    controller: Controller = field(init=False)
    problem: FusedPlant
    gains: FloatArray
    fallbacks: tuple[Fallback, ...] = ()
    gamma_requested: float | None = None
    gamma_least: float | None = None
    gamma_infeasible: float | None = None
    gamma_central: float | None = None

    def __post_init__(self) -> None:
        set_fields(self, controller=self.problem.controller(self.gains))

    @property
    def several_sensors(self) -> bool:
        """Whether the design reads other sensors beside the loop's own: it does."""
        return True

    @property
    def loop_hardware(self) -> LoopHardware:
        """Mirror, delay and own sensor of the loop."""
        return self.problem.own.hardware

    @property
    def gamma(self) -> float:
        """Norm of the estimation error over a period, recomputed."""
        return self.certificate.gamma

    @property
    def rms(self) -> float:
        """Standard deviation of the estimation error, mean over the period, recomputed."""
        return self.certificate.rms

    @property
    def poles(self) -> ComplexArray:
        """Poles of the estimation error over a period, (n,)."""
        return self.problem.error_system(self.gains).poles

    def close(self, hardware: LoopHardware, *, sensor_gain: float = 1.0) -> FusedLoop:
        """Close a loop around the design, whose sensors are those that it was made for.

        Parameters
        ----------
        hardware : LoopHardware
            Mirror, delay and own sensor.
        sensor_gain : float, optional
            Real gain of the loop's own sensor relative to its matrix.
        """
        return close_fused_loop(
            hardware, self.problem.suite, self.controller, sensor_gain=sensor_gain
        )

    def loop(self, sensor_gain: float = 1.0) -> FusedLoop:
        """Return the loop that the design is for, closed."""
        return self.close(self.loop_hardware, sensor_gain=sensor_gain)

    @property
    def controllers(self) -> dict[frozenset[str], Controller]:
        """The controller for each set of sensors and channels that are not read, none included."""
        own = {frozenset(f.missing): self.problem.controller(f.gains) for f in self.fallbacks}
        return {frozenset(): self.controller, **own}

    def facts(self) -> FusedFacts:
        """Return what the filter achieves."""
        suite = self.problem.suite
        low, high = stable_interval(fused_radii_by_gain(self.loop_hardware, suite, self.controller))
        return FusedFacts(
            sensors=", ".join(suite.units),
            period=self.problem.period,
            rms=self.rms,
            gamma=self.gamma,
            gamma_requested=self.gamma_requested,
            gamma_least=self.gamma_least,
            gamma_infeasible=self.gamma_infeasible,
            loop_radius=self.loop().spectral_radius,
            gain_low=low,
            gain_high=high,
            dwell_frames=dwell_frames(self.problem, self.gains, self.fallbacks),
        )

    def _brief(self) -> str:
        return f"{self.method}, {self.problem._brief()}"

    def _summarise(self) -> Summary:
        notes = [f"assumes: {assumption}." for assumption in self.assumptions]
        return Summary(tables=[fact_table("Design", self.facts())], notes=notes)

    def recertify(self) -> Certificate:
        """Compute the certificate again: the filter, its claims, its loop and its fall-backs."""
        problem, period = self.problem, self.problem.period
        certificate = certify_error(
            problem.error_system(self.gains).lifted_compactly(),
            stability="spectral radius over a period",
        )
        checks = list(certificate.checks)
        if checks[0].passed:
            if self.gamma_requested is None:
                checks.append(_least_variance_check(problem, self.gains))
            else:
                checks += self._bound_checks(certificate, self.gamma_requested)
        checks.append(_stable("spectral radius of the closed loop", self.loop()))
        checks += self._fallback_checks()
        powers = certificate.rms_per_output.reshape(-1, len(problem.L)) ** 2
        rms = np.sqrt(powers.sum(axis=0) / period)
        return replace(certificate, checks=tuple(checks), rms_per_output=rms)

    def _fallback_checks(self) -> list[Check]:
        """Check all fall-backs: the worst radius and the gains that are furthest from the least."""
        if not self.fallbacks:
            return []
        problem, name = self.problem, "spectral radius of any loop with sensors missing"
        radii, apart = [], []
        for each in self.fallbacks:
            radii.append(_stable(name, failed_loop(problem, each.gains, each.missing)))
            apart.append(_least_variance_check(problem, each.gains, each.missing))
        return [
            max(checks, key=lambda check: (not check.passed, check.value))
            for checks in (radii, apart)
        ]

    def _bound_checks(self, certificate: Certificate, bound: float) -> list[Check]:
        checks, problem = [bound_check(certificate.gamma, bound)], self.problem
        start = kalman_riccati(problem)
        if self.gamma_least is not None:
            meets = [
                gamma_riccati(problem, self.gamma_least * (1 + side), start=start) is not None
                for side in (-NORM_TOLERANCE, NORM_TOLERANCE)
            ]
            off = 0.0 if meets == [False, True] else np.inf
            how = "gamma-Riccati equation on both sides"
            checks.append(Check("least norm of any filter, error", off, NORM_TOLERANCE, how))
            least = gamma_riccati(problem, self.gamma_least, start=start)
            proved = proved_level(problem, start, least, self.gamma_least)
            above = (self.gamma_infeasible or 0.0) / max(proved, 1e-300) - 1
            name, how = "infeasible level over the level proved, less 1", BY_DISTURBANCES
            checks.append(Check(name, above, INFEASIBLE_TOLERANCE, how))
        level = self.gamma_central or bound
        central = gamma_riccati(problem, level, start=start)
        apart = np.inf
        if central is not None:
            apart = relative_distance(self.gains, stacked_gains(central))
        name, how = "distance from its Riccati filter", "relative"
        checks.append(Check(name, apart, 1e-5, how))
        return checks


def _stable(name: str, loop: FusedLoop) -> Check:
    how = "eigenvalues of the monodromy, per frame"
    return Check(name, loop.system.radius_per_frame, 1 - STABILITY_MARGIN, how)


def _least_variance_check(
    problem: FusedPlant, gains: FloatArray, missing: tuple[str, ...] = ()
) -> Check:
    """Check that gains are those of least variance, by the covariance of a Lyapunov equation."""
    name = "distance from the least-variance gains" + (" of any fall-back" if missing else "")
    how = "gains recomputed from the Lyapunov covariances"
    remaining = ~problem.unit_rows(missing)
    if not np.any(problem.read & remaining):
        return Check(name, float(np.max(np.abs(gains), initial=0.0)), GAIN_TOLERANCE, how)
    error = problem.error_system(gains)
    if not error.spectral_radius < 1:
        return Check(name, np.inf, GAIN_TOLERANCE, how)
    own = problem.restricted(remaining)
    optimal = [kalman_gain(own, t, P) for t, P in enumerate(error.covariances())]
    return Check(name, relative_distance(gains, np.stack(optimal)), GAIN_TOLERANCE, how)


def fused_kalman(plant: FusedPlant) -> FusedFilter:
    """Design the Kalman filter of several sensors.

    Parameters
    ----------
    plant : FusedPlant
        Loop, disturbances and sensors.

    Returns
    -------
    FusedFilter
        Certified design, with a certified fall-back for each set of sensors that may fail.

    Raises
    ------
    DetectabilityError
        If no stable filter exists.
    NumericalError
        If the periodic Riccati equation was not solved.
    CertificateError
        If the design or a fall-back does not pass its checks.
    ProblemError
        If there are more than six sensors and channels.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=80, frame_rate_hz=1000)
    >>> own = lbt.tip_tilt_plant(frame_rate_hz=1000, turbulence=slow, noise_nm=75, modes=1)
    >>> second = lbt.models.WavefrontSensor(name="truth", rate_hz=250, delay_frames=2, noise_nm=4)
    >>> plant = lbt.models.fused_plant(own, lbt.models.SensorSuite(sensors=(second,)))
    >>> design = lbt.design.fused_kalman(plant)
    >>> plant.period, [each.missing for each in design.fallbacks]
    (4, [('wavefront',), ('truth',), ('wavefront', 'truth')])
    >>> design.rms < lbt.kalman(own).rms
    True
    """
    require_instance(plant, FusedPlant, "plant")
    return make_design(plant, kalman_riccati(plant))


def fused_hinf(
    plant: FusedPlant, *, gamma: float | None = None, gamma_ratio: float | None = None
) -> FusedFilter:
    """Design the H-infinity filter of several sensors; its fall-backs are Kalman filters.

    Parameters
    ----------
    plant : FusedPlant
        Loop, disturbances and sensors.
    gamma, gamma_ratio : float, optional
        Bound of the norm of the error over a period, or the bound as a multiple of the least one;
        by default 1.2 times the least.

    Returns
    -------
    FusedFilter
        Certified design.

    Raises
    ------
    InfeasibleError
        If the bound is below the least gamma; the message names the least.
    SynthesisError
        As :func:`fused_kalman`.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=80, frame_rate_hz=1000)
    >>> own = lbt.tip_tilt_plant(frame_rate_hz=1000, turbulence=slow, noise_nm=75, modes=1)
    >>> second = lbt.models.WavefrontSensor(name="truth", rate_hz=250, delay_frames=2, noise_nm=4)
    >>> plant = lbt.models.fused_plant(own, lbt.models.SensorSuite(sensors=(second,)))
    >>> design = lbt.design.fused_hinf(plant, gamma_ratio=1.1)
    >>> design.gamma_least < design.gamma < design.gamma_requested
    True
    """
    level = find_level(plant, gamma, gamma_ratio)
    found = central_filter(plant, level.bound, level.start)
    return make_design(plant, found, **level.claims)


def fused_mixed(
    plant: FusedPlant, *, gamma: float | None = None, gamma_ratio: float | None = None
) -> FusedFilter:
    """Design the filter of several sensors that trades variance for a bound of the norm.

    A central H-infinity filter stays below its level. The level is raised until the norm of the
    error is the bound itself: the variance falls with each step. It is the least among central
    filters, not among all.

    Parameters
    ----------
    plant : FusedPlant
        Loop, disturbances and sensors.
    gamma, gamma_ratio : float, optional
        Bound of the norm of the error over a period, or the bound as a multiple of the least one;
        by default 1.2 times the least.

    Returns
    -------
    FusedFilter
        Certified design; the Kalman filter where that meets the bound.

    Raises
    ------
    InfeasibleError
        If the bound is below the least gamma; the message names the least.
    SynthesisError
        As :func:`fused_kalman`.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=80, frame_rate_hz=1000)
    >>> own = lbt.tip_tilt_plant(frame_rate_hz=1000, turbulence=slow, noise_nm=75, modes=1)
    >>> second = lbt.models.WavefrontSensor(name="truth", rate_hz=250, delay_frames=2, noise_nm=4)
    >>> plant = lbt.models.fused_plant(own, lbt.models.SensorSuite(sensors=(second,)))
    >>> both = lbt.design.fused_mixed(plant, gamma_ratio=1.01)
    >>> both.rms < lbt.design.fused_hinf(plant, gamma_ratio=1.01).rms
    True
    """
    level = find_level(plant, gamma, gamma_ratio)
    if level.kalman <= level.bound:
        return make_design(plant, level.start)

    def excess(decades: float) -> float:
        found = central_filter(plant, level.bound * 10**decades, level.start)
        return float(np.log(error_norm(plant, found) / level.bound)) + _INSIDE

    decades = 0.0
    if excess(0.0) < 0 < excess(_DECADES):
        decades = brentq(excess, 0.0, _DECADES, xtol=1e-9)
    central = level.bound * 10**decades
    return make_design(
        plant,
        central_filter(plant, central, level.start),
        **level.claims,
        gamma_central=central,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Level:
    """A bound of the norm, beside the least one, one that no filter meets, and the Kalman's."""

    bound: float
    least: float
    infeasible: float | None  # that no filter reaches; None where nothing is proved
    start: FilterRiccati  # the Kalman filter
    kalman: float  # its norm

    @property
    def claims(self) -> dict[str, float | None]:
        """What a design of the level says of its norm."""
        return {
            "gamma_requested": self.bound,
            "gamma_least": self.least,
            "gamma_infeasible": self.infeasible,
        }


def find_level(plant: FusedPlant, gamma: float | None, gamma_ratio: float | None) -> Level:
    """Find the least gamma, and check the bound that is given, or make it: 1.2 times the least."""
    require_instance(plant, FusedPlant, "plant")
    gamma, gamma_ratio = checked_bounds(
        gamma, gamma_ratio, far_above="the filter is the Kalman filter"
    )
    start = kalman_riccati(plant)
    norm = error_norm(plant, start)
    _, least, solution = least_gamma(plant, lower=0.0, upper=norm, start=start)
    requested = gamma if gamma is not None else least * (gamma_ratio or 1.2)
    require_reachable(requested, least)
    return Level(
        bound=max(requested, least),
        least=least,
        infeasible=proved_level(plant, start, solution, least) or None,
        start=start,
        kalman=norm,
    )


def proved_level(
    plant: FusedPlant, start: FilterRiccati, solution: FilterRiccati | None, level: float
) -> float:
    """Return what the worst disturbance against a solution's level proves; 0 if there is none."""
    if solution is None:
        return 0.0
    witness = worst_invisible_disturbance(plant, solution.P, level, start.P)
    return infeasible_level(plant, witness, start.P)


def error_norm(plant: FusedPlant, solution: FilterRiccati) -> float:
    """Return the norm of a filter's estimation error over a period."""
    return hinf_norm(plant.error_system(solution.gain_predictor)).upper


def central_filter(plant: FusedPlant, gamma: float, start: FilterRiccati) -> FilterRiccati:
    """Return the central filter of a level; InfeasibleError if there is none."""
    found = gamma_riccati(plant, gamma, start=start)
    if found is None:
        raise InfeasibleError(
            f"the gamma-Riccati equation has no stabilising solution at gamma = {gamma:.9g}. "
            "Try a larger gamma.",
            gamma=gamma,
        )
    return found


def make_design(plant: FusedPlant, solution: FilterRiccati, **claims: Any) -> FusedFilter:
    """Make a design with its fall-backs, and certify it; CertificateError if it fails."""
    design = FusedFilter(
        method=fused_name(claims),
        certificate=UNCERTIFIED,
        solver=SolverReport(
            route="riccati", status=solution.status, iterations=solution.iterations
        ),
        problem=plant,
        gains=stacked_gains(solution),
        fallbacks=make_fallbacks(plant),
        **claims,
    )
    return with_certificate(design, "Scale the states to similar sizes, or leave out a sensor.")


def dwell_frames(
    plant: FusedPlant, gains: FloatArray, fallbacks: tuple[Fallback, ...]
) -> int | None:
    """Return frames that each filter must stay for any sequence of them to be stable.

    Stable filters that take turns need not be stable. Where the plant is its model, the estimation
    error does not depend on the commands; it shrinks in a fixed norm while a filter stays long
    enough, whichever filter came before. The norm weighs the error by the covariance of the
    plant's state, mean over the phases. If a filter shrinks it in any number of periods from m to
    2 m - 1, it does in any more.
    """
    P = plant.error_system(np.zeros_like(gains)).covariances().mean(axis=0)
    root = np.linalg.cholesky(P + _REGULAR * np.diag(np.diag(P)))
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
