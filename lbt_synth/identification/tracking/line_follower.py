"""The quickest identifier for tracking: it finds only the frequencies of known lines."""

from __future__ import annotations

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.tracking.line_fit import LineFit, LineSearch
from lbt_synth.models import TipTiltPlant
from lbt_synth.models.plant.tip_tilt import with_vibrations
from lbt_synth.validation import FloatArray, number, require_instance

_LEAST_BINS = 8
_ALIGNED = 0.9  # cosine between directions along which lines may be mistaken


class LineFollower:
    """Find the vibrations of a plant again at their present frequencies.

    Turbulence, noise, sensor gain, dampings and rms stay those of the plant. Of each line the
    frequency is found by the Whittle likelihood (P. Whittle, Ark. Mat. 2, 423 (1953),
    doi:10.1007/BF02590998) of the pseudo-open-loop series along its direction, tapered with a
    Hann window, within ``span_hz`` of where it was last; its power is free in the fit. It may
    be narrower than the window can tell. Lines along one direction (cosine above 0.9) whose
    searches overlap are fitted together, keep their order, and must stay two bins of the window
    apart: no two of them are found on one peak.

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
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1,))
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5, modes=1
    ... )
    >>> follow = lbt.identification.LineFollower(plant)
    >>> time_s = np.arange(3200)[:, None] / 800
    >>> found = follow(800 * np.sin(2 * np.pi * 20.7 * time_s), np.zeros((3200, 1)))
    >>> bool(abs(found.vibrations[0].frequency_hz - 20.7) < 0.02)
    True
    """

    def __init__(self, plant: TipTiltPlant, *, span_hz: float = 4.0) -> None:
        require_instance(plant, TipTiltPlant)
        plant.parts()  # refuses the memory of a mixed filter
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
        """Find the frequencies in measurements (frames, q) and corrections (frames, n)."""
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
        grid = np.asarray(np.fft.rfftfreq(frames, 1 / rate), dtype=np.float64)
        inside = (grid > 0) & (grid < rate / 2)
        grid, powers = grid[inside], powers[inside]
        shared = (directions @ directions.T) ** 2
        found = list(self._lines)
        for group in self._groups(shared):
            searches = []
            for i in group:
                line = self._lines[i]
                bins = np.abs(grid - line.frequency_hz) <= self._span_hz
                if np.count_nonzero(bins) < _LEAST_BINS:
                    return None
                rest = self._background(group, i, grid)
                searches.append(LineSearch(line=line, bins=bins, power=powers[:, i], rest=rest))
            fit = LineFit(grid, length_s=frames / rate, frame_rate_hz=rate, beside=len(group) > 1)
            if len(group) == 1:
                alone = fit.fit_alone(searches[0])
                frequencies = None if alone is None else [alone]
            else:
                frequencies = fit.fit_together(searches, shared[np.ix_(group, group)])
            if frequencies is None:
                return None
            for i, frequency in zip(group, frequencies, strict=True):
                found[i] = self._lines[i].at_frequency(frequency)
        self._lines = found
        return with_vibrations(self._plant, found)

    def _groups(self, shared: FloatArray) -> list[list[int]]:
        """Return groups of lines that could be found on one peak, by rising frequency."""
        frequency = [line.frequency_hz for line in self._lines]
        groups: list[list[int]] = []
        for i in np.argsort(frequency, kind="stable").tolist():
            near = [
                group
                for group in groups
                if any(
                    shared[i, j] > _ALIGNED**2 and frequency[i] - frequency[j] <= 2 * self._span_hz
                    for j in group
                )
            ]
            groups = [group for group in groups if group not in near]
            groups.append(
                sorted({i, *(j for group in near for j in group)}, key=frequency.__getitem__)
            )
        return groups

    def _background(self, group: list[int], index: int, frequency_hz: FloatArray) -> FloatArray:
        """Return the spectrum along a line without the lines of its group [nm^2/Hz]."""
        rate = self._plant.hardware.frame_rate_hz
        along = np.array(self._lines[index].direction)
        noise = along @ self._inverse
        out = np.full(frequency_hz.size, 2 / rate * float(noise @ self._plant.R @ noise))
        for weight, model in zip(along**2, self._plant.turbulence, strict=True):
            out += weight * model.psd(frequency_hz)
        for j, line in enumerate(self._lines):
            if j not in group:
                weight = float(along @ np.array(line.direction)) ** 2
                out += weight * line.ar_model(rate).psd(frequency_hz)
        return out
