"""The result of an end-to-end simulation: series, mean image, Strehl ratio, optical gains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.interop.specula.system import EndToEndSystem
from lbt_synth.validation import FloatArray

_BATCHES = 8
_TIP_TILT = slice(2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EndToEndRun:
    """Series and images of a closed loop, after it has settled.

    Row k of a series is frame k: ``measurements`` y(k) come from the exposure of frame
    k-1, ``commands`` u(k) from y(k), and ``residual_nm`` is the phase of exposure k.

    Attributes
    ----------
    system : EndToEndSystem
        What was simulated.
    strehl_series : (frames,) ndarray
        Intensity in the image's centre over that of a perfect image, frame by frame.
    other_modes_series : (frames,) ndarray
        The same for the phase without tip and tilt.
    measurements, commands, residual_nm : (frames, modes) ndarray
        Modal coefficients [nm rms].
    psf : (h, h) ndarray
        Mean image, of sum 1.
    psf_pixel_mas : float
        Its pixel [mas].
    seed : int
        Seed of turbulence, vibrations and noise.
    settle_frames : int
        Frames run before these, and dropped.
    seconds : float
        Time that the loop took [s].
    """

    system: EndToEndSystem
    strehl_series: FloatArray
    other_modes_series: FloatArray
    measurements: FloatArray
    commands: FloatArray
    residual_nm: FloatArray
    psf: FloatArray
    psf_pixel_mas: float
    seed: int
    settle_frames: int
    seconds: float

    @property
    def frames(self) -> int:
        """Frames of the exposure."""
        return len(self.strehl_series)

    @property
    def strehl(self) -> float:
        """Strehl ratio of the long exposure."""
        return float(np.mean(self.strehl_series))

    @property
    def strehl_error(self) -> float:
        """Standard error of the Strehl ratio, from eight batches of frames; nan for short runs.

        It holds for this turbulence: what changes more slowly than a batch counts too little, and
        other seeds scatter more.
        """
        batches = np.array_split(self.strehl_series, _BATCHES)
        if len(self.strehl_series) < 2 * _BATCHES:
            return float("nan")
        means = [float(np.mean(batch)) for batch in batches]
        return float(np.std(means, ddof=1) / np.sqrt(_BATCHES))

    @property
    def other_modes_strehl(self) -> float:
        """Strehl ratio of the long exposure if tip and tilt were perfect."""
        return float(np.mean(self.other_modes_series))

    @property
    def rms_nm(self) -> FloatArray:
        """Residual of each mode [nm rms], (modes,)."""
        return np.asarray(np.sqrt(np.mean(self.residual_nm**2, axis=0)))

    @property
    def optical_gain(self) -> FloatArray:
        """Gain of the sensor in the loop, for each mode, (modes,).

        Regression of the measurements on the true residual, which does not yet contain the noise
        of its measurement.
        """
        return self._regress(slice(None), axis=0)[0]

    @property
    def optical_gain_error(self) -> FloatArray:
        """Standard error of each optical gain, for noise that is white, (modes,)."""
        return self._regress(slice(None), axis=0)[1]

    @property
    def tip_tilt_gain(self) -> float:
        """Optical gain of tip and tilt together."""
        return float(self._regress(_TIP_TILT)[0])

    @property
    def tip_tilt_gain_error(self) -> float:
        """Standard error of the optical gain of tip and tilt."""
        return float(self._regress(_TIP_TILT)[1])

    @property
    def tip_tilt_noise_nm(self) -> float:
        """Measured tip and tilt that the optical gain does not explain [nm rms per mode]."""
        return float(self._regress(_TIP_TILT)[2])

    def _regress(
        self, modes: slice, axis: int | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the gain of modes, each or together, its standard error, and the rest [nm rms]."""
        y, phase = self.measurements[1:, modes], self.residual_nm[:-1, modes]
        power = np.sum(phase**2, axis=axis)
        gain = np.asarray(np.sum(y * phase, axis=axis) / power)
        left = np.mean((y - gain * phase) ** 2, axis=axis)
        return gain, np.asarray(np.sqrt(left / power)), np.asarray(np.sqrt(left))
