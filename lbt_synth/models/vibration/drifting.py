"""A vibration whose frequency drifts: a sinusoid or a resonance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError
from lbt_synth.models.ar_model import variance_ratios
from lbt_synth.models.vibration.resonance import Vibration, unit_direction
from lbt_synth.validation import FloatArray, Positive, check_fields, real_array


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftingVibration:
    """A vibration whose frequency moves linearly in time, and stays where it arrived.

    Without a damping it is a sinusoid whose phase is the integral of its frequency. With one it
    is a resonance with a constant decay rate, damping times frequency, and a constant rms: an
    AR2 process whose coefficient a1 follows the frequency, with a driving noise that keeps
    the variance exactly constant. Only simulations accept it; whatever needs a stationary
    truth refuses it.

    Parameters
    ----------
    start_hz, end_hz : float
        Frequency up to time 0, and from ``duration_s`` on [Hz].
    duration_s : float
        Duration of the drift [s].
    rms_nm : float
        Standard deviation of the displacement along its direction [nm rms wavefront].
    damping : float, optional
        Damping ratio at ``start_hz``, in (0, 1); None for a sinusoid.
    direction : tuple of float, optional
        Direction over the modes, made a unit vector; ``(1, 0)`` shakes tip.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range, or a resonance arrives at a frequency
        that is not above its decay rate.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> line = lbt.models.DriftingVibration(start_hz=17, end_hz=23, duration_s=60, rms_nm=797)
    >>> line.frequency_hz_at([-5, 0, 30, 60, 100]).tolist()
    [17.0, 17.0, 20.0, 23.0, 23.0]
    """

    start_hz: Positive
    end_hz: Positive
    duration_s: Positive
    rms_nm: Positive
    damping: Annotated[float, ("above", 0), ("below", 1)] | None = None
    direction: tuple[float, ...] = (1.0, 0.0)

    def __post_init__(self) -> None:
        check_fields(self, direction=unit_direction(self.direction))
        if self.damping is not None:
            start = Vibration(frequency_hz=self.start_hz, damping=self.damping, rms_nm=self.rms_nm)
            start.at_frequency(self.end_hz)

    @property
    def highest_hz(self) -> float:
        """The highest frequency that it passes [Hz]."""
        return max(self.start_hz, self.end_hz)

    @property
    def amplitude_nm(self) -> float:
        """Peak displacement of the sinusoid [nm rms wavefront]."""
        return float(np.sqrt(2) * self.rms_nm)

    def frequency_hz_at(self, time_s: ArrayLike) -> FloatArray:
        """Return the frequency [Hz] at finite times [s]; the drift begins at time 0."""
        moved = np.clip(real_array(time_s, "time_s") / self.duration_s, 0.0, 1.0)
        return np.asarray(self.start_hz + (self.end_hz - self.start_hz) * moved)

    def turns_at(self, time_s: ArrayLike) -> FloatArray:
        """Return the phase over 2 pi at finite times [s]: the frequency's integral from time 0."""
        t = real_array(time_s, "time_s")
        inside = np.clip(t, 0.0, self.duration_s)
        rise = (self.end_hz - self.start_hz) / self.duration_s
        arrived = np.maximum(t - self.duration_s, 0.0)
        before = self.start_hz * (t - arrived)
        return np.asarray(before + rise * inside**2 / 2 + self.end_hz * arrived)

    def ar_process(
        self, time_s: FloatArray, frame_rate_hz: float
    ) -> tuple[FloatArray, float, FloatArray]:
        """Return the AR2 process of the resonance: ``x(k) = a1(k) x(k-1) + a2 x(k-2) + s(k) v(k)``.

        With unit white noise v and a process that was stationary at the first frame's frequency,
        the variance is ``rms_nm^2`` in every frame: s follows from the recursion of
        ``E x(k) x(k-1)``.

        Parameters
        ----------
        time_s : (frames,) ndarray
            Times of the frames [s], one frame period apart.
        frame_rate_hz : float
            Frame rate [Hz].

        Returns
        -------
        a1, a2, driving_rms_nm : (frames,) ndarray, float, (frames,) ndarray
            Coefficients, and the standard deviation s of the driving noise [nm], in each frame.

        Raises
        ------
        ProblemError
            If this is a sinusoid, or the frequency falls faster than the decay lets the
            variance follow.
        """
        from scipy.signal import lfilter  # slow to import

        if self.damping is None:
            raise ProblemError("a sinusoid has no AR2 process; got one that drifts.")
        decay = 2 * np.pi * self.damping * self.start_hz / frame_rate_hz  # per frame
        natural = 2 * np.pi * self.frequency_hz_at(time_s) / frame_rate_hz
        a1 = 2 * np.exp(-decay) * np.cos(np.sqrt(natural**2 - decay**2))
        a2 = -float(np.exp(-2 * decay))
        # E x(k-1) x(k-2) over the variance, less its value at a constant a1, a1 / (1 - a2)
        step = np.diff(a1, prepend=a1[:1]) / (1 - a2)
        late = lfilter([-a2], [1.0, -a2], step)
        behind = np.concatenate([[0.0], late[:-1]]) - step
        still = 1 / variance_ratios(np.stack([a1, np.full_like(a1, a2)], axis=-1))
        variance = still - 2 * a1 * a2 * behind
        if np.any(variance < 0):
            raise ProblemError(
                "the frequency of a resonance must move slowly beside its decay, or its rms cannot "
                f"be held; got {self.start_hz:.6g} to {self.end_hz:.6g} Hz in "
                f"{self.duration_s:.6g} s at a damping of {self.damping:.6g}. Try a longer drift, "
                "more damping, or a sinusoid (no damping)."
            )
        return a1, a2, np.asarray(self.rms_nm * np.sqrt(variance))
