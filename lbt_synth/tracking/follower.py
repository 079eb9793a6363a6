"""The quickest estimator for tracking: all is known but the frequencies of the lines."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.plant import TipTiltPlant, require_no_memory, with_vibrations
from lbt_synth.models.vibration import Vibration
from lbt_synth.validation import FloatArray, instance, number

_LEAST_BINS = 8
_EVIDENCE = 20.0  # twice the gain in log likelihood that makes a line


class LineFollower:
    """Find the vibrations of a plant again at their present frequencies.

    Turbulence, noise, sensor gain, dampings and rms stay those of the plant. Of each line the
    frequency is found by the Whittle likelihood (P. Whittle, Ark. Mat. 2, 423 (1953),
    doi:10.1007/BF02590998) of the pseudo-open-loop series along its direction, tapered with a
    Hann window, within ``span_hz`` of where it was last; its power is free in the fit. It may
    be narrower than the window can tell.

    Parameters
    ----------
    plant : TipTiltPlant
        The plant, with at least one vibration, and as many independent measurements as modes.
    span_hz : float, optional
        Half width of the search [Hz].

    Raises
    ------
    ProblemError
        If the plant has no vibration, the modes cannot be told from the measurements, or the
        span is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> slow = lbt.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1,))
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, vibrations=[line],
    ...                            noise_nm=15.5, modes=1)
    >>> follow = lbt.LineFollower(plant)
    >>> time_s = np.arange(3200)[:, None] / 800
    >>> found = follow(800 * np.sin(2 * np.pi * 20.7 * time_s), np.zeros((3200, 1)))
    >>> bool(abs(found.vibrations[0].frequency_hz - 20.7) < 0.02)
    True
    """

    def __init__(self, plant: TipTiltPlant, *, span_hz: float = 4.0) -> None:
        instance(plant, TipTiltPlant)
        require_no_memory(plant)
        if not plant.vibrations:
            raise ProblemError("there must be a vibration to follow; got a plant without any.")
        sensor = plant.hardware.sensor
        if np.linalg.matrix_rank(sensor) < plant.hardware.modes:
            raise ProblemError(
                f"every mode must be measured; got a sensor matrix {sensor.shape} of rank "
                f"{np.linalg.matrix_rank(sensor)} for {plant.hardware.modes} modes."
            )
        self._plant = plant
        self._span_hz = number(span_hz, "span_hz", above=0)
        self._inverse = np.linalg.pinv(sensor)
        self.reset()

    def reset(self) -> None:
        """Begin again at the plant's own frequencies."""
        self._lines = list(self._plant.vibrations)

    def __call__(self, measurements: FloatArray, corrections: FloatArray) -> TipTiltPlant | None:
        """Find the frequencies in a window.

        Parameters
        ----------
        measurements : (frames, q) ndarray
            Measurements y(k).
        corrections : (frames, n) ndarray
            Corrections c(k) inside them [nm].

        Returns
        -------
        TipTiltPlant or None
            The plant at these frequencies; None if a line is not there.

        Raises
        ------
        DimensionError
            If the series have other sizes than the plant.
        """
        hw = self._plant.hardware
        q, n = hw.sensor.shape
        if measurements.shape[1:] != (q,) or corrections.shape != (len(measurements), n):
            raise DimensionError(
                f"the series must be (frames, {q}) and (frames, {n}); got {measurements.shape} "
                f"and {corrections.shape}."
            )
        open_loop = measurements @ self._inverse.T + corrections
        frames, rate = len(open_loop), hw.frame_rate_hz
        taper = np.sqrt(8 / 3) * np.sin(np.pi * (np.arange(frames) + 0.5) / frames) ** 2
        directions = np.array([line.direction for line in self._lines])
        series = (open_loop - open_loop.mean(axis=0)) @ directions.T
        powers = 2 / (rate * frames) * np.abs(np.fft.rfft(series * taper[:, None], axis=0)) ** 2
        grid = np.fft.rfftfreq(frames, 1 / rate)
        found = []
        for i, line in enumerate(self._lines):
            bins = (np.abs(grid - line.frequency_hz) <= self._span_hz) & (grid > 0)
            bins &= grid < rate / 2
            if np.count_nonzero(bins) < _LEAST_BINS:
                return None
            rest = self._background(i, grid[bins])
            frequency = _fitted(line, grid[bins], powers[bins, i], rest, frames / rate, rate)
            if frequency is None:
                return None
            found.append(line.moved(frequency))
        self._lines = found
        return with_vibrations(self._plant, found)

    def _background(self, index: int, frequency_hz: FloatArray) -> FloatArray:
        """Spectrum along the direction of a line without the line itself [nm^2/Hz]."""
        rate = self._plant.hardware.frame_rate_hz
        along = np.array(self._lines[index].direction)
        noise = along @ self._inverse
        out = np.full(frequency_hz.size, 2 / rate * float(noise @ self._plant.R @ noise))
        for weight, model in zip(along**2, self._plant.turbulence, strict=True):
            out += weight * model.psd(frequency_hz)
        for j, line in enumerate(self._lines):
            if j != index:
                weight = float(along @ np.array(line.direction)) ** 2
                out += weight * line.ar_model(rate).psd(frequency_hz)
        return out


def _fitted(
    line: Vibration, grid: FloatArray, power: FloatArray, rest: FloatArray, length_s: float,
    rate: float,
) -> float | None:  # fmt: skip
    """Frequency of the line in a part of the periodogram [Hz]; None if it is not there."""
    # a line narrower than the window's resolution is seen as wide as that
    width_hz = max(line.damping * line.frequency_hz, 1 / length_s)
    low, high = max(grid[0], 1.01 * width_hz), grid[-1]

    def contrast(p: FloatArray) -> float:
        if not low <= p[0] <= high or not -10 < p[1] < 10:
            return np.inf
        there = Vibration(
            frequency_hz=float(p[0]), damping=width_hz / float(p[0]),
            rms_nm=line.rms_nm * float(np.exp(p[1])), direction=(1.0,),
        )  # fmt: skip
        model = rest + there.ar_model(rate).psd(grid)
        return float(np.sum(np.log(model) + power / model))

    peak = float(np.clip(grid[np.argmax(power / rest)], low, high))
    start = np.array([[peak, 0.0], [peak + 0.25 / length_s, 0.0], [peak, 0.3]])
    fit = minimize(
        contrast, start[0], method="Nelder-Mead",
        options={"initial_simplex": start, "xatol": 1e-4, "fatol": 1e-6, "maxiter": 400},
    )  # fmt: skip
    without = float(np.sum(np.log(rest) + power / rest))
    if not fit.success or not 2 * (without - fit.fun) > _EVIDENCE:
        return None
    return float(fit.x[0])
