"""Mixed filters: bounds that hold, and nothing better to be found."""

from unittest.mock import Mock

import clarabel
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.plants import lbt_axis_plant, random_problem
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.design.mixed import central_filter
from lbt_synth.errors import DimensionError, InfeasibleError, NumericalError, ProblemError
from lbt_synth.models.plant.tip_tilt import retuned_plant


@pytest.fixture(scope="module")
def ends():
    plant = lbt_axis_plant()
    return plant, lbt.hinf(plant, route="riccati"), lbt.kalman(plant)


@pytest.mark.parametrize("ratio", [1.01, 1.1])
def test_less_variance_than_the_central_filter_of_the_same_norm(ends, ratio):
    plant, least, kalman = ends
    bound = ratio * least.gamma_least
    best, central = (make(plant, gamma=bound) for make in (lbt.mixed, central_filter))
    assert (best.gamma, central.gamma) == pytest.approx((bound, bound), rel=1e-6)
    assert kalman.rms < best.rms < central.rms
    assert best.method == "mixed"
    assert lbt.mixed(plant, gamma_ratio=ratio).rms == pytest.approx(best.rms, rel=1e-7)


def test_the_ends_of_the_front(ends):
    plant, least, kalman = ends
    for make in (lbt.mixed, central_filter):
        assert make(plant, gamma=2 * kalman.gamma).rms == pytest.approx(kalman.rms, rel=1e-9)
    assert lbt.mixed(plant, gamma_ratio=1).gamma == pytest.approx(least.gamma, rel=1e-9)


def test_more_taps_never_do_worse_and_converge(ends):
    plant, least, _ = ends
    bound = 1.05 * least.gamma_least
    rms = np.array([lbt.mixed(plant, gamma=bound, taps=taps).rms for taps in (1, 4, 12, 16)])
    assert np.all(rms[1:] <= rms[:-1] * (1 + 1e-7))
    assert rms[2] / rms[3] - 1 < 2e-4


@settings(max_examples=2)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 4), q=st.integers(1, 2), l=st.integers(1, 2))
def test_bounds_hold_on_any_problem(seed, n, q, l):
    problem = random_problem(np.random.default_rng(seed), n, q, l=l)
    least, kalman = lbt.hinf(problem, route="riccati"), lbt.kalman(problem)
    bound = 0.5 * (least.gamma_least + kalman.gamma)
    design, central = lbt.mixed(problem, gamma=bound, taps=6), central_filter(problem, gamma=bound)
    assert design.gamma <= bound * (1 + 1e-6)
    assert kalman.rms * (1 - 1e-9) <= design.rms <= central.rms * (1 + 1e-6)
    assert design.recertify().passed


def test_what_it_leaves_in_its_model(ends):
    design = lbt.mixed(ends[0], gamma_ratio=1.1, taps=8)
    assert design.problem.n_states == ends[0].n_states + 8
    loop = lbt.close_loop(design.hardware, design.controller)
    rms_nm = lbt.residual_budget(loop, ends[0], frame_means=True).rms_nm
    assert rms_nm == pytest.approx(design.rms, rel=1e-9)


def test_refusals(ends):
    def mixed(**options):
        return lambda: lbt.mixed(plant, **options)

    plant, two = ends[0], lbt_axis_plant(modes=2)
    memory = lbt.mixed(plant, gamma_ratio=1.1, taps=4).problem
    taps, again = np.ones((2, 3)), "holds the memory of a mixed"
    require_refusals(
        [
            (mixed(), ProblemError, "give one of gamma and gamma_ratio"),
            (mixed(gamma=200.0, gamma_ratio=1.1), ProblemError, "give one of"),
            (mixed(gamma=100.0), InfeasibleError, "gamma must be at least 155.5"),
            (mixed(gamma_ratio=0.9), ProblemError, "gamma_ratio must be at least 1"),
            (mixed(gamma=np.nan), ProblemError, "gamma must be finite"),
            (mixed(gamma=200.0, taps=0), ProblemError, "taps must be at least 1"),
            (mixed(gamma=200.0, taps=65), ProblemError, "taps must be at most 64"),
            (lambda: plant.with_memory(taps), DimensionError, "taps must have 1 row to match L"),
            (lambda: two.with_memory(taps), DimensionError, "multiple of 2 columns"),
            (lambda: memory.ahead(2), ProblemError, again),
            (lambda: retuned_plant(memory, 1.0), ProblemError, again),
        ]
    )


def test_a_solver_that_panics_is_an_error_of_ours(monkeypatch):
    panic = type("PanicException", (BaseException,), {})  # what the compiled solver raises
    monkeypatch.setattr(clarabel, "DefaultSolver", Mock(side_effect=panic("out of range")))
    walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    with pytest.raises(NumericalError, match="numbers out of its range"):
        lbt.hinf(walk, route="lmi")
    assert lbt.hinf(walk).solver.route == "riccati"  # which takes over where the LMI fails


def test_close_to_the_least_norm_of_two_axes(config):
    """Where the conic solver loses its accuracy with its own scaling, the next setting is tried."""
    design = lbt.mixed(config.plant, gamma_ratio=1.0012)
    assert design.gamma <= 1.0012 * design.gamma_least * (1 + 1e-6)
