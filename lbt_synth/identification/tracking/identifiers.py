"""The identifiers of a tracking controller: of the whole model, or of known lines only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.optimize import minimize
from scipy.signal import periodogram
from scipy.sparse.csgraph import connected_components

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.fit.axis import identify_axis
from lbt_synth.identification.fit.identified_model import IdentifiedAxis, IdentifiedModel
from lbt_synth.models import TipTiltPlant, Vibration
from lbt_synth.models.plant.tip_tilt import with_vibrations
from lbt_synth.validation import FloatArray, integer, number, require_instance

_LEAST_BINS = 8
# Least half width with which a line is seen: that of the window, or for lines beside each other
# half of it, next to that of the window's own peak, so that it does not cover its neighbours.
_WIDTH, _WIDTH_BESIDE = 1.0, 0.5  # bins
_ALIGNED = 0.9  # cosine between directions along which lines may be mistaken
_EVIDENCE = 20.0  # twice the gain in log likelihood that makes a line
_MOST_ROUNDS = 4
_SETTLED_HZ = 1e-3
_RESOLUTION = 2.0  # bins from the top of a line to the first zero of a Hann window's spectrum


class LoopIdentifier:
    """Identify turbulence, lines and noise of each axis in a window (:func:`identify_axis`).

    Each starts from the last model; one that does not show the sensor gain takes the plant's.

    Parameters
    ----------
    plant : TipTiltPlant
        Loop, and sensor gains in its sensor matrix: one measurement per axis.
    find_gain : bool, optional
        Whether the sensor gain is found; otherwise it is the plant's.
    most_lines : int, optional
        Most resonances per axis; by default one more than the plant has.

    Raises
    ------
    ProblemError
        If a measurement sees more than its own axis.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10, frame_rate_hz=500)
    >>> line = lbt.Vibration(frequency_hz=40, damping=0.01, rms_nm=100, direction=(1,))
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=500, turbulence=slow, vibrations=[line], noise_nm=15.5, modes=1
    ... )
    >>> moved = lbt.Vibration(frequency_hz=43, damping=0.01, rms_nm=100, direction=(1,))
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(moved,), noise_nm=15.5)
    >>> tracker = lbt.identification.TrackingController(
    ...     plant, lbt.identification.LoopIdentifier(plant), window_s=4
    ... )
    >>> run = lbt.simulate(tracker, truth, hardware=plant.hardware, frames=2000)
    >>> any(abs(hz - 43) < 0.5 for hz in tracker.history[-1].frequencies_hz)
    True
    """

    def __init__(
        self, plant: TipTiltPlant, *, find_gain: bool = True, most_lines: int | None = None
    ) -> None:
        require_instance(plant, TipTiltPlant)
        sensor = plant.hardware.sensor
        gains = np.diag(sensor)
        if not np.array_equal(sensor, np.diag(gains)) or np.any(gains <= 0):
            raise ProblemError(
                "each measurement must be of one axis, with a gain above 0; got a sensor matrix "
                f"{sensor.tolist()}. Recombine the measurements into axes before the controller."
            )
        self._plant, self._gains, self._find_gain = plant, gains.tolist(), bool(find_gain)
        along = zip(*(line.direction for line in plant.vibrations), strict=True)
        own = max((int(np.count_nonzero(axis)) for axis in along), default=0)
        self._most_lines = integer(
            own + 1 if most_lines is None else most_lines, "most_lines", at_least=0
        )
        self.reset()

    def reset(self) -> None:
        """Forget the last window."""
        self._last: Sequence[IdentifiedAxis | None] = [None] * len(self._gains)

    def __call__(self, measurements: FloatArray, corrections: FloatArray) -> TipTiltPlant | None:
        """Identify a window of measurements and corrections, (frames, n)."""
        hw, count = self._plant.hardware, len(self._gains)
        if measurements.shape[1:] != (count,) or corrections.shape != measurements.shape:
            raise DimensionError(
                f"the series must be (frames, {count}); got {measurements.shape} and "
                f"{corrections.shape}."
            )
        last, self._last = self._last, [None] * count  # a fit that fails is no start
        each = zip(measurements.T, corrections.T, self._gains, last, strict=True)
        found = tuple(
            identify_axis(
                y,
                c,
                frame_rate_hz=hw.frame_rate_hz,
                sensor_gain=None if self._find_gain else gain,
                assumed_gain=gain,
                most_lines=self._most_lines,
                start=start,
            )
            for y, c, gain, start in each
        )
        model = IdentifiedModel(
            axes=found,
            frame_rate_hz=hw.frame_rate_hz,
            delay_frames=hw.delay_frames,
            mirror=hw.mirror,
        )
        plant, self._last = model.plant(), found
        return replace(plant, hardware=replace(plant.hardware, influence_matrix=hw.influence))


class LineFollower:
    """Find the vibrations of a plant again at their present frequencies.

    Turbulence, noise, sensor gain, dampings and rms stay those of the plant. The Whittle
    likelihood (P. Whittle, Ark. Mat. 2, 423 (1953), doi:10.1007/BF02590998) of the
    pseudo-open-loop series along a line, with a Hann window, gives its frequency, within
    ``span_hz`` of the last one; its power is free in the fit, and it may be narrower than the
    window resolves. Lines along one direction (cosine above 0.9) whose searches overlap are fitted
    together, keep their order, and must stay two bins apart: no two are found on one peak.

    Parameters
    ----------
    plant : TipTiltPlant
        The plant, with at least one vibration, and as many independent measurements as modes.
    span_hz : float, optional
        Half width of the search [Hz].

    Raises
    ------
    ProblemError
        If the plant has no vibration, a mode is not measured, or the span is out of range.

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
        taper = np.sin(np.pi * (np.arange(frames) + 0.5) / frames) ** 2
        directions = np.array([line.direction for line in self._lines])
        grid, powers = periodogram(  # type: ignore[call-overload]
            open_loop @ directions.T, rate, window=taper, detrend="constant", axis=0
        )
        inside = (grid > 0) & (grid < rate / 2)
        grid, powers = grid[inside], powers[inside]
        shared = (directions @ directions.T) ** 2
        found = list(self._lines)
        for group in self._groups(shared):
            width_hz = (_WIDTH if len(group) == 1 else _WIDTH_BESIDE) * rate / frames
            searches = []
            for i in group:
                line = self._lines[i]
                bins = np.abs(grid - line.frequency_hz) <= self._span_hz
                if np.count_nonzero(bins) < _LEAST_BINS:
                    return None
                search = _Line(
                    last=line,
                    peak_hz=line.frequency_hz,
                    frequency_hz=grid[bins],
                    power=powers[bins, i],
                    rest=self._background(group, i, grid[bins]),
                    width_hz=max(line.damping * line.frequency_hz, width_hz),
                    bin_hz=rate / frames,
                    frame_rate_hz=rate,
                )
                searches.append(search)
            if len(group) == 1:
                frequencies = _fit_alone(searches[0])
            else:
                frequencies = _fit_neighbours(searches, shared[np.ix_(group, group)])
            if frequencies is None:
                return None
            for i, frequency in zip(group, frequencies, strict=True):
                found[i] = self._lines[i].at_frequency(frequency)
        self._lines = found
        return with_vibrations(self._plant, found)

    def _groups(self, shared: FloatArray) -> list[list[int]]:
        """Return groups of lines that could be found on one peak, by rising frequency."""
        frequency = np.array([line.frequency_hz for line in self._lines])
        apart = np.abs(frequency - frequency[:, None])
        near = (shared > _ALIGNED**2) & (apart <= 2 * self._span_hz)
        count, label = connected_components(near)
        order = np.argsort(frequency, kind="stable")
        return [order[label[order] == k].tolist() for k in range(count)]

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Line:
    """A line, the bins in which it is searched for, and where the search is."""

    last: Vibration  # as it was found last
    frequency_hz: FloatArray  # (k,): where it may be
    power: FloatArray  # (k,): periodogram along its direction [nm^2/Hz]
    rest: FloatArray  # (k,): spectrum without the lines that are fitted [nm^2/Hz]
    width_hz: float  # half width with which it is seen
    bin_hz: float
    frame_rate_hz: float
    peak_hz: float
    log_rms: float = 0.0  # logarithm of its rms over the last

    @property
    def bounds_hz(self) -> tuple[float, float]:
        """Least and highest frequency."""
        low, high = float(self.frequency_hz[0]), float(self.frequency_hz[-1])
        return max(low, 1.01 * self.width_hz), high

    def spectrum(self, frequency_hz: FloatArray) -> FloatArray:
        """Return the spectrum of the line, (f,)."""
        there = Vibration(
            frequency_hz=self.peak_hz,
            damping=self.width_hz / self.peak_hz,
            rms_nm=self.last.rms_nm * float(np.exp(self.log_rms)),
            direction=(1.0,),
        )
        return there.ar_model(self.frame_rate_hz).psd(frequency_hz)

    def contrast(self, rest: FloatArray) -> float:
        """Return minus the log likelihood of the line over the rest of the spectrum."""
        return _contrast(self.power, rest + self.spectrum(self.frequency_hz))

    def is_there(self, rest: FloatArray) -> bool:
        """Whether the line makes the data likelier by enough."""
        return 2 * (_contrast(self.power, rest) - self.contrast(rest)) > _EVIDENCE


