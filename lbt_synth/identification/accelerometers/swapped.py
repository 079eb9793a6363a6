"""Channels that move as two others did in an earlier model: their cables were exchanged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

_NEAR = 0.05  # of a frequency, within which two lines are the same
_CHANGE = 0.1  # of a factor, from one night to another
_CLEARLY = 25.0  # by which the squared errors must fall
_FITS = 4.0  # mean squared error of exchanged channels, at most

EarlierLine = tuple[float, Mapping[str, complex]]  # frequency [Hz], factors by channel
Factor = tuple[float, complex, float]  # frequency [Hz], factor, standard error


def swapped_channels(
    found: Mapping[str, Sequence[Factor]], earlier: Sequence[EarlierLine]
) -> dict[str, str]:
    """Return the channels that are exchanged, each with the other's name."""
    known = sorted({name for _, factors in earlier for name in factors} & found.keys())
    out: dict[str, str] = {}
    for a, b in combinations(known, 2):
        own = [*_misfits(found[a], earlier, a), *_misfits(found[b], earlier, b)]
        other = [*_misfits(found[a], earlier, b), *_misfits(found[b], earlier, a)]
        if sum(own) - sum(other) > _CLEARLY and sum(other) < _FITS * len(other):
            out |= {a: b, b: a}
    return out


def _misfits(
    factors: Sequence[Factor], earlier: Sequence[EarlierLine], channel: str
) -> list[float]:
    """Return squared errors of factors against those of a channel in the earlier model."""
    out = []
    for frequency, factor, error in factors:
        then, before = min(earlier, key=lambda line: abs(line[0] - frequency))
        if abs(then - frequency) > _NEAR * frequency:
            continue
        expected = before.get(channel, 0.0)
        change = _CHANGE * max(abs(factor), abs(expected))
        out.append(abs(factor - expected) ** 2 / (2 * error**2 + change**2))
    return out
