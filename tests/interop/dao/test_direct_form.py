"""Controllers as matrices of a direct form, and those matrices as controllers."""

from dataclasses import replace
from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, NumericalError, ProblemError
from lbt_synth.interop.dao.direct_form import (
    InnerLoop,
    direct_form,
    direct_form_rows,
    mode_polynomials,
)

BALANCE = 1e-13  # of a coefficient


def difference_equation(rows, series):
    """Commands of ``u(k) = sum b_j y(k-j) + sum a_i u(k-i)``, word for word."""
    order = len(rows) // 2
    y, u = (np.zeros((len(series) + order, rows.shape[1])) for _ in range(2))
    y[order:] = series
    for k in range(order, len(y)):
        u[k] = sum(rows[j] * y[k - j] for j in range(order + 1))
        u[k] += sum(rows[order + i] * u[k - i] for i in range(1, order + 1))
    return u[order:]


@given(seed=st.integers(0, 2**32 - 1), orders=st.lists(st.integers(1, 5), min_size=1, max_size=3))
def test_modes_of_any_order(seed, orders):
    """Modes of different orders, some without feedthrough, some with states of no effect."""
    rng = np.random.default_rng(seed)
    n, m = sum(orders), len(orders)
    A, B, C, D = np.zeros((n, n)), np.zeros((n, m)), np.zeros((m, n)), np.zeros((m, m))
    start = 0
    for mode, order in enumerate(orders):
        states = slice(start, start + order)
        start += order
        block = rng.standard_normal((order, order))
        A[states, states] = block * (0.9 / np.max(np.abs(np.linalg.eigvals(block))))
        B[states, mode] = rng.standard_normal(order) * rng.choice([0, 1])
        C[mode, states] = rng.standard_normal(order)
        D[mode, mode] = rng.standard_normal() * rng.choice([0, 1])
    turn = rng.permutation(n)
    controller = lbt.Controller(A=A[np.ix_(turn, turn)], B=B[turn], C=C[:, turn], D=D)
    rows = direct_form_rows(controller, 6)
    series = rng.standard_normal((100, m))
    run, again = controller.start(), direct_form(rows, 1.0).start()
    expected = np.array([run.step(y) for y in series])
    size = 1e-9 * max(1.0, np.max(np.abs(expected)))
    assert np.max(np.abs(difference_equation(rows, series) - expected)) < size
    assert np.max(np.abs([again.step(y) for y in series] - expected)) < size


def test_coefficients_of_close_poles():
    """(z - r)^8 with r = 1 - 2^-10, next to the binomials of exact numbers."""
    r, n = 1 - 2.0**-10, 8
    A = r * np.eye(n) + np.eye(n, k=1)
    C, B = np.eye(n)[:1], np.eye(n)[:, -1:]
    ((num, den),) = mode_polynomials(lbt.Controller(A=A, B=B, C=C, D=[[0.0]]))
    exact = [comb(n, k) * (-1) ** k * 1023**k / 1024**k for k in range(n + 1)]
    assert den == pytest.approx(exact, abs=BALANCE * max(exact))
    assert num == pytest.approx([0.0] * (n - 1) + [1.0, 0.0], abs=BALANCE * max(exact))


def test_states_of_the_other_mode_and_delays_in_both_are_left_out(designs):
    controller = designs["kalman"].controller
    for num, den in mode_polynomials(controller):
        assert num.shape == den.shape == (5,)  # of ten states, five are the other mode's, one is z
        own = np.linalg.eigvals(controller.A)
        assert all(np.min(np.abs(own - pole)) < 1e-9 for pole in np.roots(den))


def test_an_integrator_is_the_textbook_one(loaded):
    slow = lbt.integrator(loaded.hardware, gain=0.25)
    assert direct_form_rows(slow.controller, 1).tolist() == [[0.25] * 2, [0.0] * 2, [1.0] * 2]


def test_modes_that_do_not_decouple(loaded):
    slanted = replace(loaded.plant.vibrations[0], direction=(0.6, 0.8))
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=loaded.plant.turbulence,
        vibrations=[slanted],
        noise_nm=loaded.noise_nm,
    )
    with pytest.raises(ProblemError, match="here measurement 2 moves command 1"):
        mode_polynomials(lbt.kalman(plant).controller)
    direct = lbt.Controller(A=[[0.0]], B=[[0.0, 0.0]], C=[[0.0], [0.0]], D=[[1.0, 0.0], [0.5, 1.0]])
    with pytest.raises(ProblemError, match="here measurement 1 moves command 2"):
        mode_polynomials(direct)
    wide = lbt.Controller(A=[[0.5]], B=[[1.0, 2.0]], C=[[1.0]], D=[[0.0, 0.0]])
    with pytest.raises(ProblemError, match="got 1 commands and 2 measurements"):
        mode_polynomials(wide)


def test_coefficients_beyond_the_range_are_refused():
    big = lbt.Controller(A=np.eye(2, k=1), B=[[0.0], [1e30]], C=[[1e30, 0.0]], D=[[0.0]])
    with np.errstate(over="ignore"):
        rows = direct_form_rows(big, 2).astype(np.float32)
    for beyond in (rows, [[np.inf], [0.0], [1.0]], [[np.nan], [0.0], [1.0]]):
        with pytest.raises(NumericalError, match="beyond its range"):
            direct_form(np.array(beyond), 1.0)


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
    with pytest.raises(DimensionError):
        InnerLoop(np.zeros((rows, 2)), np.zeros((5, actuators)))
