"""The least worst residual where a sinusoid may lie anywhere in a band.

A sinusoid that is spread over the band like a probability density is a process, and its
limit is a lower bound for every controller that has to face the worst frequency. The best
filter for the worst density rejects all frequencies that have weight by the same factor
and the others more, so its own worst case equals that bound (a saddle point).
Rejection is ``|P|^2 / Phi`` with P of a few coefficients, hence for a given P the density
fills up ``Phi`` to a level proportional to ``|P|^2``; the level follows from the total, and P
from the filled spectrum in turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.loop.least_residual import ModeSpectrum, Prediction, mode_limit, truth_modes
from lbt_synth.models import LoopHardware, SinusoidalVibration, Truth
from lbt_synth.models.vibration import checked_direction
from lbt_synth.validation import FloatArray, frozen_copy

_PANELS = 128  # at least so many over the band
_ORDER = 10
_ROUNDS = 100
_WHOLE_STEPS = 12
_SETTLED = 1e-8  # relative gap of the variance at which the search ends
_LARGEST_GAP = 0.1  # the largest relative gap of an answer


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BandLimit:
    """The least worst residual with a sinusoid anywhere in a band."""

    rms_nm: float  # no linear controller has a smaller worst residual over the band [nm rms]
    # bound on the worst residual of the filter that was found (of infinite order) [nm rms]; what
    # can be had lies between the two. In means over frames they are within 1e-8, for bands of
    # almost all frequencies within some percent; in the image the floor, which rises over the band,
    # parts them
    achieved_nm: float
    variance_nm2: FloatArray  # (n,): the limit by direction, that of the sinusoid included [nm^2]
    frequency_hz: FloatArray  # (f,): frequencies in the band [Hz]
    # (f,): probability of each, of the density that is hardest to reject; the sum is 1
    weight: FloatArray


def least_worst_residual(
    hardware: LoopHardware,
    truth: Truth,
    *,
    band_hz: tuple[float, float],
    rms_nm: float,
    direction: Sequence[float] = (1.0, 0.0),
    frame_means: bool = False,
) -> BandLimit:
    """Least worst residual [nm rms] of any linear controller with a sinusoid anywhere in a band.

    The controller knows the truth, the band, and the size and direction of
    the sinusoid, but not its frequency; what counts is the frequency that is worst for it. In the
    image the limit is the larger of two: with the least mean over a frame and the least motion
    within one, over the band; and with all of the mean rejected, and the motion within a frame at
    the upper end. Other sinusoids count as in :func:`least_residual`.
    """
    nyquist = hardware.frame_rate_hz / 2
    low, high = band_hz
    if not 0 < low < high < nyquist:
        raise ProblemError(
            f"band_hz must increase between 0 and the Nyquist frequency {nyquist:.6g} Hz; got "
            f"{low:.6g} to {high:.6g} Hz. For a known frequency, see least_residual."
        )
    axis = tuple(np.ravel(direction))
    line = SinusoidalVibration(frequency_hz=high, rms_nm=rms_nm, direction=axis)
    along = checked_direction(line, hardware)
    directions, modes = truth_modes(hardware, truth, (along,), in_image=not frame_means)
    own = int(np.argmax(np.abs(directions @ along)))
    ends = low / nyquist, high / nyquist
    most, least = (1.0, 1.0) if frame_means else np.sinc(np.array(ends) / 2) ** 2
    power = line.rms_nm**2  # of which these parts are in the mean over a frame, at either end
    saddle, gap, x, weight = _find_saddle(modes[own], ends, least * power)
    variance = np.array([mode_limit(mode) for mode in modes])
    lower = max(saddle + (1 - most) * power, variance[own] + (1 - least) * power)
    upper = max((saddle + gap) * most / least + (1 - least) * power, lower)
    variance[own] = lower
    variance = variance + [mode.within_frames_nm2() for mode in modes]
    return BandLimit(
        rms_nm=float(np.sqrt(variance.sum())),
        achieved_nm=float(np.sqrt(variance.sum() + upper - lower)),
        variance_nm2=frozen_copy(variance),
        frequency_hz=frozen_copy(x * nyquist),
        weight=frozen_copy(weight),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Band:
    """One mode with a band, prepared for many densities of the sinusoid."""

    mode: ModeSpectrum
    outside: FloatArray  # integrals of the logarithm outside the band
    x: FloatArray  # nodes within the band, in units of Nyquist
    quadrature: FloatArray  # their weights
    base: FloatArray  # spectrum with noise there, without the sinusoid

    @staticmethod
    def of(mode: ModeSpectrum, ends: tuple[float, float]) -> _Band:
        """Prepare a mode with a band."""
        width, noise = ends[1] - ends[0], mode.noise_nm2
        panels = mode.log_moments(ends)
        middle = (panels.low + panels.high) / 2
        inside = (middle > ends[0]) & (middle < ends[1])
        cuts = [np.linspace(*ends, _PANELS + 1), panels.low[inside], panels.high[inside]]
        edges = np.unique(np.clip(np.concatenate(cuts), *ends))
        edges = edges[np.concatenate([[True], np.diff(edges) > 1e-4 * width / _PANELS])]
        x, q = gauss_panels(edges, _ORDER)
        outside = panels.integrals[~inside].sum(axis=0)
        return _Band(mode, outside, x, q, mode.power(x) + noise)

    def fill(self, shape: FloatArray, total: float) -> tuple[float, FloatArray]:
        """Return the level, and what a ``total`` adds to fill the base up to ``level * shape``."""
        heights = self.base / shape
        order = np.argsort(heights, kind="stable")
        q = self.quadrature[order]
        area = np.cumsum(q * shape[order])
        levels = (total + np.cumsum(q * self.base[order])) / area
        above = np.concatenate([heights[order][1:], [np.inf]])
        level = float(levels[np.argmax(levels <= above)])
        return level, np.maximum(level * shape - self.base, 0.0)

    def predict(self, added: FloatArray) -> Prediction:
        """Return the best prediction with some spectrum added within the band."""
        noise = self.mode.noise_nm2
        values = np.log1p((self.base - noise + added) / noise)
        inside = (self.quadrature * values) @ self.mode.cosines(self.x)
        return self.mode.predicted(self.outside + inside)

    def bounds(
        self, prediction: Prediction, added: FloatArray, worst: float
    ) -> tuple[float, float]:
        """Lower bound [nm^2] of a density, and how far above it its filter's worst case is."""
        total, noise = float(self.quadrature @ added), self.mode.noise_nm2
        rejection = prediction.error_power(self.x) / (self.base + added)
        mean = float(self.quadrature @ (added * rejection))
        gap = noise * float(np.exp(prediction.mean_log)) * (total * worst - mean)
        return prediction.variance(noise), max(gap, 0.0)


