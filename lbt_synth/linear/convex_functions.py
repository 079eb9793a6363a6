"""Convex functions and sets of a coefficient vector, as arrays: what a conic programme is made of.

A response that is affine in the real coefficients c, at F frequencies, is written
``centre + rows c``; sums of squares of such responses, their largest, discs and half-planes
in the complex plane are all that the shaping of a loop needs. At a sensor gain other than
one a response has a denominator ``1 - steering c`` as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from lbt_synth.validation import ComplexArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fractions:
    """Sum, or largest, over F frequencies of ``|centres + rows c|^2 / |1 - steering c|^2``."""

    frequency_hz: FloatArray  # (F,): the frequencies
    rows: ComplexArray  # (F, r, n): slopes of the r numerators at each frequency
    centres: ComplexArray  # (F, r): their values without c
    # (F, n): slopes of the denominators; None where they are 1, and the function is convex
    steering: ComplexArray | None
    worst: bool  # Largest instead of sum

    def numerators(self, c: FloatArray) -> FloatArray:
        """Squares of the numerators, (F,)."""
        return np.asarray(np.sum(np.abs(self.centres + self.rows @ c) ** 2, axis=1))

    def denominators(self, c: FloatArray) -> ComplexArray:
        """Denominators before the square, (F,)."""
        if self.steering is None:
            return np.ones(len(self.centres), dtype=np.complex128)
        return np.asarray(1 - self.steering @ c)

    def value(self, c: FloatArray) -> float:
        """Value at coefficients c."""
        values = self.values(c)
        return float(np.max(values) if self.worst else np.sum(values))

    def values(self, c: FloatArray) -> FloatArray:
        """Fractions at coefficients c, (F,)."""
        return np.asarray(self.numerators(c) / np.abs(self.denominators(c)) ** 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Discs:
    """``|centres + rows c| <= radii``, frequency by frequency."""

    frequency_hz: FloatArray
    rows: ComplexArray
    centres: ComplexArray
    radii: FloatArray

    def use(self, c: FloatArray) -> FloatArray:
        """How much of each bound is used, (F,): 1 at the bound."""
        return np.asarray(np.abs(self.centres + self.rows @ c) / self.radii)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HalfPlanes:
    """``rows c <= bounds``, frequency by frequency; the bounds are positive."""

    frequency_hz: FloatArray
    rows: FloatArray
    bounds: FloatArray

    def use(self, c: FloatArray) -> FloatArray:
        """How much of each bound is used, (F,): 1 at the bound."""
        return np.asarray(self.rows @ c / self.bounds)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bounded:
    """A function below a limit."""

    function: Fractions
    limit: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Combined:
    """Weighted sum, or largest weighted one, of functions."""

    parts: tuple[Fractions | Combined, ...]
    weights: tuple[float, ...]
    worst: bool

    def value(self, c: FloatArray) -> float:
        """Value at coefficients c."""
        values = [w * part.value(c) for w, part in zip(self.weights, self.parts, strict=True)]
        return max(values) if self.worst else sum(values)


Function: TypeAlias = Fractions | Combined
Constraint: TypeAlias = Discs | HalfPlanes | Bounded


def is_convex(function: Function) -> bool:
    """Whether no denominator depends on the coefficients."""
    return all(leaf.steering is None for leaf in fractions(function))


def fractions(function: Function) -> tuple[Fractions, ...]:
    """Return the leaves of a function, in order."""
    if isinstance(function, Combined):
        return tuple(leaf for part in function.parts for leaf in fractions(part))
    return (function,)


def without_denominators(function: Function) -> Function:
    """Return the function with all denominators set to one: its value at unit sensor gain."""
    if isinstance(function, Combined):
        return replace(function, parts=tuple(without_denominators(p) for p in function.parts))
    return replace(function, steering=None)


def merged(constraints: tuple[Constraint, ...]) -> tuple[Constraint, ...]:
    """Return the constraints with those of one kind put together: fewer, larger blocks."""
    discs = [c for c in constraints if isinstance(c, Discs)]
    planes = [c for c in constraints if isinstance(c, HalfPlanes)]
    out: list[Constraint] = [c for c in constraints if isinstance(c, Bounded)]
    if discs:
        out.append(
            Discs(
                frequency_hz=np.concatenate([d.frequency_hz for d in discs]),
                rows=np.concatenate([d.rows for d in discs]),
                centres=np.concatenate([d.centres for d in discs]),
                radii=np.concatenate([d.radii for d in discs]),
            )
        )
    if planes:
        out.append(
            HalfPlanes(
                frequency_hz=np.concatenate([p.frequency_hz for p in planes]),
                rows=np.concatenate([p.rows for p in planes]),
                bounds=np.concatenate([p.bounds for p in planes]),
            )
        )
    return tuple(out)
