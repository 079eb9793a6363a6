"""Controllers as a constant matrix and one transfer function per command, where possible.

The Adaptive Optics Telemetry standard has no state space, but a control matrix and
time filters. A controller ``u(z) = H(z) y(z)`` can be written so when each row of H is a scalar
filter times a constant row: ``H_i(z) = f_i(z) k_i``.
"""

from __future__ import annotations

import numpy as np

from lbt_synth.linear import Controller, StateSpace
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray

_POINTS = 64  # frequencies of the comparison
_SAME = 1e-8  # largest difference, relative to the response at each frequency
_NOTHING = 1e-14  # of the largest coefficient of a numerator; less counts as zero
_COUPLED = 1e-9  # of the largest entry of a matrix; less is what a solver leaves of a zero


def time_filters(controller: Controller) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return a controller as a constant matrix and scalar filters after it; None if it is none.

    The matrix (m, q) is from measurements to the inputs of the filters; the largest entry of each
    row is 1. A filter is ``sum b_i z^i / sum a_i z^i``, with b and a (m, order + 1). They agree
    with the controller's response at 64 frequencies, to 1e-8 of it.
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
        numerator, denominator = transfer_function(system, i, row)
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
    return np.array(rows), out[0], out[1]


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


def transfer_function(
    system: StateSpace, output: int, row: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the scalar filter of one output, for measurements along a row.

    Numerator and denominator have their highest power first. States that the measurements do not
    drive, or that do not show in the output, are left out. What overflows is not a number.
    """
    size = row @ row
    b, c, d = system.B @ row / size, system.C[output], float(system.D[output] @ row / size)
    linked = is_significant(system.A) | np.eye(system.n_states, dtype=np.bool_)
    reached = np.linalg.matrix_power(linked, system.n_states)
    inside = (reached @ is_significant(b)) & (is_significant(c) @ reached)
    A = system.A[np.ix_(inside, inside)]
    with np.errstate(all="ignore"):
        entry = np.outer(b[inside], c[inside])
        scale = 1 / (np.max(np.abs(entry), initial=0.0) or 1.0)
        # det(zI - A + b c) = det(zI - A) + c adj(zI - A) b
        den, moved = _characteristic(A), _characteristic(A - scale * entry)
        num = d * den + (moved - den) / scale
    num[np.abs(num) <= _NOTHING * np.max(np.abs(num))] = 0.0
    return num, den


def _characteristic(A: FloatArray) -> FloatArray:
    """Return the characteristic polynomial, highest power first."""
    if not A.size:
        return np.ones(1)
    finite = bool(np.all(np.isfinite(A)))
    return np.asarray(np.real(np.poly(A))) if finite else np.full(len(A) + 1, np.nan)


def is_significant(entries: FloatArray) -> BoolArray:
    """Return which entries are more than what a solver leaves of a zero."""
    return np.asarray(np.abs(entries) > _COUPLED * np.max(np.abs(entries), initial=0.0))
