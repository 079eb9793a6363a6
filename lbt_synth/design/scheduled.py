"""A filter that follows the sensor gain: one per value on a grid, interpolated, with a proof.

The filters run as estimators that are given the applied commands
(:func:`~lbt_synth.linear.estimator_form`), with measurements in units of the phase: ``y / g``. In
this form everything is affine in the gain of the filter, and so is the interpolation between two
gains g of the grid. If the known gain is the real one, the estimation error does not depend on the
commands. If it is not, they are coupled, and the proof covers that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.certificate import Certificate, Check
from lbt_synth.design.kalman import kalman
from lbt_synth.design.result import UNCERTIFIED, FilterDesign
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, EstimatorForm, RunningEstimator, estimator_form
from lbt_synth.linear.moving_parameter.family import ParameterFamily
from lbt_synth.linear.moving_parameter.stability_proof import prove_rate
from lbt_synth.loop.closed_loop import checked_loop_matrices
from lbt_synth.loop.moving_gain import RATE_PER_S
from lbt_synth.models import LoopHardware, TipTiltPlant
from lbt_synth.models.plant.tip_tilt import assemble
from lbt_synth.validation import FloatArray, frozen_copy, number, positive, require_instance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScheduledFilter:
    """Filters for several sensor gains, interpolated; made by :func:`scheduled_filter`.

    Attributes
    ----------
    gains : (k,) ndarray
        Sensor gains of the filters, increasing, relative to the sensor matrix of the loop.
    forms : tuple of EstimatorForm
        The filter of each.
    hardware : LoopHardware
        The loop.
    rate_per_s : float
        Fastest change of the known gain that is proved [1/s].
    gain_error : float
        Largest modulus of the real gain over the known one, less 1, that is proved; it may change
        at any speed.
    certificate : Certificate
        The proof.
    """

    gains: FloatArray
    forms: tuple[EstimatorForm, ...]
    hardware: LoopHardware
    rate_per_s: float
    gain_error: float
    certificate: Certificate

    def form_at(self, gain: float) -> EstimatorForm:
        """Return the filter for a sensor gain; beyond the grid, that of its end."""
        g = min(max(gain, float(self.gains[0])), float(self.gains[-1]))
        i = min(int(np.searchsorted(self.gains, g, "right")) - 1, len(self.gains) - 2)
        share = (g - self.gains[i]) / (self.gains[i + 1] - self.gains[i])
        left, right = self.forms[i], self.forms[i + 1]

        def between(a: FloatArray, b: FloatArray) -> FloatArray:
            return np.asarray((1 - share) * a + share * b)

        return replace(
            left,
            A=between(left.A, right.A),
            B=between(self.gains[i] * left.B, self.gains[i + 1] * right.B) / g,
            applied=between(left.applied, right.applied),
        )

    def controller_at(self, gain: float) -> Controller:
        """Return the controller for a sensor gain that stays what it is."""
        form = self.form_at(gain)
        return Controller(
            A=form.A + form.applied @ form.C,
            B=form.B,
            C=form.C,
            D=np.zeros((len(form.C), form.B.shape[1])),
            dt_s=form.dt_s,
            applied=form.applied,
        )

    def start(self, known_gains: ArrayLike) -> RunningSchedule:
        """Return a running copy, given the known gain of each frame; the last one is kept."""
        known = np.atleast_1d(positive(known_gains, "known_gains"))
        return RunningSchedule(self.form_at(float(known[0])), self, known)

    def recertify(self) -> Certificate:
        """Prove again that the loop is stable while the known gain and its error move."""
        errors = [-self.gain_error, self.gain_error] if self.gain_error else [0.0]
        loops = [checked_loop_matrices(self.hardware, self.controller_at(g)) for g in self.gains]
        pairs = list(zip(self.gains, loops, strict=True))
        matrices = [[A0 + g * (1 + e) * A1 for g, (A0, A1, *_) in pairs] for e in errors]
        family = ParameterFamily(knots=self.gains, matrices=np.array(matrices))
        low, high = (float(end) for end in self.gains[[0, -1]])
        rate = self.rate_per_s * self.hardware.dt_s
        proof = prove_rate(family, rate=rate, nominal=(low + high) / 2)
        proved = 0.0 if proof is None else (proof.high - proof.low) / (high - low)
        found = "nothing" if proof is None else f"{proof.low:.4g} to {proof.high:.4g}"
        name = f"interval of the scheduled gain that is not proved (proved {found})"
        check = Check(name, 1 - proved, 1e-9, "Lyapunov function of the gain")
        return replace(UNCERTIFIED, checks=(check,))


@dataclass(slots=True, eq=False)
class RunningSchedule(RunningEstimator):
    """A scheduled filter with its state: call ``step(y, applied) -> u`` once per frame."""

    schedule: ScheduledFilter
    known_gains: FloatArray
    frame: int = 0

    def reset(self) -> None:
        """Set the state to zero, and return to the first frame."""
        RunningEstimator.reset(self)
        self.frame = 0

    def step(self, y: ArrayLike, applied: ArrayLike | None = None) -> FloatArray:
        """Take y(k), (q,), and the command applied in the last frame, (m,); return u(k), (m,)."""
        known = self.known_gains[min(self.frame, len(self.known_gains) - 1)]
        self.estimator = self.schedule.form_at(float(known))
        self.frame += 1
        return RunningEstimator.step(self, y, applied)


def scheduled_filter(
    plant: TipTiltPlant,
    *,
    gains: ArrayLike,
    design: Callable[[TipTiltPlant], FilterDesign] = kalman,
    rate_per_s: float = RATE_PER_S,
    gain_error: float = 0.05,
) -> ScheduledFilter:
    """Design a filter for each of some sensor gains, and interpolate between them.

    Parameters
    ----------
    plant : TipTiltPlant
        The plant; its sensor matrix is that of sensor gain 1.
    gains : (k,) array_like
        Two or more sensor gains, increasing. The interpolated filter is for those in between.
    design : callable, optional
        Designs the filter of a plant; Kalman's by default.
    rate_per_s : float, optional
        Fastest change of the known gain, which the filter is given [1/s].
    gain_error : float, optional
        Largest modulus of the real gain over the known one, less 1; it may change at any speed.

    Returns
    -------
    ScheduledFilter
        The filters, with a proof that the loop is stable for every course of the gain.

    Raises
    ------
    ProblemError
        If there are fewer than two gains, they do not increase, or the filters differ in size.
    CertificateError
        If the loop cannot be proved; the message says for which gains it can.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=15.5, modes=1)
    >>> follower = lbt.design.scheduled_filter(plant, gains=[0.35, 0.5, 0.8])
    >>> follower.certificate.passed
    True
    >>> course = np.linspace(0.35, 0.8, 2000)
    >>> calm = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    >>> run = lbt.simulate(
    ...     follower.start(course),
    ...     calm,
    ...     hardware=plant.hardware,
    ...     frames=2000,
    ...     settle_frames=0,
    ...     sensor_gains=course,
    ... )
    >>> bool(run.rms_nm[0] < 200)
    True
    """
    require_instance(plant, TipTiltPlant, "plant")
    grid = positive(gains, "gains")
    if grid.ndim != 1 or grid.size < 2 or not np.all(np.diff(grid) > 0):
        raise ProblemError(f"gains must be two or more increasing sensor gains; got {gains!r}.")
    parts, hardware = plant.parts(), plant.hardware
    sensors = [replace(hardware, sensor_matrix=g * hardware.sensor) for g in grid]
    forms = tuple(
        estimator_form(design(assemble(replace(parts, hardware=sensor)))) for sensor in sensors
    )
    if any(form.A.shape != forms[0].A.shape or np.any(form.C != forms[0].C) for form in forms):
        raise ProblemError(
            "filters can be interpolated if their states mean the same; these have "
            f"{sorted({len(form.A) for form in forms})} states, or other outputs."
        )
    schedule = ScheduledFilter(
        gains=frozen_copy(grid),
        forms=forms,
        hardware=hardware,
        rate_per_s=number(rate_per_s, "rate_per_s", above=0),
        gain_error=number(gain_error, "gain_error", at_least=0, below=1),
        certificate=UNCERTIFIED,
    )
    hint = "Try more gains, a slower rate, or a smaller gain_error."
    return replace(schedule, certificate=schedule.recertify().require(hint))