def _contrast(power: FloatArray, model: FloatArray) -> float:
    return float(np.sum(np.log(model) + power / model))


def _fit_alone(line: _Line) -> list[float] | None:
    """Return the frequency of a line without neighbours [Hz]; None if it is not there."""
    highest = float(line.frequency_hz[np.argmax(line.power / line.rest)])
    found = _fit_line(replace(line, peak_hz=highest), line.rest)
    return [found.peak_hz] if found is not None and found.is_there(line.rest) else None


def _fit_neighbours(lines: Sequence[_Line], shared: FloatArray) -> list[float] | None:
    """Return the frequencies of neighbouring lines, in the order that they had [Hz].

    Each is fitted beside the others in turn, from the highest peaks and from where they were last;
    the likelier end counts. ``shared`` (m, m) is the power that one line has along another.
    """
    ends = []
    for places in ([line.last.frequency_hz for line in lines], _highest_peaks(lines)):
        start = [_start_at(line, place) for line, place in zip(lines, places, strict=False)]
        end = _fit_in_turn(start, shared, 1) if len(start) == len(lines) else None
        ends += [end] if end else []

    def contrast(end: Sequence[_Line]) -> float:
        return sum(line.contrast(_rest_beside(end, shared, i)) for i, line in enumerate(end))

    found = _fit_in_turn(min(ends, key=contrast), shared, _MOST_ROUNDS) if ends else None
    if found is None:
        return None
    if not all(line.is_there(_rest_beside(found, shared, i)) for i, line in enumerate(found)):
        return None
    for i, j in combinations(range(len(found)), 2):
        least_hz = _RESOLUTION * found[i].bin_hz if shared[i, j] > 0 else 0.0
        if found[j].peak_hz - found[i].peak_hz < least_hz:
            return None
    return [line.peak_hz for line in found]


