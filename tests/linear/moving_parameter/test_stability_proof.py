"""Proofs against closed forms, exact arithmetic, sequences, and the circle criterion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.plants import lbt_axis_plant
from support.rational import is_positive_definite, rational

import lbt_synth as lbt
from lbt_synth.linear.moving_parameter.family import ParameterFamily, split_blocks
from lbt_synth.linear.moving_parameter.stability_proof import (
    proof_holds,
    prove_any_speed,
    prove_rate,
)
from lbt_synth.loop.closed_loop import checked_loop_matrices

ONE, GAIN = np.array([[1.0]]), np.array([[-0.5]])
# stable for every constant g in [0, 1], which is the textbook's: both ends are nilpotent
SWITCHED = np.array([[0.0, 0.0], [1.2, 0.0]]), np.array([[0.0, 1.2], [-1.2, 0.0]])


@pytest.fixture(scope="module")
def kalman_loop():
    plant = lbt_axis_plant()
    A0, A1, *_ = checked_loop_matrices(plant.hardware, lbt.kalman(plant).controller)
    low, high = lbt.loop.stable_sensor_gains(plant.hardware, lbt.kalman(plant))
    return A0, A1, low, high


def test_one_state_is_stable_exactly_where_each_constant_gain_is():
    """``|1 - g / 2| < 1`` at both ends is necessary and sufficient."""
    for rate in (None, 1e-3):
        whole = _prove(ONE, GAIN, 1e-6, 4 - 1e-6, rate)
        assert (whole.low, whole.high) == (1e-6, 4 - 1e-6)
        beyond = _prove(ONE, GAIN, 0.5, 4.2, rate)
        assert 3.5 < beyond.high < 4
    assert _prove(ONE, GAIN, 4.1, 5.0, None, nominal=4.5) is None
    assert _prove(ONE, GAIN, 4.1, 5.0, 1e-3, nominal=4.5) is None


def _prove(A0, A1, low, high, rate, nominal=1.0):
    if rate is None:
        return prove_any_speed(A0, A1, low=low, high=high, nominal=nominal)
    family = ParameterFamily.affine(A0, A1, low=low, high=high)
    return prove_rate(family, rate=rate, nominal=nominal)


def test_constant_gains_that_are_stable_and_a_switch_that_is_not():
    """A(0) A(1) is diag(0, 1.44): never proved for any speed, and for slow change it is."""
    A0, A1 = SWITCHED
    assert max(abs(np.linalg.eigvals(A0 + g * A1)).max() for g in np.linspace(0, 1, 99)) < 0.7
    fast = prove_any_speed(A0, A1, low=1e-3, high=1.0, nominal=0.5)
    assert fast.low > 1e-2
    assert fast.high < 0.8
    slow = prove_rate(ParameterFamily.affine(A0, A1, low=1e-3, high=1.0), rate=1e-3, nominal=0.5)
    assert (slow.low, slow.high) == (1e-3, 1.0)
    pair = A0 + fast.low * A1, A0 + fast.high * A1
    assert abs(np.linalg.eigvals(pair[0] @ pair[1])).max() < 1


def test_any_speed_is_the_circle_criterion(kalman_loop):
    A0, A1, low, high = kalman_loop
    proof = prove_any_speed(A0, A1, low=low, high=high, nominal=1.0)
    left, values, right = np.linalg.svd(A1)
    norms = []
    for share in (1.0, 1.01):
        ends = proof.low**share, proof.high**share
        centre, radius = sum(ends) / 2, (ends[1] - ends[0]) / 2
        B, C = left[:, :1] * values[0] * radius, right[:1]
        system = lbt.linear.StateSpace(A=A0 + centre * A1, B=B, C=C, D=[[0.0]])
        norms.append(lbt.hinf_norm(system).value)
    assert norms[0] < 1 < norms[1]


@pytest.mark.parametrize("rate", [None, 1 / 800])
def test_the_inequalities_hold_exactly(kalman_loop, rate):
    """Of P as it stands, at parameters in cells, at nodes and across them; n = 7."""
    A0, A1, low, high = kalman_loop
    proof = _prove(A0, A1, low, high, rate)
    family = ParameterFamily.affine(
        A0, A1, low=low if rate else proof.low, high=high if rate else proof.high
    )
    (block,), _ = split_blocks(family, 1.0)
    own, S = proof.blocks[0], rational(block.S)
    rng = np.random.default_rng(3)

    def P(g):
        i = int(np.clip(np.searchsorted(own.nodes, g) - 1, 0, len(own.nodes) - 2))
        a, b, g = (rational(x).item() for x in (own.nodes[i], own.nodes[i + 1], g))
        between = rational(own.P[i]) * (b - g) + rational(own.P[i + 1]) * (g - a)
        return S.T @ between @ S / (b - a)

    def A(g):
        first, last, g = (rational(x).item() for x in (*family.knots, g))
        ends = rational(family.matrices[0])
        return (ends[0] * (last - g) + ends[1] * (g - first)) / (last - first)

    for g in [proof.low, proof.high, own.nodes[1], *rng.uniform(proof.low, proof.high, 3)]:
        for step in (-1, 1, rng.uniform(-1, 1)) if rate else (0,):
            after = float(np.clip(g + step * (rate or 0), proof.low, proof.high))
            assert is_positive_definite(P(g) - A(g).T @ P(after) @ A(g))
            assert is_positive_definite(P(after))


def test_no_sequence_inside_what_is_proved_grows(kalman_loop):
    A0, A1, low, high = kalman_loop
    rng = np.random.default_rng(4)
    for rate in (None, 0.02):
        proof = _prove(A0, A1, low, high, rate)
        start = rng.uniform(proof.low, proof.high, (200, 1))
        if rate is None:
            hold = np.repeat(rng.random((200, 200)) < 0.5, 2, axis=1)
            courses = np.where(hold, proof.low, proof.high)
        else:  # triangles and random walks
            steps = rate * np.sign(np.sin(rng.uniform(0, 0.2, (200, 1)) * np.arange(400)))
            courses = np.clip(start + np.cumsum(steps, axis=1), proof.low, proof.high)
        product = np.broadcast_to(np.eye(len(A0)), (200, *A0.shape))
        for gains in courses.T:
            product = (A0 + gains[:, None, None] * A1) @ product
        assert np.max(np.abs(product)) < 1


def test_a_proof_is_checked_as_it_stands(kalman_loop):
    A0, A1, low, high = kalman_loop
    proof = _prove(A0, A1, low, high, None)
    family = ParameterFamily.affine(A0, A1, low=proof.low, high=proof.high)
    assert proof_holds(proof, family, 1.0)
    assert not proof_holds(proof, ParameterFamily.affine(A0, A1, low=low, high=high), 1.0)
    own = proof.blocks[0]
    for spoilt in (own.P * [[[1]], [[1 + 1e-9]]], own.P - 1e-3 * np.eye(len(A0)), -own.P):
        wrong = replace(proof, blocks=(replace(own, P=spoilt),))
        assert not proof_holds(wrong, family, 1.0)
    # a slow parameter is proved by the nodes' own functions, which prove nothing of a fast one
    slow = _prove(A0, A1, proof.low, proof.high, 1e-3)
    assert proof_holds(slow, family, 1.0)
    assert not proof_holds(replace(slow, rate=np.inf), family, 1.0)
    assert not proof_holds(replace(slow, rate=0.3), family, 1.0)


def test_two_vertices_may_be_taken_at_any_speed():
    """``x+ = (1 - g (1 + e) / 2) x`` with |e| <= 1/2 is stable for g (1 + e) < 4."""
    knots = np.array([0.5, 1.5, 2.6])
    sides = np.array([0.5, 1.5])[:, None, None, None]
    matrices = 1 - sides * knots[:, None, None] / 2
    proof = prove_rate(ParameterFamily(knots=knots, matrices=matrices), rate=1e-3, nominal=1.0)
    assert (proof.low, proof.high) == (0.5, 2.6)
    wide = ParameterFamily(knots=knots * 1.1, matrices=1 - sides * knots[:, None, None] * 0.55)
    assert 2.4 < prove_rate(wide, rate=1e-3, nominal=1.0).high < 4 / 1.5
