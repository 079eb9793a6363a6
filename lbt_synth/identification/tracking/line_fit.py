"""Frequencies of lines by the Whittle likelihood, of neighbouring lines together."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import minimize

from lbt_synth.models import Vibration
from lbt_synth.validation import BoolArray, FloatArray

_EVIDENCE = 20.0  # twice the gain in log likelihood that makes a line
_MOST_ROUNDS = 4
_SETTLED_HZ = 1e-3
_WIDTH, _WIDTH_BESIDE = 1.0, 0.5  # least half width of a single line, and of neighbours [bins]
_RESOLUTION = 2.0  # bins from the top of a line to the first zero of a Hann window's spectrum


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LineSearch:
    """The bins in which a line is searched for, and what they hold."""

    line: Vibration  # as it was found last
    bins: BoolArray  # (k,): frequencies where it may be
    power: FloatArray  # (k,): periodogram along its direction [nm^2/Hz]
    rest: FloatArray  # (k,): spectrum there without the lines that are fitted [nm^2/Hz]


class LineFit:
    """Lines of one periodogram on the frequencies ``grid_hz``, (k,).

    For lines ``beside`` each other, one narrower than a bin has half the width, next to that of
    the window's own peak, so that it does not cover its neighbours.
    """

    def __init__(
        self, grid_hz: FloatArray, *, length_s: float, frame_rate_hz: float, beside: bool = False
    ) -> None:
        self._grid, self._length_s, self._rate = grid_hz, length_s, frame_rate_hz
        self._least_width = _WIDTH_BESIDE if beside else _WIDTH

    def fit_alone(self, search: LineSearch) -> float | None:
        """Return the frequency of a line without neighbours [Hz]; None if it is not there."""
        at, grid = search.bins, self._grid[search.bins]
        peak = float(grid[np.argmax(search.power[at] / search.rest[at])])
        found = self._fit_line(search, search.rest, (peak, 0.0))
        return None if found is None or not self._is_there(search, search.rest, found) else found[0]

    def fit_together(self, searches: list[LineSearch], shared: FloatArray) -> list[float] | None:
        """Return the frequencies of neighbouring lines, in the order that they had [Hz].

        Each is fitted beside the others in turn, from the highest peaks and from where they were
        last; the likelier end counts. ``shared`` (m, m) is the power that one line has along
        another.
        """
        last = [search.line.frequency_hz for search in searches]
        starts = [[self._start_at(s, f) for s, f in zip(searches, last, strict=True)]]
        peaks = self._peaks(searches)
        if peaks is not None:
            starts.append([self._start_at(s, f) for s, f in zip(searches, peaks, strict=True)])
        ends = [end for end in (self._fit_in_turn(searches, shared, s, 1) for s in starts) if end]
        if not ends:
            return None
        best = min(ends, key=lambda end: self._contrast(searches, shared, end))
        end = self._fit_in_turn(searches, shared, best, _MOST_ROUNDS)
        if end is None:
            return None
        for i, search in enumerate(searches):
            if not self._is_there(search, self._spectrum_beside(searches, shared, end, i), end[i]):
                return None
        found = [f for f, _ in end]
        for i, j in combinations(range(len(found)), 2):
            least = _RESOLUTION / self._length_s if shared[i, j] > 0 else 0.0
            if found[j] - found[i] < least:
                return None
        return found

    def _width_hz(self, line: Vibration) -> float:
        # a line narrower than the window's resolution is seen as wide as that
        return max(line.damping * line.frequency_hz, self._least_width / self._length_s)

    def _bounds(self, search: LineSearch) -> tuple[float, float]:
        grid = self._grid[search.bins]
        return max(float(grid[0]), 1.01 * self._width_hz(search.line)), float(grid[-1])

    def _spectrum(self, line: Vibration, at: tuple[float, float], bins: BoolArray) -> FloatArray:
        """Return the spectrum of a line at a frequency and a logarithm of its rms over the last."""
        there = Vibration(
            frequency_hz=at[0],
            damping=self._width_hz(line) / at[0],
            rms_nm=line.rms_nm * float(np.exp(at[1])),
            direction=(1.0,),
        )
        return there.ar_model(self._rate).psd(self._grid[bins])

    def _start_at(self, search: LineSearch, frequency_hz: float) -> tuple[float, float]:
        """Return the start of a fit: a line as high as the periodogram there."""
        low, high = self._bounds(search)
        frequency = float(np.clip(frequency_hz, low, max(low, high)))
        nearest = np.zeros(len(self._grid), dtype=np.bool_)
        nearest[np.argmin(np.abs(self._grid - frequency))] = True
        seen = float(
            search.power[nearest][0] / self._spectrum(search.line, (frequency, 0), nearest)[0]
        )
        return frequency, float(np.clip(0.5 * np.log(max(seen, 1e-6)), -9, 9))

    def _peaks(self, searches: list[LineSearch]) -> list[float] | None:
        """Return the frequencies of as many peaks as there are lines; None if there are fewer."""
        ratio = np.max([np.where(s.bins, s.power / s.rest, 0.0) for s in searches], axis=0)
        found: list[float] = []
        for _ in searches:
            if not np.any(ratio > 0):
                return None
            peak = float(self._grid[np.argmax(ratio)])
            found.append(peak)
            ratio = np.where(
                np.abs(self._grid - peak) * self._length_s < _RESOLUTION + 0.5, 0, ratio
            )
        return sorted(found)

    def _spectrum_beside(
        self, searches: list[LineSearch], shared: FloatArray, at: list[tuple[float, float]], i: int
    ) -> FloatArray:
        """Return the spectrum of everything but line i, along it."""
        bins, rest = searches[i].bins, searches[i].rest.copy()
        for j, other in enumerate(searches):
            if j != i and shared[i, j] > 0:
                rest[bins] += shared[i, j] * self._spectrum(other.line, at[j], bins)
        return rest

    def _fit_in_turn(
        self,
        searches: list[LineSearch],
        shared: FloatArray,
        at: list[tuple[float, float]],
        most: int,
    ) -> list[tuple[float, float]] | None:
        """Fit each line beside the others until they stay."""
        at = list(at)
        for _ in range(most):
            before = [f for f, _ in at]
            heights = [p + np.log(s.line.rms_nm) for s, (_, p) in zip(searches, at, strict=True)]
            for i in np.argsort(heights)[::-1].tolist():  # the strongest first
                found = self._fit_line(
                    searches[i], self._spectrum_beside(searches, shared, at, i), at[i]
                )
                if found is None:
                    return None
                at[i] = found
            if max(abs(f - g) for (f, _), g in zip(at, before, strict=True)) < _SETTLED_HZ:
                break
        return at

    def _contrast(
        self, searches: list[LineSearch], shared: FloatArray, at: list[tuple[float, float]]
    ) -> float:
        total = 0.0
        for i, search in enumerate(searches):
            model = self._spectrum_beside(searches, shared, at, i)[search.bins]
            model = model + self._spectrum(search.line, at[i], search.bins)
            total += _whittle(search.power[search.bins], model)
        return total

    def _fit_line(
        self, search: LineSearch, rest: FloatArray, start: tuple[float, float]
    ) -> tuple[float, float] | None:
        """Return frequency and logarithm of the rms over the last; None if no fit settles."""
        low, high = self._bounds(search)
        at, power, known = search.bins, search.power[search.bins], rest[search.bins]

        def contrast(p: FloatArray) -> float:
            if not low <= p[0] <= high or not -10 < p[1] < 10:
                return np.inf
            model = known + self._spectrum(search.line, (float(p[0]), float(p[1])), at)
            return _whittle(power, model)

        f, p = float(np.clip(start[0], low, max(low, high))), start[1]
        simplex = np.array([[f, p], [f + 0.25 / self._length_s, p], [f, p + 0.3]])
        fit = minimize(
            contrast,
            simplex[0],
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-6, "maxiter": 400},
        )
        return (float(fit.x[0]), float(fit.x[1])) if fit.success and np.isfinite(fit.fun) else None

    def _is_there(self, search: LineSearch, rest: FloatArray, found: tuple[float, float]) -> bool:
        """Whether a line makes the data likelier by enough."""
        power, known = search.power[search.bins], rest[search.bins]
        model = known + self._spectrum(search.line, found, search.bins)
        return 2 * (_whittle(power, known) - _whittle(power, model)) > _EVIDENCE


def _whittle(power: FloatArray, model: FloatArray) -> float:
    return float(np.sum(np.log(model) + power / model))
