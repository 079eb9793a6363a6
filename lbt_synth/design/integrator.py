"""The classical integrator, its gain limit and its best gains (paper, III-C, erratum 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.polynomial.chebyshev import Chebyshev, chebpts2
from scipy.optimize import brentq

from lbt_synth.design.certificate import LEVEL_SETS, TOLERANCE, Check, Claim, Evidence
from lbt_synth.design.result import Design, SolverReport, with_certificate
from lbt_synth.errors import InfeasibleError, ProblemError
from lbt_synth.linear import Controller, hinf_norm
from lbt_synth.loop import ClosedLoop, close_loop, stable_sensor_gains
from lbt_synth.loop.budget import ensemble_residuals
from lbt_synth.loop.ensemble import LoopEnsemble, ensemble_vibration
from lbt_synth.loop.evaluator import textbook_matrices
from lbt_synth.loop.margins import phase_margin_deg
from lbt_synth.models import LoopHardware, TipTiltPlant, Truth
from lbt_synth.models.loop_hardware import BLIND
from lbt_synth.models.vibration import stationary_vibrations
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    Positive,
    check_fields,
    frozen_copy,
    number,
    require_instance,
)

TRIED_GAINS = 1e-4, 0.999  # range of gains that are tried, as fractions of the limit
# A line far above the bandwidth leaves one minimum with its amplification and one without: the
# trials are as close as these where the loop is fast.
_TRIALS = np.concatenate([np.geomspace(TRIED_GAINS[0], 0.1, 12), np.linspace(0.1, 0.999, 46)[1:]])
_NODES = chebpts2(12)  # of the last search, in an interval from -1 to 1
_CONVERGED = 1e-8  # last coefficients of a polynomial, over the range of its values
_ROUNDS = 12
_SPARE = 1e-9  # of a margin that is demanded, for the rounding of the gain that just keeps it
_LEAST_GAIN = 1e-3  # as a part of that of a usual loop: two integrators are stable there or never


@dataclass(frozen=True, slots=True, kw_only=True)
class IntegratorLaw:
    """The control law ``gain (1 - c z^-1) / (1 - leak z^-1)^integrators``, and its demands.

    Without a zero, ``c = 0``; else ``c = exp(-2 pi zero_hz / frame_rate)``. The defaults are the
    pure integrator. One integrator with a zero is a PI controller of proportional gain
    ``c gain`` and integral gain ``(1 - c) gain``. Two integrators with a zero are an integrator
    with a lag compensator: below the zero the loop gain falls with the square of the frequency.

    Parameters
    ----------
    leak : float, optional
        Part of a command that is left after a frame, the pole of each integrator; 1 keeps all.
    integrators : int, optional
        Number of integrators, 1 or 2.
    zero_hz : float, optional
        Corner frequency of the zero [Hz].
    phase_margin_deg : float, optional
        Least phase margin of the loop [deg].
    modulus_margin : float, optional
        Least modulus margin of the loop.

    Raises
    ------
    ProblemError
        If a value is out of range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> law = lbt.design.IntegratorLaw(leak=0.99, phase_margin_deg=45)
    >>> round(lbt.integrator(path, law=law).gain, 3)
    0.527
    """

    leak: Annotated[float, ("above", 0), ("at_most", 1)] = 1.0
    integrators: Annotated[int, ("at_least", 1), ("at_most", 2)] = 1
    zero_hz: Positive | None = None
    phase_margin_deg: Annotated[float, ("above", 0), ("below", 180)] | None = None
    modulus_margin: Annotated[float, ("above", 0), ("below", 1)] | None = None

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def demands(self) -> dict[str, float]:
        """The margins that are demanded, by the name of their field."""
        named = {name: getattr(self, name) for name in ("phase_margin_deg", "modulus_margin")}
        return {name: least for name, least in named.items() if least is not None}

    def changes(self) -> dict[str, Any]:
        """Return the fields that are not those of the pure integrator."""
        usual = asdict(IntegratorLaw())
        return {name: value for name, value in asdict(self).items() if value != usual[name]}

    def controller(self, hardware: LoopHardware, gain: float) -> Controller:
        """Return the controller of a gain.

        Raises
        ------
        ProblemError
            If the zero is not below half the frame rate.
        """
        nyquist_hz = hardware.frame_rate_hz / 2
        if self.zero_hz is not None and not self.zero_hz < nyquist_hz:
            raise ProblemError(
                f"zero_hz must be below half the frame rate, {nyquist_hz:g} Hz; "
                f"got {self.zero_hz:g}."
            )
        c = 0.0 if self.zero_hz is None else float(np.exp(-np.pi * self.zero_hz / nyquist_hz))
        response = hardware.sensor @ hardware.influence
        a, reconstructor = self.leak, np.linalg.pinv(response, rcond=BLIND)
        D = 0.0
        if self.integrators == 1:  # c may be above the leak: the zero is then a lead
            A, B, C, D = [[a]], [[1.0]], [[1 - c / a]], c / a
        else:
            A, B, C = [[a, 0.0], [a - c, a]], [[1.0], [1.0]], [[0.0, 1.0]]
        commands = kept = np.eye(len(reconstructor))
        if a == 1 and np.linalg.matrix_rank(response, rtol=BLIND) < len(kept):
            kept = reconstructor @ response  # without a leak, what no measurement sees would stay
        return Controller(
            A=frozen_copy(np.kron(A, kept)),
            B=frozen_copy(np.kron(B, gain * reconstructor)),
            C=frozen_copy(np.kron(C, commands)),
            D=frozen_copy(D * gain * reconstructor),
            dt_s=hardware.dt_s,
        )

    def margins(self, loop: ClosedLoop) -> dict[str, float]:
        """Return the margins of a stable loop that are demanded, by the names of the demands."""
        found = {}
        if self.phase_margin_deg is not None:
            found["phase_margin_deg"] = phase_margin_deg(loop)
        if self.modulus_margin is not None:
            found["modulus_margin"] = 1 / hinf_norm(loop.path("noise", "reading")).upper
        return found


PURE = IntegratorLaw()


def _margin_claim(name: str, margin: str, unit: str, how: str) -> Claim:
    """Return the claim of a margin that the loop keeps."""

    def checks(evidence: Evidence, demanded: float) -> Iterator[Check]:
        design = evidence.design
        achieved = design.law.margins(close_loop(design.hardware, design.controller))[name]
        label = f"{margin} demanded over achieved, less 1"
        yield Check(label, demanded / achieved - 1, TOLERANCE, how)

    return Claim(name=name, heading=f"{margin} demanded", unit=unit, checks=checks)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IntegratorDesign(Design):
    """The classical controller ``u(k) = u(k-1) + gain R y(k)``, or one of another law.

    It claims its gain, what its law changes, and the margins that it keeps.
    """

    CLAIMS: ClassVar[tuple[Claim, ...]] = (
        Claim(name="gain", heading="gain"),
        Claim(name="leak", heading="left of a command after a frame"),
        Claim(name="integrators", heading="integrators"),
        Claim(name="zero_hz", heading="corner of the zero", unit="Hz"),
        _margin_claim("phase_margin_deg", "phase margin", "deg", "each measurement broken in turn"),
        _margin_claim("modulus_margin", "modulus margin", "", LEVEL_SETS),
    )

    problem: LoopHardware

    @property
    def gain(self) -> float:
        """Integrator gain, per unit of sensor gain."""
        return float(self.claims["gain"])

    @property
    def law(self) -> IntegratorLaw:
        """Leak, zero, second integrator, and the margins to keep."""
        changes = {name: value for name, value in self.claims.items() if name != "gain"}
        return IntegratorLaw(**changes)

    @property
    def integrator_gain(self) -> float | None:
        """The gain, if there is neither leak nor zero nor a second integrator."""
        is_pure = self.claims.keys().isdisjoint(("leak", "integrators", "zero_hz"))
        return self.gain if is_pure else None

    def make_controller(self) -> Controller:
        """Return the controller of the law and its gain."""
        return self.law.controller(self.problem, self.gain)

    @property
    def poles(self) -> ComplexArray:
        """Poles of the closed loop."""
        return close_loop(self.problem, self.controller).system.poles


def integrator(
    hardware: LoopHardware,
    *,
    gain: float | None = None,
    truth: Truth | TipTiltPlant | None = None,
    law: IntegratorLaw = PURE,
) -> IntegratorDesign:
    """Integrator ``u(k) = u(k-1) + gain R y(k)``, or one of another law.

    R is the pseudoinverse of sensor times influence matrix; what no reading sees stays zero. The
    gain is given, leaves the least residual for a truth, or is the largest that keeps the margins.

    Parameters
    ----------
    hardware : LoopHardware
        The loop.
    gain : float, optional
        Gain, above 0 and below :func:`integrator_gain_limit`.
    truth : Truth or TipTiltPlant, optional
        Disturbances, noise and sensor gain for which the residual is least; or the plant whose
        model is the truth.
    law : IntegratorLaw, optional
        Leak, zero and second integrator, and margins to keep at unit sensor gain; by default a
        pure integrator without a demand.

    Returns
    -------
    IntegratorDesign
        Certified design. The best gain is within a relative 1e-6 of the best among those from 1e-4
        to 0.999 of the largest stable one at unit sensor gain that keep the margins;
        ``solver.status`` says when an end of that range, not the truth, decided.

    Raises
    ------
    ProblemError
        If the gain is not a positive number, there is both a gain and a truth, or neither nor a
        demand, or nothing disturbs the loop.
    InfeasibleError
        If no gain keeps the margins that are demanded.
    CertificateError
        If at unit sensor gain the loop is not stable, or does not keep these margins.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> bool(max(abs(lbt.integrator(path, gain=0.25).poles)) < 1)
    True
    >>> half = lbt.design.IntegratorLaw(modulus_margin=0.5)
    >>> round(lbt.integrator(path, law=half).gain, 3)
    0.454
    >>> slow = lbt.models.ARModel(coefficients=[0.999], driving_rms_nm=10.0, frame_rate_hz=800)
    >>> 0.2 < lbt.integrator(path, truth=lbt.Truth(turbulence=slow, noise_nm=20.0)).gain < 0.6
    True
    """
    require_instance(hardware, LoopHardware, "hardware")
    if gain is not None and truth is not None:
        raise ProblemError("give an integrator a gain or a truth; got both.")
    if gain is not None:
        chosen = number(gain, "gain", above=0)
        return _design_with_gain(hardware, chosen, law, route="closed form", status="given")
    if truth is not None:
        return _least_residual(hardware, law, truth)
    if not law.demands:
        raise ProblemError(
            "an integrator needs a gain, a truth or a demand; got none. Try gain=0.3, or "
            "law=IntegratorLaw(phase_margin_deg=45)."
        )
    allowed = _allowed_gains(hardware, law, _TRIALS * integrator_gain_limit(hardware, law))
    most = float(np.exp(allowed[-1]))
    return _design_with_gain(hardware, most, law, route="search", status="largest gain")


def _design_with_gain(
    hardware: LoopHardware, gain: float, law: IntegratorLaw, *, route: str, status: str
) -> IntegratorDesign:
    """Make the design of a gain and certify it."""
    design = IntegratorDesign(
        method="integrator",
        solver=SolverReport(route=route, status=status),
        problem=hardware,
        claims={"gain": gain, **law.changes()},
    )
    return with_certificate(design, f"Lower the gain {gain:.6g}.")


def integrator_gain_limit(hardware: LoopHardware, law: IntegratorLaw = PURE) -> float:
    """Gain at which the loop of a law becomes unstable, with the dynamics of the mirror.

    It is ``2 sin(pi / (2 (2 d - 1)))`` for an integrator and a whole delay of d frames.

    Parameters
    ----------
    hardware : LoopHardware
        Delay, mirror and frame rate; its matrices play no part.
    law : IntegratorLaw, optional
        Leak, zero and second integrator; by default a pure integrator.

    Returns
    -------
    float
        The limit.

    Raises
    ------
    InfeasibleError
        If no gain of two integrators is stable.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> paths = [lbt.LoopHardware(frame_rate_hz=800, delay_frames=d) for d in (2, 3, 4)]
    >>> [round(lbt.design.integrator_gain_limit(path), 3) for path in paths]
    [1.0, 0.618, 0.445]
    """
    single = require_instance(hardware, LoopHardware, "hardware").single_mode()
    taps = single.mirror_taps
    mean_delay_frames = 1 + float(np.abs(np.arange(taps.size) @ taps))
    gain = least = 0.5 / mean_delay_frames
    while not close_loop(single, law.controller(single, gain)).is_stable:
        gain /= 2
        if gain < _LEAST_GAIN * least:
            # two integrators are stable at small gains where c / (1 - c) + 1 exceeds the delay
            ratio = mean_delay_frames / (mean_delay_frames - 1)
            highest = hardware.frame_rate_hz * np.log(ratio) / (2 * np.pi)
            raise InfeasibleError(
                f"no gain of two integrators is stable at a delay of {mean_delay_frames:.3g} "
                f"frames without a zero_hz below {highest:.3g}; "
                f"got {'none' if law.zero_hz is None else f'{law.zero_hz:g}'}."
            )
    return gain * stable_sensor_gains(single, law.controller(single, gain))[1]


def _allowed_gains(hardware: LoopHardware, law: IntegratorLaw, trials: FloatArray) -> FloatArray:
    """Return logarithms of the largest gains that keep a law's demands: trials and both ends."""

    def excess(log_gain: float) -> float:
        """Return the least margin over its demand, less 1 and what rounding may take."""
        loop = close_loop(hardware, law.controller(hardware, float(np.exp(log_gain))))
        if not loop.is_stable:
            return -1.0
        return (
            min(found / law.demands[name] for name, found in law.margins(loop).items()) - 1 - _SPARE
        )

    tried = np.log(trials)
    over = np.array([excess(trial) for trial in tried])
    kept = np.flatnonzero(over >= 0)
    if not kept.size:
        best = int(np.argmax(over))
        demands = " and ".join(f"{name} {least:g}" for name, least in law.demands.items())
        raise InfeasibleError(
            f"no gain keeps {demands}; the nearest is gain {trials[best]:.3g}, which has "
            f"{100 * (1 + over[best]):.3g} % of the margin. Demand less."
        )
    last = int(kept[-1])
    outside = np.flatnonzero(over[:last] < 0)
    first = int(outside[-1]) + 1 if outside.size else 0
    sides = [(tried[first - 1], tried[first])] if first > 0 else []
    sides += [(tried[last], tried[last + 1])] if last + 1 < tried.size else []
    ends = [brentq(excess, *side, xtol=_SPARE / 100) for side in sides]
    return np.unique(np.concatenate([tried[first : last + 1], ends]))


