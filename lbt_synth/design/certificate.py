"""Claims of a design, and the certificate that checks them, computed from its matrices alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lbt_synth.errors import CertificateError, DimensionError
from lbt_synth.linear import EstimationProblem, StateSpace, hinf_norm
from lbt_synth.linear.infeasibility_proof import Witness, infeasible_level
from lbt_synth.linear.lyapunov import output_variances, stationary_root
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.linear.riccati.filtering import kalman_gain, kalman_riccati
from lbt_synth.loop import ClosedLoop
from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.storage.rows import Column, column, row_table
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import FloatArray, frozen_copy, set_fields

TOLERANCE = 1e-6  # relative, of norms, variances and gains: what two routes differ by at most
ORIGIN_TOLERANCE = 1e-5  # of a filter from that of its equation, and of a bound that is reached
RESIDUAL_TOLERANCE = 1e-8  # of a Lyapunov equation
INFEASIBLE_TOLERANCE = 1e-9  # of a level beside what is proved of it
LEVEL_SETS = "level sets on the symplectic pencil"
_GRID = 513  # frequencies from 0 to the Nyquist frequency
_NOTHING = 1e-14  # part of a system's size that counts as rounding
_TINY = 1e-300  # keeps a quotient finite where the denominator is zero


@dataclass(frozen=True, slots=True)
class Check:
    """One check: passed when ``value < limit``.

    Attributes
    ----------
    name : str
        What was checked.
    value, limit : float
        What was computed, and what it must stay below.
    computed_by : str
        How the value was computed.
    passed : bool
        Whether the value is below its limit; NaN is not.
    """

    name: str = column("check")
    value: float = column("value")
    limit: float = column("limit")
    computed_by: str = column("computed by")
    passed: bool = column("passed", init=False)

    def __post_init__(self) -> None:
        set_fields(self, passed=bool(self.value < self.limit))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Certificate(Summarised):
    """Evidence that a design is what it says, computed from its matrices alone.

    Attributes
    ----------
    checks : tuple of Check
        All checks; a design leaves the library only if each one passed.
    gamma : float
        H-infinity norm of the estimation error, recomputed (nan for an integrator).
    rms_per_output : (l,) ndarray
        Standard deviation of each estimated signal's error, by a Lyapunov
        equation (empty for an integrator).
    """

    checks: tuple[Check, ...]
    gamma: float
    rms_per_output: FloatArray

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def _brief(self) -> str:
        failed = [check.name for check in self.checks if not check.passed]
        if failed:
            return f"failed: {', '.join(failed)}"
        return f"{len(self.checks)} of {len(self.checks)} checks passed"

    def _summarise(self) -> Summary:
        return Summary(tables=[row_table("Certificate", self.checks)] if self.checks else [])

    @property
    def rms(self) -> float:
        """Root of the summed variances of the estimation error."""
        return float(np.sqrt(np.sum(self.rms_per_output**2)))

    def require(self, hint: str = "") -> Certificate:
        """Return the certificate itself; raise CertificateError with what failed, and a hint."""
        failed = [check for check in self.checks if not check.passed]
        if failed:
            listing = "; ".join(f"{c.name} {c.value:.12g}, limit {c.limit:.12g}" for c in failed)
            raise CertificateError(
                f"the design failed its certificate and is not returned: {listing}. {hint}".strip(),
                failed=tuple(check.name for check in failed),
            )
        return self


def certify_filter(
    problem: EstimationProblem, gain_predictor: FloatArray, *, least_variance: bool = False
) -> Certificate:
    """Check a predictor gain (n, q) against its problem, and that its variance is the least.

    That holds if the covariance of the Lyapunov equation reproduces the gain.
    """
    error, period = problem.error_system(gain_predictor), problem.period
    name = "spectral radius of the filter" + " over a period" * (period > 1)
    whole = error if period == 1 else error.lifted_compactly()
    certificate, P = _examine_error(whole, name)
    if P is None:
        return certificate
    checks = list(certificate.checks)
    if least_variance:
        covariances = P[None] if period == 1 else error.covariances()
        distance = variance_distance(problem, gain_predictor, covariances)
        how = "gain recomputed from the Lyapunov covariance"
        checks.append(Check("distance from the least-variance gain", distance, TOLERANCE, how))
    powers = certificate.rms_per_output.reshape(period, -1) ** 2  # of all phases, one by one
    rms = frozen_copy(np.sqrt(powers.mean(axis=0)))
    return replace(certificate, checks=tuple(checks), rms_per_output=rms)


def variance_distance(
    problem: EstimationProblem, gain_predictor: FloatArray, covariances: FloatArray
) -> float:
    """Return how far gains are from those that error covariances (N, n, n) make, relative."""
    optimal = np.stack([kalman_gain(problem, t, P) for t, P in enumerate(covariances)])
    gains = np.reshape(gain_predictor, optimal.shape)
    size = float(np.max(np.linalg.norm(optimal, 2, axis=(1, 2))))
    apart = float(np.max(np.linalg.norm(gains - optimal, 2, axis=(1, 2))))
    return apart / size if size > 0 else apart


def certify_error(
    error: StateSpace, *, stability: str = "spectral radius of the filter"
) -> Certificate:
    """Certify a system from disturbance to error; ``stability`` names the first check."""
    return _examine_error(error, stability)[0]


def _examine_error(error: StateSpace, stability: str) -> tuple[Certificate, FloatArray | None]:
    """Return the certificate of an error, with its covariance if it is stable."""
    stable = _radius_check(stability, error.spectral_radius)
    if not stable.passed:
        infinite = frozen_copy(np.full(len(error.C), np.inf))
        return Certificate(checks=(stable,), gamma=np.inf, rms_per_output=infinite), None
    P, variances, checks = _examine_variance(error)
    norm = hinf_norm(error)
    grid = np.linspace(0, 0.5 / error.dt_s, _GRID)
    highest = float(np.max(spectral_norms(error.frequency_response(grid))))
    above = (highest - _rounding(error)) / max(norm.upper, _TINY) - 1
    how = f"{_GRID} frequencies against level sets"
    peak = Check("singular values above the norm", above, TOLERANCE, how)
    rms = frozen_copy(np.sqrt(np.maximum(variances, 0)))
    certificate = Certificate(checks=(stable, *checks, peak), gamma=norm.value, rms_per_output=rms)
    return certificate, P


def _examine_variance(error: StateSpace) -> tuple[FloatArray, FloatArray, tuple[Check, ...]]:
    """Return covariance and variances of an error driven by white noise, with their checks."""
    A, B, C, D = error.A, error.B, error.C, error.D
    root = stationary_root(A, B)  # by which variances are sums of squares: nothing cancels
    variances = output_variances(C, D, root)
    adjoint = output_variances(B.T, D.T, stationary_root(A.T, C.T))
    P, after = root @ root.T, np.hstack([A @ root, B])
    residual = float(np.linalg.norm(after @ after.T - P, 1))
    size = float(2 * np.linalg.norm(P, 1) + np.linalg.norm(B @ B.T, 1))
    rms, other = float(np.sqrt(variances.sum())), float(np.sqrt(adjoint.sum()))
    least = min(rms, other) + _rounding(error)
    apart = 1 - min(least / max(rms, other, _TINY), 1.0) ** 2
    name, relative = "residual of the Lyapunov equation", residual / max(size, _TINY)
    solved = Check(name, relative, RESIDUAL_TOLERANCE, "relative, 1-norm")
    name, how = "variance, against its adjoint equation", "relative, two Lyapunov equations"
    return P, variances, (solved, Check(name, apart, TOLERANCE, how))


def _rounding(error: StateSpace) -> float:
    """Size of an error that is nothing but rounding."""
    through = np.linalg.norm(error.B) * np.linalg.norm(error.C) + np.linalg.norm(error.D)
    return max(float(_NOTHING * through), _TINY)


def proved_level(problem: EstimationProblem, witness: Witness | None) -> float:
    """Return a level of gamma that a witness proves no filter to reach; 0 without one.

    The covariance of the Kalman filter, by the Riccati equation, enters in two places only: it
    weighs what rounding took from the proof, and it spans the space of the estimation error.
    """
    if witness is None:
        return 0.0
    x, w, sizes = witness.states, witness.disturbances, problem.B.shape[-2:]
    if (x.shape[-2], w.shape[-2]) != sizes:
        raise DimensionError(
            f"a witness must have {sizes[0]} rows of states, {sizes[1]} rows of "
            f"disturbances and as many columns in both; got {x.shape} and {w.shape}."
        )
    return infeasible_level(problem, witness, kalman_riccati(problem).P)


def certify_infeasible(problem: EstimationProblem, level: float, witness: Witness | None) -> Check:
    """Check that a witness proves a level, to a relative 1e-9; a level of 0 claims nothing."""
    above = level / max(proved_level(problem, witness), _TINY) - 1
    name = "infeasible level over the level proved, less 1"
    return Check(name, above, INFEASIBLE_TOLERANCE, "disturbances that no measurement shows")


def stability_check(name: str, loop: ClosedLoop) -> Check:
    """Check the largest modulus of a loop's poles, per frame."""
    return _radius_check(name, loop.radius_per_frame)