def _start_at(line: _Line, frequency_hz: float) -> _Line:
    """Return the start of a fit: a line as high as the periodogram there."""
    low, high = line.bounds_hz
    start = replace(line, peak_hz=float(np.clip(frequency_hz, low, max(low, high))))
    nearest = [np.argmin(np.abs(line.frequency_hz - start.peak_hz))]
    ratio = float(line.power[nearest][0] / start.spectrum(line.frequency_hz[nearest])[0])
    return replace(start, log_rms=float(np.clip(0.5 * np.log(max(ratio, 1e-6)), -9, 9)))


def _highest_peaks(lines: Sequence[_Line]) -> list[float]:
    """Return the frequencies of as many peaks as there are lines, or fewer."""
    frequency = np.concatenate([line.frequency_hz for line in lines])
    ratio = np.concatenate([line.power / line.rest for line in lines])
    found: list[float] = []
    while len(found) < len(lines) and frequency.size:
        found.append(float(frequency[np.argmax(ratio)]))
        far = np.abs(frequency - found[-1]) >= (_RESOLUTION + 0.5) * lines[0].bin_hz
        frequency, ratio = frequency[far], ratio[far]
    return sorted(found)


def _rest_beside(lines: Sequence[_Line], shared: FloatArray, i: int) -> FloatArray:
    """Return the spectrum of everything but line i, along it."""
    rest = lines[i].rest
    for j, other in enumerate(lines):
        if j != i and shared[i, j] > 0:
            rest = rest + shared[i, j] * other.spectrum(lines[i].frequency_hz)
    return rest


def _fit_in_turn(start: Sequence[_Line], shared: FloatArray, most: int) -> list[_Line] | None:
    """Fit each line beside the others until they stay; None if a fit does not settle."""
    lines = list(start)
    for _ in range(most):
        before = [line.peak_hz for line in lines]
        rms = [np.log(line.last.rms_nm) + line.log_rms for line in lines]
        for i in np.argsort(rms)[::-1].tolist():  # the strongest first
            found = _fit_line(lines[i], _rest_beside(lines, shared, i))
            if found is None:
                return None
            lines[i] = found
        moved = max(abs(line.peak_hz - hz) for line, hz in zip(lines, before, strict=True))
        if moved < _SETTLED_HZ:
            break
    return lines


def _fit_line(start: _Line, rest: FloatArray) -> _Line | None:
    """Fit a line over the rest of the spectrum; None if the fit does not settle."""
    low, high = start.bounds_hz

    def move(p: FloatArray) -> _Line:
        peak_hz, log_rms = p.tolist()
        return replace(start, peak_hz=peak_hz, log_rms=log_rms)

    def contrast(p: FloatArray) -> float:
        inside = low <= p[0] <= high and -10 < p[1] < 10
        return move(p).contrast(rest) if inside else np.inf

    f = float(np.clip(start.peak_hz, low, max(low, high)))
    simplex = np.add([f, start.log_rms], np.array([[0, 0], [0.25 * start.bin_hz, 0], [0, 0.3]]))
    fit = minimize(
        contrast,
        simplex[0],
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-6, "maxiter": 400},
    )
    return move(fit.x) if fit.success and np.isfinite(fit.fun) else None
