"""What a shaped loop minimises, summed: variances, and worst vibrations in bands."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.shaping.channel import Channel, SingleModeLoop
from lbt_synth.design.shaping.frequencies import Grid, band_text
from lbt_synth.errors import ProblemError
from lbt_synth.linear.convex_functions import Fractions, Function
from lbt_synth.linear.norms import band_norm
from lbt_synth.loop import residual_budget
from lbt_synth.models import ARModel, Atmosphere, Spectrum, TabulatedSpectrum, Truth, Vibration
from lbt_synth.validation import (
    Finite,
    FloatArray,
    NotNegative,
    Positive,
    check_fields,
    number,
    real_array,
)

_PLACES = 17  # of a resonance in its band
_RECORDED = Atmosphere | ARModel | TabulatedSpectrum | None  # what a gain file can hold


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualVariance:
    """Variance of turbulence and noise in the residual of one mode.

    Parameters
    ----------
    turbulence : Atmosphere, ARModel, TabulatedSpectrum or None
        Spectrum of the mode.
    noise_nm : float
        Measurement noise of the mode, per frame [nm].
    sensor_gain : float, optional
        Sensor gain at which the loop runs, relative to the one it is designed for.

    Raises
    ------
    ProblemError
        If a value is out of its range, or there is neither turbulence nor noise.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.design.shaping.ResidualVariance(turbulence=None, noise_nm=15.5).sensor_gain
    1.0
    """

    turbulence: Spectrum | None
    noise_nm: NotNegative
    sensor_gain: Positive = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.turbulence, _RECORDED):
            raise ProblemError(
                "turbulence must be an Atmosphere, an ARModel, a TabulatedSpectrum or None; got "
                f"{type(self.turbulence).__name__}. Sample it into a TabulatedSpectrum."
            )
        check_fields(self)
        if self.turbulence is None and self.noise_nm == 0:
            raise ProblemError("a variance needs turbulence or noise; got neither.")

    @property
    def label(self) -> str:
        """What tables and messages call it."""
        what = "turbulence and noise" if self.noise_nm else "disturbance"
        return f"{what} at sensor gain {self.sensor_gain:g}"

    def function(self, channel: Channel, grid: Grid) -> Function:
        """Return the variance over a grid as a function of the coefficients [nm^2]."""
        f, w = grid.nodes_hz, grid.weights_hz
        left = _left_of(self.turbulence, self.sensor_gain, channel, grid)
        noise = self.noise_nm * np.sqrt(w / channel.nyquist_hz)
        noise_rows = noise[:, None, None] * channel.residual_noise_rows(f)[:, None]
        rows = np.concatenate([left.rows, noise_rows], axis=1)
        return (replace(left, rows=rows, centres=np.pad(left.centres, ((0, 0), (0, 1)))),)

    def measured_nm2(self, loop: SingleModeLoop) -> float:
        """Return the variance in the real loop, exactly."""
        return _measured_left(self.turbulence, self.noise_nm, self.sensor_gain, loop)


def _left_of(
    spectrum: Spectrum | None, sensor_gain: float, channel: Channel, grid: Grid
) -> Fractions:
    """Return the variance that the loop leaves of a spectrum, as a function of coefficients."""
    f = grid.nodes_hz
    density = np.zeros(f.size) if spectrum is None else spectrum.psd(f)
    size = np.sqrt(grid.weights_hz * density)[:, None]
    rows, centres = channel.residual_rows(f, sensor_gain)
    return Fractions(
        frequency_hz=f,
        rows=(size * rows)[:, None],
        centres=size * centres[:, None],
        steering=channel.steering_rows(f, sensor_gain),
        worst=False,
    )


def _measured_left(
    spectrum: Spectrum | None, noise_nm: float, sensor_gain: float, loop: SingleModeLoop
) -> float:
    """Return the variance that the real loop leaves of a spectrum and noise, exactly [nm^2]."""
    truth = Truth(turbulence=spectrum, noise_nm=noise_nm, sensor_gain=sensor_gain)
    budget = residual_budget(loop.held(sensor_gain), truth, frame_means=True)
    return float(np.trace(budget.total_nm2))


@dataclass(frozen=True, kw_only=True)
class Skirts:
    """Spectrum outside a band of a resonance that may be anywhere in it: the largest of them.

    The resonance is sampled: at high frequencies it has more power than one in continuous time.
    """

    band: VibrationBand
    frame_rate_hz: float

    @property
    def breakpoints_hz(self) -> FloatArray:
        """Ends of the band, and frequencies from which the skirts fall [Hz]."""
        steps = self.band.damping * np.array([0.0, 1.0, 3.0, 9.0, 27.0])
        return np.concatenate([self.band.low_hz * (1 - steps), self.band.high_hz * (1 + steps)])

    @cached_property
    def _models(self) -> tuple[ARModel, ...]:
        """Resonances in the band."""
        low, high, rms_nm = self.band.low_hz, self.band.high_hz, self.band.rms_nm
        lines = (
            Vibration(frequency_hz=f, damping=self.band.damping, rms_nm=rms_nm)
            for f in np.linspace(low, high, _PLACES).tolist()
        )
        return tuple(line.ar_model(self.frame_rate_hz) for line in lines)

    def psd(self, frequency_hz: ArrayLike) -> FloatArray:
        """Return the spectrum at frequencies [Hz], zero inside the band [nm^2/Hz]."""
        f = real_array(frequency_hz, "frequency_hz")
        outside = (f < self.band.low_hz) | (f > self.band.high_hz)
        largest = np.max([model.psd(f) for model in self._models], axis=0)
        return np.asarray(np.where(outside, largest, 0.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class VibrationBand:
    """Worst residual of a vibration that may be anywhere in a band of frequencies.

    Parameters
    ----------
    low_hz, high_hz : float
        Ends of the band [Hz].
    rms_nm : float
        Standard deviation of the vibration [nm rms wavefront].
    sensor_gain : float, optional
        Sensor gain at which the loop runs, relative to the one it is designed for.
    damping : float, optional
        Its damping ratio, below 1; 0 for a sinusoid. The skirts of a resonance outside the band
        are added to the worst inside it, which bounds the residual of a resonance anywhere in
        the band.

    Raises
    ------
    ProblemError
        If a value is out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.design.shaping.VibrationBand(low_hz=16.5, high_hz=23.5, rms_nm=797).label
    'vibration in 16.5-23.5 Hz at sensor gain 1'
    """

    low_hz: NotNegative
    high_hz: Finite
    rms_nm: Positive
    sensor_gain: Positive = 1.0
    damping: Annotated[float, ("at_least", 0), ("below", 1)] = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        number(self.high_hz, "high_hz", above=self.low_hz)

    @property
    def label(self) -> str:
        """What tables and messages call it."""
        band = band_text(self.low_hz, self.high_hz)
        return f"vibration in {band} at sensor gain {self.sensor_gain:g}"

    def skirts(self, frame_rate_hz: float) -> Skirts | None:
        """Return what a resonance has outside the band; None for a sinusoid."""
        return Skirts(band=self, frame_rate_hz=frame_rate_hz) if self.damping else None

    def function(self, channel: Channel, grid: Grid) -> Function:
        """Return the worst variance over a grid as a function of the coefficients [nm^2]."""
        f = grid.within(self.low_hz, self.high_hz)
        slopes, target = channel.residual_rows(f, self.sensor_gain)
        rows, centres = self.rms_nm * slopes[:, None], self.rms_nm * target[:, None]
        steering = channel.steering_rows(f, self.sensor_gain)
        inside = Fractions(
            frequency_hz=f, rows=rows, centres=centres, steering=steering, worst=True
        )
        skirts = self.skirts(2 * channel.nyquist_hz)
        if skirts is None:
            return (inside,)
        return inside, _left_of(skirts, self.sensor_gain, channel, grid)

    def measured_nm2(self, loop: SingleModeLoop) -> float:
        """Return the worst variance in the real loop, by level sets, and that of the skirts."""
        rejection = loop.held(self.sensor_gain).path("phase", "residual")
        inside = (self.rms_nm * band_norm(rejection, self.low_hz, self.high_hz).upper) ** 2
        skirts = self.skirts(loop.hardware.frame_rate_hz)
        if skirts is None:
            return inside
        return inside + _measured_left(skirts, 0.0, self.sensor_gain, loop)


Term: TypeAlias = ResidualVariance | VibrationBand


def spectrum_of(term: Term, frame_rate_hz: float) -> Spectrum | None:
    """Return the spectrum of a term: its turbulence, or the skirts of a band."""
    return term.skirts(frame_rate_hz) if isinstance(term, VibrationBand) else term.turbulence


def frequency_costs(
    terms: Iterable[Term], frequency_hz: FloatArray, frame_rate_hz: float
) -> FloatArray:
    """Cost of an error of T at each frequency, up to a factor: spectra and bands."""
    cost = np.zeros(frequency_hz.size)
    for term in terms:
        if isinstance(term, VibrationBand):
            inside = (frequency_hz >= term.low_hz) & (frequency_hz <= term.high_hz)
            cost += np.where(inside, 3 * term.rms_nm**2 / (term.high_hz - term.low_hz), 0.0)
        spectrum = spectrum_of(term, frame_rate_hz)
        if spectrum is not None:
            cost += spectrum.psd(frequency_hz)
    return cost


def noise_level(terms: Iterable[Term]) -> float:
    """Return the largest noise of some terms [nm]."""
    return max((t.noise_nm for t in terms if isinstance(t, ResidualVariance)), default=0.0)