def _radius_check(name: str, radius: float) -> Check:
    return Check(name, radius, 1 - STABILITY_MARGIN, "eigenvalues")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """What is computed of a design from its matrices alone, once for all its claims."""

    design: Any
    certificate: Certificate  # checks that rest on no claim, stability first; norms of the error
    kalman: Any = None  # the Kalman filter of a filter's problem


def _made_of_it(evidence: Evidence, value: Any) -> Iterable[Check]:
    """Check nothing more: the controller is made of the value, and a file is compared with it."""
    return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim(Column):
    """A number, or one per mode, that a design says of itself: how it is printed and checked."""

    # from the evidence and the value claimed to the checks of it
    checks: Callable[[Evidence, Any], Iterable[Check]] = _made_of_it


def measured_claim(name: str, heading: str) -> Claim:
    """Return the claim of a number of the certificate, which is computed again [nm]."""

    def checks(evidence: Evidence, value: float) -> Iterable[Check]:
        measured = getattr(evidence.certificate, name)
        apart = abs(measured / value - 1) if value > 0 else measured
        yield Check(f"{heading}, against the one claimed", apart, TOLERANCE, "relative")

    return Claim(name=name, heading=heading, unit="nm", checks=checks)


def say_checks(checks: Sequence[Check]) -> str:
    """Return how many checks of a certificate passed, in a sentence."""
    passed = sum(check.passed for check in checks)
    failed = "" if passed == len(checks) else f"; {len(checks) - passed} FAILED"
    return f"{passed} of {len(checks)} checks passed{failed}."
