"""Controllers as a constant matrix and one transfer function per command, where possible.

The Adaptive Optics Telemetry standard has no state space, but a control matrix and
time filters. A controller ``u(z) = H(z) y(z)`` can be written so when each row of H is a scalar
filter times a constant row: ``H_i(z) = f_i(z) k_i``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lbt_synth.linear import Controller, StateSpace
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray

_POINTS = 64  # frequencies of the comparison
_SAME = 1e-8  # largest difference, relative to the response at each frequency
_NOTHING = 1e-14  # entries smaller than this part of the largest count as zero


class TimeFilters(NamedTuple):
    """Scalar filters after a constant matrix."""

    matrix: FloatArray  # from measurements to filter inputs, (m, q); 1 is each row's largest entry
    numerators: FloatArray  # b_i of ``sum b_i z^i / sum a_i z^i``, (m, order + 1)
    denominators: FloatArray  # a_i


def time_filters(controller: Controller) -> TimeFilters | None:
    """Return a controller's matrix and filters; None if it is not a matrix and scalar filters.

    They agree with the controller's response at 64 frequencies, to 1e-8 of it.
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
    out = np.array(
        [
            [np.pad(p[::-1], (0, size - len(p))) for p in part]
            for part in zip(*polynomials, strict=True)
        ]
    )
    return TimeFilters(matrix=np.array(rows), numerators=out[0], denominators=out[1])


def integrator_gains(numerators: FloatArray, denominators: FloatArray) -> FloatArray | None:
    """Gains g of filters that are all ``g z / (z - 1)``, else None."""
    powers = [np.flatnonzero(np.any(part != 0, axis=0)) for part in (numerators, denominators)]
    if not (np.array_equal(powers[0], [1]) and np.array_equal(powers[1], [0, 1])):
        return None
    lead = denominators[:, 1]
    if not np.all(lead != 0) or not np.allclose(denominators[:, 0] / lead, -1, rtol=1e-12, atol=0):
        return None
    return np.asarray(numerators[:, 1] / lead)


def _constant_row(response: ComplexArray) -> FloatArray | None:
    """Row k of a response (f, q) that is ``f(z) k`` at all frequencies, else None."""
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
    """Numerator and denominator, highest power first, of the scalar filter of one output."""
    b, c = system.B @ row / (row @ row), system.C[output]
    d = float(system.D[output] @ row / (row @ row))
    linked = np.abs(system.A) > _NOTHING * np.max(np.abs(system.A), initial=0.0)
    reached = np.linalg.matrix_power(linked | np.eye(len(linked), dtype=np.bool_), len(linked))
    inside = (reached @ _significant(b)) & (_significant(c) @ reached)
    A, b, c = system.A[np.ix_(inside, inside)], b[inside], c[inside]
    if not inside.any():
        return np.array([d]), np.array([1.0])
    denominator = np.real(np.poly(A))
    numerator = np.real(np.poly(A - np.outer(b, c))) + (d - 1) * denominator
    numerator[~_significant(numerator)] = 0.0
    return numerator, denominator


def _significant(vector: FloatArray) -> BoolArray:
    return np.asarray(np.abs(vector) > _NOTHING * np.max(np.abs(vector), initial=0.0))