def _residuals_by_gain(
    hardware: LoopHardware, law: IntegratorLaw, truth: Truth | TipTiltPlant
) -> Callable[[FloatArray], FloatArray]:
    """Return what loops leave in the image [nm^2] by their gains (k,), nan if unstable."""
    if isinstance(truth, TipTiltPlant):
        ensemble = LoopEnsemble(
            turbulence=truth.turbulence,
            vibrations=tuple(map(ensemble_vibration, truth.vibrations)),
            noise_factor=truth.own_noise_factor,
            of_means=True,
        )
    else:
        require_instance(truth, Truth, "truth")
        noise_nm = truth.noise_per_measurement(hardware.n_measurements)
        groups = truth.turbulence_groups(hardware.modes)
        if not groups and not truth.vibrations and not np.any(noise_nm):
            raise ProblemError(
                "the truth must disturb the loop; got no turbulence, vibration or noise."
            )
        ensemble = LoopEnsemble(
            sensor_gain=truth.sensor_gain,
            turbulence=truth.turbulence_per_mode(hardware.modes),
            noise_nm=noise_nm[None],
            vibrations=tuple(map(ensemble_vibration, stationary_vibrations(truth.vibrations))),
        )
    A, B, C, D = textbook_matrices([law.controller(hardware, 1.0)])

    def variances(gains: FloatArray) -> FloatArray:
        scale, one = gains[:, None, None], np.ones((gains.size, 1, 1))
        loops = one * A, scale * B, one * C, scale * D  # a gain scales the input
        budget = ensemble_residuals(loops, hardware, replace(ensemble, loops=gains.size))
        return np.asarray(budget.rms_nm**2)

    return variances


