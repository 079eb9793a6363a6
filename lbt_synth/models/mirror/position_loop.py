"""The local position loop of an adaptive secondary mirror, for one mode of its thin shell.

The shell floats on a film of air in front of voice coils and capacitive sensors; each
position is held by a sampled proportional-derivative feedback and a feed-forward force
proportional to the commanded position (A. Riccardi et al., "Adaptive secondary mirrors for
the Large Binocular Telescope", Proc. SPIE 5169, 721 (2003), doi:10.1117/12.511374; Agapito
et al. 2008, section II). This is one mode, with force over modal mass as an acceleration,
and exact sampling by matrix exponentials.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from scipy.linalg import expm

from lbt_synth.errors import ProblemError
from lbt_synth.linear import StateSpace
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.validation import (
    Count,
    FloatArray,
    NotNegative,
    Positive,
    check_fields,
    frozen_copy,
    number,
)

_STABLE = 1 - 1e-9
_MOST_SAMPLES = 500_000
_POINTS = 8  # of a step response per sample


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepResponse:
    """Position of a mirror after a unit step of its command."""

    time_s: FloatArray  # (t,): time since the command arrived [s]
    position: FloatArray  # (t,): position over its final value
    tolerance: float  # half width of the band around 1 in which the mirror counts as settled
    overshoot: float  # largest position less 1; 0 if it stays below
    settling_s: float  # time after which the position stays within the band [s]


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionLoop:
    """One mode of an adaptive secondary mirror in its local position loop.

    With position x, command r and the samples i of the local loop::

        x'' + 2 damping w x' + w^2 x = a,      w = 2 pi natural_frequency_hz
        a_next(i) = feed_forward w^2 r(i) + proportional_per_s2 (r(i) - x(i))
                    - derivative_per_s (x(i) - x(i-1)) sampling_hz

    The acceleration is held over a sample and acts ``delay_samples`` samples after it was
    computed from. The static gain is 1 with a feed-forward of 1, and is calibrated away
    otherwise (it belongs to the influence matrix).

    Parameters
    ----------
    natural_frequency_hz : float
        Natural frequency of the mode without the local loop [Hz].
    damping : float
        Its damping ratio, by the air film.
    proportional_per_s2 : float
        Position gain: force over modal mass and position [1/s^2].
    derivative_per_s : float
        Velocity gain: force over modal mass and velocity [1/s].
    feed_forward : float, optional
        Feed-forward force over that which holds the commanded position.
    sampling_hz : float, optional
        Rate of the local loop [Hz].
    delay_samples : int, optional
        Computing delay of the local loop [samples].
    ramp_samples : int, optional
        Number of equal steps, one per sample, in which the command is reached; 1 for a plain step.

    Raises
    ------
    ProblemError
        If a value is out of its range, or the local loop is unstable.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> shell = lbt.models.PositionLoop.from_bandwidth(
    ...     natural_frequency_hz=50, damping=0.5, bandwidth_hz=500, bandwidth_damping=0.7
    ... )
    >>> step = shell.step_response()
    >>> f"{1e3 * step.settling_s:.2f} ms, overshoot {100 * step.overshoot:.0f} %"
    '0.81 ms, overshoot 4 %'
    """

    natural_frequency_hz: Positive
    damping: NotNegative
    proportional_per_s2: NotNegative
    derivative_per_s: NotNegative
    feed_forward: Annotated[float, ("at_least", 0), ("at_most", 10)] = 1.0
    sampling_hz: Positive = 72_000.0
    delay_samples: Annotated[int, ("at_least", 0), ("at_most", 64)] = 1
    ramp_samples: Count = 1

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.natural_frequency_hz < self.sampling_hz / 2:
            raise ProblemError(
                "natural_frequency_hz must lie below half of sampling_hz, "
                f"{self.sampling_hz / 2:.6g} Hz; got {self.natural_frequency_hz:.6g} Hz."
            )
        if not self.static_gain > 0:
            raise ProblemError(
                "the mirror must follow its command: give it a feed-forward or a proportional "
                "gain above 0; got 0 for both."
            )
        radius = self.closed_loop().spectral_radius
        if not radius < _STABLE:
            raise ProblemError(
                "the local loop of the mirror must be stable; got a spectral radius of "
                f"{radius:.9g} per sample, with a proportional gain of "
                f"{self.proportional_per_s2:.6g} 1/s^2, a derivative gain of "
                f"{self.derivative_per_s:.6g} 1/s and a delay of {self.delay_samples} samples at "
                f"{self.sampling_hz:.6g} Hz. Lower the bandwidth, raise the damping, or sample "
                "faster."
            )

    @classmethod
    def from_bandwidth(
        cls,
        *,
        natural_frequency_hz: float,
        damping: float,
        bandwidth_hz: float,
        bandwidth_damping: float = 0.7,
        **options: Any,
    ) -> PositionLoop:
        """Choose the gains that would give a continuous loop this frequency and damping.

        Sampling and delay take some of the damping away. The bandwidth is the natural frequency
        with the local loop, at least that without it [Hz]; ``bandwidth_damping`` is the damping
        ratio with it, and ``options`` are the other fields of the class. A value out of its range,
        and a loop that would lower stiffness or damping or is unstable, raise a ProblemError.
        """
        natural = 2 * np.pi * number(natural_frequency_hz, "natural_frequency_hz", above=0)
        air = number(damping, "damping", at_least=0)
        bandwidth = number(
            bandwidth_hz,
            "bandwidth_hz",
            at_least=float(natural_frequency_hz),
            hint="The local loop makes the mode stiffer; its natural frequency is the least.",
        )
        wanted = 2 * np.pi * bandwidth
        ratio = number(
            bandwidth_damping,
            "bandwidth_damping",
            at_least=air * natural / wanted * (1 - 1e-12),
            hint="The air film alone damps more than that.",
        )
        return cls(
            natural_frequency_hz=natural_frequency_hz,
            damping=damping,
            proportional_per_s2=wanted**2 - natural**2,
            derivative_per_s=max(2 * ratio * wanted - 2 * air * natural, 0.0),
            **options,
        )

    @property
    def static_gain(self) -> float:
        """Final position over a constant command, before calibration."""
        stiffness = (2 * np.pi * self.natural_frequency_hz) ** 2
        gain = self.proportional_per_s2
        return float((gain + self.feed_forward * stiffness) / (gain + stiffness))

    def closed_loop(self) -> StateSpace:
        """Return the local loop from command to position, at its own rate, before calibration.

        Its states are position, velocity [positions per sample], last position, and the
        accelerations under way.
        """
        end = self._motion(1.0)
        n = 3 + self.delay_samples
        A, B = np.zeros((n, n)), np.zeros((n, 1))
        A[:2], B[:2] = end[:2, :n], end[:2, n:]
        A[2, 0] = 1.0
        if self.delay_samples:
            law = self._law()
            A[3], B[3] = law[:n], law[n]
            A[4:, 3:-1] = np.eye(self.delay_samples - 1)
        C = np.zeros((1, n))
        C[0, 0] = 1.0
        return StateSpace(A=A, B=B, C=C, D=np.zeros((1, 1)), dt_s=1 / self.sampling_hz)

    def position_integral(self, samples: float) -> FloatArray:
        """Integral of the position over a part of a sample, 0 to 1, in samples.

        It is a row (n + 1,) over the states at the sample's beginning and the command.
        """
        return np.asarray(self._motion(samples)[2])

    def step_response(self, tolerance: float = 0.1) -> StepResponse:
        """Compute the response from rest to a unit step of the command.

        ``tolerance`` is the half width of the band, in (0, 1), around the final position. The
        response has eight exact points per sample, until the mode has decayed to 1e-6. A mode that
        hardly decays raises a ProblemError.
        """
        band = number(tolerance, "tolerance", above=0, below=1)
        loop = self.closed_loop()
        decay = -np.log(loop.spectral_radius)
        samples = self.ramp_samples + int(np.ceil(np.log(1e6) / decay)) + 2 * loop.n_states
        if samples > _MOST_SAMPLES:
            raise ProblemError(
                f"the mirror must settle within {_MOST_SAMPLES / self.sampling_hz:.4g} s; got one "
                f"that decays by 1/e in {1 / decay / self.sampling_hz:.4g} s. Raise its damping."
            )
        parts = [self._motion(p / _POINTS)[0] for p in range(_POINTS)]
        rows = np.stack(parts) / self.static_gain
        r = np.minimum(1.0, np.arange(1, samples + 1) / self.ramp_samples)
        shown = replace(loop, C=rows[:, :-1], D=rows[:, -1:])
        x = filter_series(shown, r[:, None]).ravel()
        time = np.arange(x.size) / (_POINTS * self.sampling_hz)
        return StepResponse(
            time_s=frozen_copy(time),
            position=frozen_copy(x),
            tolerance=band,
            overshoot=max(float(np.max(x)) - 1, 0.0),
            settling_s=_last_outside(time, x, band),
        )

    def _law(self) -> FloatArray:
        """Acceleration [positions per sample^2] that the loop computes, over states and command."""
        dt = 1 / self.sampling_hz
        kp, kd = self.proportional_per_s2 * dt**2, self.derivative_per_s * dt
        forward = self.feed_forward * (2 * np.pi * self.natural_frequency_hz * dt) ** 2
        row = np.zeros(4 + self.delay_samples)
        row[0], row[2], row[-1] = -kp - kd, kd, kp + forward
        return row

    def _motion(self, part: float) -> FloatArray:
        """Motion [x, x', integral of x] after a part of a sample, over states and command."""
        moved = _exponential(
            2 * np.pi * self.natural_frequency_hz / self.sampling_hz, self.damping, float(part)
        )
        if self.delay_samples:
            acting = np.zeros(4 + self.delay_samples)
            acting[-2] = 1.0
        else:
            acting = self._law()
        out = moved[:3, 3:] * acting
        out[:, :2] += moved[:3, :2]
        return np.asarray(out)


@lru_cache(maxsize=256)
def _exponential(omega: float, damping: float, time: float) -> FloatArray:
    """Exponential of the motion [x, x', integral of x, acceleration], in samples."""
    generator = np.zeros((4, 4))
    generator[0, 1] = 1.0
    generator[1, :2] = -(omega**2), -2 * damping * omega
    generator[1, 3] = 1.0
    generator[2, 0] = 1.0
    return frozen_copy(expm(generator * time))


def _last_outside(time: FloatArray, x: FloatArray, band: float) -> float:
    """Time after which a series stays within a band around 1, between its points."""
    outside = np.flatnonzero(np.abs(x - 1) > band)
    if outside.size == 0 or outside[-1] == x.size - 1:
        return float(time[0] if outside.size == 0 else np.inf)
    i = int(outside[-1])
    edge = 1 + band * np.sign(x[i] - 1)
    return float(time[i] + (edge - x[i]) / (x[i + 1] - x[i]) * (time[i + 1] - time[i]))
