"""Continuous-time systems and the bilinear map."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.errors import NumericalError
from lbt_synth.linear import ContinuousSystem, StateSpace


def system(seed=0):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(4, 4)) - 3 * np.eye(4)
    return ContinuousSystem(
        A=A, B=rng.normal(size=(4, 2)), C=rng.normal(size=(3, 4)), D=rng.normal(size=(3, 2))
    )


def test_response_is_that_of_the_mapped_point():
    G, rate = system(), 5.0
    z = np.exp(1j * np.linspace(0.1, 3.0, 20))
    mapped = G.to_discrete(rate)
    frequency_hz = np.angle(z) / (2 * np.pi * mapped.dt_s)
    s = rate * (z - 1) / (z + 1)
    expected = G.frequency_response(s.imag / (2 * np.pi))
    assert mapped.frequency_response(frequency_hz) == pytest.approx(expected, rel=1e-10)


def test_map_and_back():
    G = system()
    back = ContinuousSystem.from_discrete(G.to_discrete(3.0), 3.0)
    for name in "ABCD":
        assert getattr(back, name) == pytest.approx(getattr(G, name), rel=1e-10, abs=1e-12)


@pytest.mark.parametrize("scale", [1e8, 1e12])
def test_units_of_the_states_do_not_matter(scale):
    """A badly scaled matrix was taken for one with a pole at the rate."""
    G, units = system(), np.array([1.0, scale, 1.0, 1 / scale])
    other = ContinuousSystem(
        A=G.A * units / units[:, None], B=G.B / units[:, None], C=G.C * units, D=G.D
    )
    mapped = other.to_discrete(3.0)
    plain = G.to_discrete(3.0)
    grid = np.linspace(0.01, 0.4, 20)
    expected = plain.frequency_response(grid)
    assert mapped.frequency_response(grid) == pytest.approx(expected, rel=1e-9)
    back = ContinuousSystem.from_discrete(mapped, 3.0)
    assert back.frequency_response(grid) == pytest.approx(G.frequency_response(grid), rel=1e-9)


def test_norm_is_kept():
    G = system()
    highest = np.linalg.norm(G.frequency_response(np.geomspace(1e-4, 1e3, 4000)), 2, axis=(1, 2))
    assert float(lbt.hinf_norm(G.to_discrete(2.0))) == pytest.approx(highest.max(), rel=1e-4)


def test_poles_in_the_way():
    with pytest.raises(NumericalError, match=r"pole at 2 1/s"):
        ContinuousSystem(A=2.0, B=1.0, C=1.0, D=0.0).to_discrete(2.0)
    with pytest.raises(NumericalError, match="z = -1"):
        ContinuousSystem.from_discrete(StateSpace(A=-1.0, B=1.0, C=1.0, D=0.0), 1.0)