def _find_saddle(
    mode: ModeSpectrum, ends: tuple[float, float], total: float
) -> tuple[float, float, FloatArray, FloatArray]:
    """Return lower bound and gap [nm^2], and the worst density: its nodes and their weights."""
    band = _Band.of(mode, ends)
    # the worst case is sought between the nodes, too
    fine = np.unique(np.concatenate([np.linspace(*ends, 8 * _PANELS + 1), band.x]))
    base = mode.power(fine) + mode.noise_nm2
    shape, fine_shape = np.ones(band.x.size), np.ones(fine.size)
    best_lower, best_gap, weight = 0.0, np.inf, band.quadrature
    for rounds in range(_ROUNDS):
        level, added = band.fill(shape, total)
        prediction = band.predict(added)
        fine_power = prediction.error_power(fine)
        worst = float(np.max(fine_power / np.maximum(base, level * fine_shape)))
        lower, gap = band.bounds(prediction, added, worst)
        if gap < best_gap:
            best_lower, best_gap, weight = lower, gap, band.quadrature * added / total
        if gap <= _SETTLED * lower:
            break
        # half a step where whole ones oscillate
        share = 1.0 if rounds < _WHOLE_STEPS else 0.5
        shape = _step_towards(shape, prediction.error_power(band.x), share)
        fine_shape = _step_towards(fine_shape, fine_power, share)
    if not best_gap <= _LARGEST_GAP * best_lower:
        raise NumericalError(
            f"the worst density of a sinusoid did not settle in {_ROUNDS} rounds: a gap of "
            f"{best_gap / best_lower:.3g} of the variance is left. Try a narrower band.",
            status="rounds",
            residual=best_gap / best_lower,
        )
    return best_lower, best_gap, band.x, weight


def _step_towards(shape: FloatArray, target: FloatArray, share: float) -> FloatArray:
    """Weighted geometric mean, kept off zero."""
    mixed = shape ** (1 - share) * target**share
    return np.asarray(np.maximum(mixed, 1e-14 * np.max(mixed)))
