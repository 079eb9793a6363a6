"""How much faster the clock of accelerometers runs than that of the wavefront.

A difference of the rates turns the phase between a channel and a line in proportion to time. The
cross-spectra of some parts of a record show it, each divided by the root of the line's own power
there. For a pair whose noise is not known, the likelihood of M parts of which the share s of the
power follows one factor is ``(1 - s)^-M``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lbt_synth.identification.accelerometers.line_bands import LineBand
from lbt_synth.identification.stretches import Stretches
from lbt_synth.validation import ComplexArray, FloatArray

_PARTS = 16
_SHORTEST_PART = 1024  # frames
_FEWEST_PARTS = 4
LARGEST = 1e-3  # relative
_STEP = 0.3  # rad, by which the ends of a record turn from one trial to the next
_TINY = 1e-300
_MOST = 1 - 1e-9  # share of the power that follows a factor
_CLEARLY = 10.0  # by which a difference must be likelier than none

Bands = Callable[[Stretches], Sequence[LineBand]]


def clock_rate(bands: Bands, stretches: Stretches) -> float:
    """Return by how much the readings' clock is faster, relative; 0 where none is clear."""
    parts = _cut(stretches)
    if len(parts) < _FEWEST_PARTS:
        return 0.0
    found = [_products(bands((part,))) for part in parts]
    angle = found[0][0]  # (lines,)
    roots = np.array([each for _, each, _ in found])  # (parts, lines)
    products = np.array([each for _, _, each in found])  # (parts, lines, channels)
    middle = np.array([(start + stop) / 2 for start, stop in parts])
    middle = np.asarray(middle - middle.mean(), dtype=np.float64)
    step = _STEP / (float(angle.max()) * float(np.ptp(middle)) / 2)
    count = int(np.ceil(LARGEST / step))
    tried: FloatArray = np.arange(-count, count + 1.0) * step
    score = _scores(products, roots, angle, middle, tried)
    best = int(np.argmax(score))
    if score[best] < score[count] + _CLEARLY or best in (0, len(tried) - 1):
        return 0.0
    for fine in (step / 5, step / 50):
        near = tried[best] + np.arange(-10, 11) * fine
        tried, score = near, _scores(products, roots, angle, middle, near)
        best = int(np.argmax(score))
    return float(tried[best])


def _cut(stretches: Stretches) -> list[tuple[int, int]]:
    """Return parts of equal length of the stretches."""
    length = max(sum(stop - start for start, stop in stretches) // _PARTS, _SHORTEST_PART)
    return [
        (first, first + length)
        for start, stop in stretches
        for first in range(start, stop - length + 1, length)
    ]


def _products(bands: Sequence[LineBand]) -> tuple[FloatArray, FloatArray, ComplexArray]:
    """Return each line's frequency [rad per frame], root of its power, and cross-spectra."""
    angle, roots, products = [], [], []
    for band in bands:
        for j, line in enumerate(band.lines):
            core = band.core[:, j]
            x = band.expected[core, line]
            angle.append(float(np.mean(band.angle[core])))
            roots.append(max(float(np.linalg.norm(x)), _TINY))
            products.append(x.conj() @ band.readings[core] / roots[-1])
    return np.array(angle), np.array(roots), np.array(products)


def _scores(
    products: ComplexArray,
    roots: FloatArray,
    angle: FloatArray,
    middle: FloatArray,
    rates: FloatArray,
) -> FloatArray:
    """Return the log-likelihood of each rate, for factors of any size and phase."""
    power = np.sum(np.abs(products) ** 2, axis=0)
    seen = power > 0
    out = np.zeros(len(rates))
    for j, line in enumerate(angle):
        turns = roots[:, j] * np.exp(1j * line * rates[:, None] * middle)
        own = power[j, seen[j]] * np.sum(roots[:, j] ** 2)
        share = np.abs(turns @ products[:, j, seen[j]]) ** 2 / own
        out -= len(products) * np.sum(np.log1p(-np.minimum(share, _MOST)), axis=1)
    return out
