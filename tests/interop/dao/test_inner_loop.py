"""The twin of dao's inner loop, against one that works number by number."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.interop.dao.inner_loop import InnerLoop


def number_by_number(matrix, series, to_actuators, limit):
    """Commands of the loop as its source is read, each operation rounded to single precision."""
    rows, modes = matrix.shape
    order = rows // 2
    to_modes = np.linalg.pinv(to_actuators).astype(np.float32)
    memory = [[np.float32(0)] * rows for _ in range(modes)]
    out = []
    for y in series:
        u = np.zeros(modes, dtype=np.float32)
        for mode in range(modes):
            past = memory[mode]
            past[: order + 1] = [np.float32(y[mode]), *past[:order]]
            total = matrix[0, mode] * past[0]
            for row in range(1, rows):
                total = np.float32(total + np.float32(matrix[row, mode] * past[row]))
            u[mode] = total
        volts = -(to_actuators @ u)
        if max(abs(volts)) > limit:
            u = -(to_modes @ np.clip(volts, -limit, limit))
        for mode in range(modes):
            past = memory[mode]
            past[order + 1 :] = [u[mode], *past[order + 1 : -1]]
        out.append(u)
    return np.array(out)


@pytest.mark.parametrize("limit", [np.float32(np.inf), np.float32(0.8)])
def test_it_gives_the_commands_bit_for_bit(limit):
    rng = np.random.default_rng(1)
    matrix = (0.2 * rng.standard_normal((9, 3))).astype(np.float32)
    to_actuators = rng.standard_normal((5, 3)).astype(np.float32)
    series = rng.standard_normal((200, 3)).astype(np.float32)
    loop = InnerLoop(matrix, to_actuators, limit=limit)
    found = np.array([loop.step(y) for y in series])
    expected = number_by_number(matrix, series, to_actuators, limit)
    assert np.array_equal(found, expected)
    assert np.any(np.abs(expected @ to_actuators.T) > 1.5) != np.isfinite(limit)
    loop.reset()
    assert np.array_equal(loop.step(series[0]), expected[0])


def test_rows_are_b_then_a():
    rng = np.random.default_rng(2)
    b, a = 0.3 * rng.standard_normal(4), 0.2 * rng.standard_normal(3)
    series = rng.standard_normal(50)
    loop = InnerLoop(np.concatenate([b, a])[:, None])
    found = [loop.step([y])[0] for y in series]
    assert np.allclose(found, lfilter(b, [1, *-a], series), atol=1e-5)


@pytest.mark.parametrize(("rows", "actuators"), [(4, 2), (3, 3)])
def test_what_does_not_fit_is_refused(rows, actuators):
    with pytest.raises(lbt.errors.DimensionError):
        InnerLoop(np.zeros((rows, 2)), np.zeros((5, actuators)))
