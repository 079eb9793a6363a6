"""Programmes given to the solver as arrays, against the same programmes stated in cvxpy."""

import cvxpy as cp
import numpy as np
import pytest

from lbt_synth.linear import convex_functions
from lbt_synth.linear.convex_functions import Discs, Fractions, FunctionBound, HalfPlanes
from lbt_synth.linear.lmi.conic_program import minimize, minimize_relaxation

SIZE, COUNT = 4, 20
FREQUENCY_HZ = np.linspace(0, 0.5, COUNT)


def normal(rng, *shape):
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def fractions(rng, *, worst=False):
    facts = {"rows": normal(rng, COUNT, 2, SIZE), "centres": normal(rng, COUNT, 2)}
    return Fractions(frequency_hz=FREQUENCY_HZ, **facts, steering=None, worst=worst)


def stated(function, c):
    values = [
        cp.sum_squares(cp.abs(centre + rows @ c))
        for centre, rows in zip(function.centres, function.rows, strict=True)
    ]
    return cp.maximum(*values) if function.worst else sum(values)


def constraints(rng, c):
    """Return a set of each kind of constraint, and the same stated in cvxpy."""
    rows, centres = 0.3 * normal(rng, COUNT, SIZE), 0.1 * normal(rng, COUNT)
    facts = {"rows": rows, "centres": centres, "radii": np.full(COUNT, 0.4)}
    discs = Discs(frequency_hz=FREQUENCY_HZ, **facts)
    half_rows, bound = rng.standard_normal((COUNT, SIZE)), fractions(rng)
    facts = {"rows": half_rows, "bounds": np.full(COUNT, 0.05)}
    half_planes = HalfPlanes(frequency_hz=FREQUENCY_HZ, **facts)
    limit = 1.02 * bound.value(np.zeros(SIZE))
    ours = (discs, half_planes, FunctionBound(function=bound, limit=limit))
    peer = [cp.abs(centres + rows @ c) <= discs.radii, half_rows @ c <= half_planes.bounds]
    return ours, [*peer, stated(bound, c) <= limit]


@pytest.mark.parametrize(
    ("kinds", "start"),
    [((False,), True), ((True,), False), ((False, True), False), ((False, True), True)],
)
def test_the_optimum_is_that_of_the_statement(kinds, start):
    """Of a sum, the largest of some, and a sum of both."""
    rng, c = np.random.default_rng(1), cp.Variable(SIZE)
    mean_or_worst = fractions(rng), fractions(rng, worst=True)
    function = tuple(mean_or_worst[worst] for worst in kinds)
    ours, peer = constraints(rng, c)
    whole = sum(stated(part, c) for part in function)
    least = cp.Problem(cp.Minimize(whole), peer).solve(solver=cp.CLARABEL)
    origin = 0.05 * rng.standard_normal(SIZE) if start else None
    scale = convex_functions.total_value(function, np.zeros(SIZE))
    coefficients, status = minimize(function, ours, size=SIZE, scale=scale, start=origin)
    assert status == "optimal"
    assert convex_functions.total_value(function, coefficients) == pytest.approx(least, rel=1e-6)
    np.testing.assert_allclose(coefficients, c.value, atol=2e-3)
    free = cp.Problem(cp.Minimize(whole)).solve(solver=cp.CLARABEL)
    assert least > free * (1 + 1e-4)  # the constraints matter


def test_constraints_that_cannot_hold_are_relaxed_as_stated():
    rows, zero = np.eye(1, SIZE) + 0.2, np.zeros(1)
    first = HalfPlanes(frequency_hz=zero, rows=rows, bounds=np.ones(1))
    second = Discs(frequency_hz=zero, rows=-rows + 0j, centres=zero + 4 + 0j, radii=np.ones(1))
    function, groups = (fractions(np.random.default_rng(2)),), ((first,), (second,))
    _, status = minimize(function, (first, second), size=SIZE, scale=1.0)
    assert status.startswith("infeasible")
    for rigid, needed in ((True, False), 2), ((False, False), 2), ((True, True), np.inf):
        relaxation = minimize_relaxation(groups, size=SIZE, rigid=rigid)
        assert np.sum(relaxation) == pytest.approx(needed, abs=1e-6)
