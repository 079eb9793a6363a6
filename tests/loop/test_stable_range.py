"""Ranges of gains in which a loop is stable, against the radii of many loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lbt_synth as lbt
from lbt_synth.loop.closed_loop import affine_parts, affine_radii
from lbt_synth.loop.stable_range import stable_interval, stable_range


@given(seed=st.integers(0, 10_000), n=st.integers(1, 8))
def test_ends_of_a_change_of_rank_one_are_where_poles_cross(seed, n):
    rng = np.random.default_rng(seed)
    A, b, c = rng.standard_normal((n, n)), rng.standard_normal((n, 1)), rng.standard_normal((1, n))
    nominal = rng.uniform(0.1, 3)
    loop = rng.uniform(0.5, 0.999) / max(abs(np.linalg.eigvals(A))) * A
    parts = affine_parts((loop - nominal * b @ c)[None], (b @ c)[None])
    low, high = stable_range(parts, nominal)
    assert low < nominal < high
    inside = np.linspace(max(low, nominal / 50), min(high, nominal * 50), 3000)[1:-1]
    assert np.all(affine_radii(parts, inside) < 1 + 1e-9)
    for end in (low, high):
        if 0 < end < np.inf:
            assert affine_radii(parts, np.array([end]))[0] == pytest.approx(1, abs=1e-8)


@pytest.mark.parametrize("width", [1e-2, 1e-4, 1e-6, 1e-8])
def test_poles_beside_the_circle(width):
    """The poles of ``z^2 - g z + (1 - width)^2`` pass 1 where g is 1 plus the last term."""
    A = (1 - width) * np.array([[0.0, 1.0], [-1.0, 0.0]])
    slope = np.array([[0.0, 0.0], [0.0, 1.0]])
    _, high = stable_range(affine_parts(A[None], slope[None]), 1e-3)
    assert high == pytest.approx(1 + (1 - width) ** 2, rel=1e-9)


@pytest.mark.parametrize(
    ("low", "high", "nominal"),
    [(0.35, 1.9, 1.0), (0.0, 1.2, 1.0), (0.97, np.inf, 1.0), (0.4, 5.0, 2.0)],
)
def test_ends_of_a_stable_interval(low, high, nominal):
    found = stable_interval(lambda g: np.where((low < g) & (g < high), 0.5, 1.5), nominal)
    assert found == pytest.approx((low, high), rel=1e-11)


def test_a_stable_interval_ends_at_a_narrow_hole():
    def radii(gains):
        return np.where((gains > 1.3) & (gains < 1.32), 1.5, 0.5)

    assert stable_interval(radii) == pytest.approx((0.0, 1.3), rel=1e-11)
    assert np.all(np.isnan(stable_interval(radii, 1.31)))


@pytest.mark.parametrize("method", ["kalman", "hinf", "integrator"])
def test_modes_that_mix_have_the_range_of_those_that_do_not(method):
    """A turned sensor and a mirror that turns back: the same loop, followed in steps."""
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    plain = lbt.LoopHardware(frame_rate_hz=800)
    mixed = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=turn, influence_matrix=turn.T)
    design = lbt.load_config("examples/lbt.yaml").design(method)
    k = design.controller
    turned = lbt.Controller(A=k.A, B=k.B @ turn.T, C=turn @ k.C, D=turn @ k.D @ turn.T, dt_s=k.dt_s)
    exact = lbt.loop.stable_sensor_gains(plain, design.controller)
    stepped = lbt.loop.stable_sensor_gains(mixed, turned)
    assert stepped == pytest.approx(exact, rel=1e-6)