def _least_residual(
    hardware: LoopHardware, law: IntegratorLaw, truth: Truth | TipTiltPlant
) -> IntegratorDesign:
    """Refine each local minimum of the residual over the gain, and take the least."""
    variances = _residuals_by_gain(hardware, law, truth)
    sensor_gain = truth.sensor_gain if isinstance(truth, Truth) else 1.0
    gains = _TRIALS * integrator_gain_limit(hardware, law) / max(1.0, sensor_gain)
    trials = _allowed_gains(hardware, law, gains) if law.demands else np.log(gains)

    def left(log_gains: FloatArray) -> FloatArray:
        return np.nan_to_num(variances(np.exp(log_gains)), nan=np.inf, posinf=np.inf)

    walls = np.concatenate([[np.inf], left(trials), [np.inf]])
    low = np.flatnonzero((walls[1:-1] < walls[:-2]) & (walls[1:-1] <= walls[2:])).tolist()
    pairs = [[max(i - 1, 0), min(i + 1, trials.size - 1)] for i in low]
    refined = [_least_between(left, *trials[pair].tolist()) for pair in pairs]
    best = int(np.argmin([value for _, value in refined]))
    limit = "the margin demanded" if law.demands else "stability at unit sensor gain"
    ends = {trials.size - 1: f"limited by {limit}"}
    if not law.demands:
        ends[0] = "limited by the least gain tried: a loop that hardly acts leaves least"
    gain, status = float(np.exp(refined[best][0])), ends.get(low[best], "least residual")
    return _design_with_gain(hardware, gain, law, route="search", status=status)


def _least_between(
    values: Callable[[FloatArray], FloatArray], low: float, high: float
) -> tuple[float, float]:
    """Return where values are least between two points, and the value, by Chebyshev polynomials."""
    for _ in range(_ROUNDS):
        points = (low + high) / 2 + (high - low) / 2 * _NODES
        there = values(points)
        best = int(np.argmin(there))
        low, high = points[max(best - 1, 0)], points[min(best + 1, _NODES.size - 1)]
        if not np.isfinite(there).all():  # beside an unstable gain
            continue
        polynomial = Chebyshev.fit(points, there, _NODES.size - 1)
        if np.max(np.abs(polynomial.coef[-2:])) <= _CONVERGED * np.ptp(there):
            roots = polynomial.deriv().roots()
            vertices = [x for x in roots[np.isreal(roots)].real.tolist() if low < x < high]
            where = min(vertices, key=polynomial, default=float(points[best]))
            return where, float(polynomial(where))
    return float(points[best]), float(there[best])
