"""Functions and constraints of a coefficient vector, as arrays, for conic programmes.

A response that is affine in the real coefficients c, at F frequencies, is written
``centre + rows c``. Loop shaping needs sums of squares of such responses, their largest
value, and discs and half-planes in the complex plane. If the gain of the loop is not the
nominal one, a response also has a denominator ``1 - steering c``.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np

from lbt_synth.validation import ComplexArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fractions:
    """Sum, or largest, over F frequencies of ``|centres + rows c|^2 / |1 - steering c|^2``."""

    frequency_hz: FloatArray  # (F,)
    rows: ComplexArray  # (F, r, n): slopes of the r numerators at each frequency
    centres: ComplexArray  # (F, r): their values at c = 0
    steering: ComplexArray | None  # (F, n): slopes of the denominators; None if they are all 1
    worst: bool  # the largest instead of the sum

    def denominators(self, c: FloatArray) -> ComplexArray:
        """Denominators before they are squared, (F,)."""
        if self.steering is None:
            return np.ones(len(self.centres), dtype=np.complex128)
        return np.asarray(1 - self.steering @ c)

    def value(self, c: FloatArray) -> float:
        """Value at coefficients c."""
        values = self.values(c)
        return float(np.max(values) if self.worst else np.sum(values))

    def values(self, c: FloatArray) -> FloatArray:
        """Value of each fraction at coefficients c, (F,)."""
        squares = np.sum(np.abs(self.centres + self.rows @ c) ** 2, axis=1)
        return np.asarray(squares / np.abs(self.denominators(c)) ** 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Discs:
    """``|centres + rows c| <= radii``, frequency by frequency."""

    frequency_hz: FloatArray
    rows: ComplexArray
    centres: ComplexArray
    radii: FloatArray

    def use(self, c: FloatArray) -> FloatArray:
        """Share of each bound that is used, (F,): 1 at the bound."""
        return np.asarray(np.abs(self.centres + self.rows @ c) / self.radii)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HalfPlanes:
    """``rows c <= bounds``, frequency by frequency; the bounds are positive."""

    frequency_hz: FloatArray
    rows: FloatArray
    bounds: FloatArray

    def use(self, c: FloatArray) -> FloatArray:
        """Share of each bound that is used, (F,): 1 at the bound."""
        return np.asarray(self.rows @ c / self.bounds)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FunctionBound:
    """A function that must stay below a limit."""

    function: Fractions
    limit: float


Function: TypeAlias = tuple[Fractions, ...]  # their sum
Constraint: TypeAlias = Discs | HalfPlanes | FunctionBound


def total_value(function: Function, c: FloatArray) -> float:
    """Return the value of a function at coefficients c."""
    return sum(part.value(c) for part in function)


def merge_constraints(groups: tuple[tuple[Constraint, ...], ...]) -> tuple[Constraint, ...]:
    """Concatenate the constraints of each kind, so that there are fewer, larger blocks."""
    constraints = [constraint for group in groups for constraint in group]
    out: list[Constraint] = [c for c in constraints if isinstance(c, FunctionBound)]
    for kind in (Discs, HalfPlanes):
        parts = [c for c in constraints if isinstance(c, kind)]
        if parts:
            names = [field.name for field in fields(kind)]
            arrays = {n: np.concatenate([getattr(part, n) for part in parts]) for n in names}
            out.append(kind(**arrays))
    return tuple(out)
