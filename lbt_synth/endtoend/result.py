"""What an end-to-end simulation gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.endtoend.system import EndToEndSystem
from lbt_synth.validation import FloatArray

_BATCHES = 8


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
        Frames that were run before and dropped.
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

        It is that of this air: what changes more slowly than a batch counts too little, and other
        seeds scatter by more.
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
        """Gain of the sensor in the loop, mode by mode, (modes,).

        Regression of the measurements on the true residual: the noise of a
        measurement is that of a later frame than the residual it is of.
        """
        y, phase = self.measurements[1:], self.residual_nm[:-1]
        return np.asarray(np.sum(y * phase, axis=0) / np.sum(phase**2, axis=0))

    @property
    def optical_gain_error(self) -> FloatArray:
        """Standard error of each optical gain, for noise that is white, (modes,)."""
        y, phase = self.measurements[1:], self.residual_nm[:-1]
        left = y - self.optical_gain * phase
        return np.asarray(np.sqrt(np.sum(left**2, axis=0) / np.sum(phase**2, axis=0) / len(y)))

    @property
    def tip_tilt_gain(self) -> float:
        """Optical gain of tip and tilt together."""
        y, phase = self.measurements[1:, :2], self.residual_nm[:-1, :2]
        return float(np.sum(y * phase) / np.sum(phase**2))

    @property
    def tip_tilt_gain_error(self) -> float:
        """Standard error of the optical gain of tip and tilt."""
        y, phase = self.measurements[1:, :2], self.residual_nm[:-1, :2]
        left = y - self.tip_tilt_gain * phase
        return float(np.sqrt(np.mean(left**2) / np.sum(phase**2)))

    @property
    def tip_tilt_noise_nm(self) -> float:
        """What the optical gain does not explain of the measured tip and tilt [nm rms a mode]."""
        y, phase = self.measurements[1:, :2], self.residual_nm[:-1, :2]
        return float(np.sqrt(np.mean((y - self.tip_tilt_gain * phase) ** 2)))
