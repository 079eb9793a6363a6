"""A controller as a matrix and one transfer function a command, where it is one.

The Adaptive Optics Telemetry standard has no state space; it has a control matrix and
time filters. A controller ``u(z) = H(z) y(z)`` is that when each row of H is a scalar
filter times a constant row: ``H_i(z) = f_i(z) k_i``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear import Controller, StateSpace
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray

_POINTS = 64
_SAME = 1e-8  # relative to the response, at every point
_NOTHING = 1e-14  # relative to the largest entry: no link between states


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimeFilters:
    """Scalar filters after a constant matrix."""

    # (m, q): from measurements to what is filtered; its largest entry in each row is 1
    matrix: FloatArray
    # numerators, denominators (m, order + 1): coefficients of ``sum b_i z^i / sum a_i z^i``, from i
    # = 0
    numerators: FloatArray
    denominators: FloatArray


def time_filters(controller: Controller) -> TimeFilters | None:
    """Take a controller apart; None if it is no matrix followed by scalar filters.

    What is returned has been compared with the controller's response at 64 frequencies,
    to 1e-8 of it.
    """
    system = controller.to_statespace()
    frequency = np.geomspace(1e-4, 0.497, _POINTS) / system.dt_s
    z = np.exp(2j * np.pi * frequency * system.dt_s)
    response = system.frequency_response(frequency)
    rows, polynomials = [], []
    for i in range(len(system.C)):
        row = _constant_row(response[:, i])
        if row is None:
            return None
        numerator, denominator = _transfer_function(system, i, row)
        scalar = np.polyval(numerator, z) / np.polyval(denominator, z)
        wrong = np.linalg.norm(scalar[:, None] * row - response[:, i], axis=1)
        if not np.all(wrong <= _SAME * np.linalg.norm(response[:, i], axis=1)):
            return None
        rows.append(row)
        polynomials.append((numerator, denominator))
    size = max(len(denominator) for _, denominator in polynomials)
    out = np.zeros((2, len(rows), size))
    for i, pair in enumerate(polynomials):
        for part, polynomial in enumerate(pair):
            out[part, i, : len(polynomial)] = polynomial[::-1]
    return TimeFilters(matrix=np.array(rows), numerators=out[0], denominators=out[1])


def integrator_gains(numerators: FloatArray, denominators: FloatArray) -> FloatArray | None:
    """Gains g of filters that are all ``g z / (z - 1)``; None if one is not."""
    powers = [np.flatnonzero(np.any(part != 0, axis=0)) for part in (numerators, denominators)]
    if not (np.array_equal(powers[0], [1]) and np.array_equal(powers[1], [0, 1])):
        return None
    lead = denominators[:, 1]
    if not np.all(lead != 0) or not np.allclose(denominators[:, 0] / lead, -1, rtol=1e-12, atol=0):
        return None
    return np.asarray(numerators[:, 1] / lead)


def _constant_row(response: ComplexArray) -> FloatArray | None:
    """Row k of a response ``f(z) k`` over frequencies, (f, q); None if it turns."""
    size = np.linalg.norm(response, axis=1)
    if not np.any(size):
        return np.asarray(np.eye(1, response.shape[1])[0])
    shape = response[size > 0] / size[size > 0, None]
    _, values, directions = np.linalg.svd(np.vstack([shape.real, shape.imag]), full_matrices=False)
    if len(values) > 1 and values[1] > _SAME * values[0]:
        return None
    row = np.array(directions[0] / directions[0][np.argmax(np.abs(directions[0]))])
    row[np.abs(row) <= _SAME] = 0.0
    return row


def _transfer_function(
    system: StateSpace, output: int, row: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Polynomials, highest power first, of the scalar filter behind an output."""
    b, c = system.B @ row / (row @ row), system.C[output]
    d = float(system.D[output] @ row / (row @ row))
    linked = np.abs(system.A) > _NOTHING * np.max(np.abs(system.A), initial=0.0)
    inside = _reachable_states(linked, _significant(b)) & _reachable_states(
        linked.T, _significant(c)
    )
    A, b, c = system.A[np.ix_(inside, inside)], b[inside], c[inside]
    if not inside.any():
        return np.array([d]), np.array([1.0])
    denominator = np.real(np.poly(A))
    numerator = np.real(np.poly(A - np.outer(b, c))) + (d - 1) * denominator
    numerator[~_significant(numerator)] = 0.0
    return numerator, denominator


def _significant(vector: FloatArray) -> BoolArray:
    return np.asarray(np.abs(vector) > _NOTHING * np.max(np.abs(vector), initial=0.0))


def _reachable_states(linked: BoolArray, start: BoolArray) -> BoolArray:
    """States that the starting ones drive, themselves included."""
    inside = start
    for _ in range(len(linked)):
        inside = inside | (linked[:, inside].any(axis=1))
    return inside
