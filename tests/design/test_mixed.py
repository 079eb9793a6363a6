"""Mixed filters: bounds that hold, and nothing better to be found."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from support.plants import LBT_YAML, lbt_axis_plant, random_problem

import lbt_synth as lbt
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.models.plant.tip_tilt import retuned_plant


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


@pytest.fixture(scope="module")
def ends(plant):
    return lbt.hinf(plant, route="riccati"), lbt.kalman(plant)


@pytest.mark.parametrize("ratio", [1.01, 1.05, 1.1, 1.2])
def test_less_variance_than_the_central_filter_of_the_same_norm(plant, ends, ratio):
    bound = ratio * ends[0].gamma_least
    best, central = lbt.mixed(plant, gamma=bound), lbt.design.central_filter(plant, gamma=bound)
    assert best.gamma == pytest.approx(bound, rel=1e-6)
    assert central.gamma == pytest.approx(bound, rel=1e-6)
    assert ends[1].rms < best.rms < central.rms
    assert best.method == "mixed"
    assert lbt.mixed(plant, gamma_ratio=ratio).rms == pytest.approx(best.rms, rel=1e-7)


def test_the_ends_of_the_front(plant, ends):
    least, kalman = ends
    assert lbt.mixed(plant, gamma=2 * kalman.gamma).rms == pytest.approx(kalman.rms, rel=1e-9)
    assert lbt.mixed(plant, gamma_ratio=1).gamma == pytest.approx(least.gamma, rel=1e-9)
    assert lbt.design.central_filter(plant, gamma=2 * kalman.gamma).rms == pytest.approx(
        kalman.rms, rel=1e-9
    )
    assert lbt.mixed(plant, rms=2 * least.rms).gamma == pytest.approx(least.gamma, rel=1e-5)


def test_the_reverse_finds_the_same_front(plant, ends):
    bound = 1.08 * ends[0].gamma_least
    there = lbt.mixed(plant, gamma=bound)
    back = lbt.mixed(plant, rms=there.rms)
    assert back.rms <= there.rms * (1 + 1e-6)
    assert back.gamma == pytest.approx(bound, rel=1e-4)


def test_more_taps_never_do_worse_and_converge(plant, ends):
    bound = 1.05 * ends[0].gamma_least
    found = [lbt.mixed(plant, gamma=bound, taps=taps).rms for taps in (1, 4, 16, 48)]
    assert all(more <= fewer * (1 + 1e-7) for fewer, more in itertools.pairwise(found))
    assert found[2] / found[3] - 1 < 2e-4


def test_no_gain_of_the_plants_own_order_does_better(plant, ends):
    """An independent search over all predictor gains, not convex: it ends above."""
    bound = 1.05 * ends[0].gamma_least
    best = lbt.mixed(plant, gamma=bound)
    start = lbt.design.central_filter(plant, gamma=bound).gain_predictor

    def variance(gain):
        error = plant.error_system(gain.reshape(start.shape))
        if not error.spectral_radius < 1:
            return 1e12
        P = stationary_covariance(error.A, error.B @ error.B.T)
        return float(np.trace(plant.L @ P @ plant.L.T))

    def room(gain):
        error = plant.error_system(gain.reshape(start.shape))
        return bound - float(lbt.hinf_norm(error)) if error.spectral_radius < 1 else -1e3

    def variance_slopes(gain):
        error = plant.error_system(gain.reshape(start.shape))
        if not error.spectral_radius < 1:
            return np.zeros(gain.size)
        P = stationary_covariance(error.A, error.B @ error.B.T)
        weight = stationary_covariance(error.A.T, plant.L.T @ plant.L)
        return -2 * (weight @ (error.A @ P @ plant.C.T + error.B @ plant.D.T)).ravel()

    def room_slopes(gain):
        """The gain moves the largest response alone; its frequency makes no difference."""
        error = plant.error_system(gain.reshape(start.shape))
        if not error.spectral_radius < 1:
            return np.zeros(gain.size)
        z = np.exp(2j * np.pi * lbt.hinf_norm(error).peak_frequency_hz * plant.dt_s)
        states = np.linalg.inv(z * np.eye(len(error.A)) - error.A)
        outputs, _, inputs = np.linalg.svd(error.C @ states @ error.B + error.D)
        measured = (plant.C @ states @ error.B + plant.D) @ inputs[0].conj()
        return np.outer(outputs[:, 0].conj() @ error.C @ states, measured).real.ravel()

    unit = np.abs(start.ravel())
    above = {
        "type": "ineq",
        "fun": lambda g: room(g * unit) / 100,
        "jac": lambda g: room_slopes(g * unit) * unit / 100,
    }
    found = minimize(
        lambda g: variance(g * unit) / 1e4,
        start.ravel() / unit,
        method="SLSQP",
        jac=lambda g: variance_slopes(g * unit) * unit / 1e4,
        constraints=[above],
        options={"maxiter": 200, "ftol": 1e-9},
    )
    assert room(found.x * unit) > -1e-6 * bound
    searched = np.sqrt(variance(found.x * unit))
    assert searched < np.sqrt(variance(start.ravel()))  # the search did something
    assert best.rms < searched


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 4), q=st.integers(1, 2), l=st.integers(1, 2))
def test_bounds_hold_on_any_problem(seed, n, q, l):
    problem = random_problem(np.random.default_rng(seed), n, q, l=l)
    least, kalman = lbt.hinf(problem, route="riccati"), lbt.kalman(problem)
    bound = 0.5 * (least.gamma_least + kalman.gamma)
    design = lbt.mixed(problem, gamma=bound, taps=6)
    assert design.gamma <= bound * (1 + 1e-6)
    assert (
        kalman.rms * (1 - 1e-9)
        <= design.rms
        <= lbt.design.central_filter(problem, gamma=bound).rms * (1 + 1e-6)
    )
    assert design.recertify().passed


def test_a_mixed_filter_is_a_design_like_any_other(tmp_path, plant):
    design = lbt.mixed(plant, gamma_ratio=1.1, taps=8)
    assert design.problem.n_states == plant.n_states + 8
    loaded = lbt.load_gain(lbt.save_gain(tmp_path / "mixed.fits", design))
    assert loaded.recertify().passed
    assert loaded.gamma_requested == pytest.approx(1.1 * loaded.gamma_least)
    loop = lbt.close_loop(loaded.hardware, loaded.controller)
    assert loop.is_stable
    truth = lbt.Truth(turbulence=plant.turbulence[0], vibrations=plant.vibrations, noise_nm=15.5)
    left = lbt.residual_budget(loop, truth, frame_means=True)
    assert left.rms_nm == pytest.approx(design.rms, rel=1e-9)


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({}, lbt.errors.ProblemError, "give one of gamma, gamma_ratio and rms"),
        ({"gamma": 200.0, "rms": 140.0}, lbt.errors.ProblemError, "give one of"),
        ({"gamma": 100.0}, lbt.errors.InfeasibleError, "gamma must be at least 155.5"),
        ({"gamma_ratio": 0.9}, lbt.errors.ProblemError, "gamma_ratio must be at least 1"),
        ({"rms": 100.0}, lbt.errors.InfeasibleError, "rms must be at least 135.9"),
        ({"rms": np.nan}, lbt.errors.ProblemError, "rms must be finite"),
        ({"rms": 140.0, "taps": 0}, lbt.errors.ProblemError, "taps must be at least 1"),
        ({"rms": 140.0, "taps": 65}, lbt.errors.ProblemError, "taps must be at most 64"),
    ],
)
def test_wrong_bounds_are_refused(plant, arguments, error, text):
    with pytest.raises(error, match=text):
        lbt.mixed(plant, **arguments)


def test_memory_that_does_not_fit(plant):
    with pytest.raises(lbt.errors.DimensionError, match="taps must have 1 row to match L"):
        plant.with_memory(np.ones((2, 3)))
    with pytest.raises(lbt.errors.DimensionError, match="multiple of 2 columns"):
        lbt_axis_plant(modes=2).with_memory(np.ones((2, 3)))


def test_a_plant_with_memory_is_not_assembled_again(plant):
    design = lbt.mixed(plant, gamma_ratio=1.1, taps=4)
    for again in (
        lambda: design.problem.ahead(2),
        lambda: retuned_plant(design.problem, 1.0),
    ):
        with pytest.raises(lbt.errors.ProblemError, match="holds the memory of a mixed filter"):
            again()


class PanicException(BaseException):
    """What the compiled solver raises, by its name."""


def panic(*arguments, **options):
    raise PanicException("out of range")


def test_a_solver_that_panics_is_an_error_of_ours(monkeypatch):
    import clarabel

    monkeypatch.setattr(clarabel, "DefaultSolver", panic)
    walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    with pytest.raises(lbt.errors.NumericalError, match="numbers out of its range"):
        lbt.hinf(walk, route="lmi")
    assert lbt.hinf(walk).solver.route == "riccati"  # which takes over where the LMI fails


def test_close_to_the_least_norm_of_two_axes():
    """Where the conic solver loses its accuracy with its own scaling, the next setting is tried."""
    plant = lbt.load_config(LBT_YAML).plant
    for ratio in (1.0012, 1.005):
        design = lbt.mixed(plant, gamma_ratio=ratio)
        assert design.gamma <= ratio * design.gamma_least * (1 + 1e-6)


def test_the_demand_is_kept_and_checked(tmp_path, plant):
    design = lbt.mixed(plant, rms=140.0, taps=4)
    assert design.rms_requested == 140.0
    assert "gamma_requested" not in design.claims
    loaded = lbt.load_gain(lbt.save_gain(tmp_path / "m.npz", design))
    assert loaded.rms_requested == 140.0
    assert loaded.recertify().passed
    forged = dataclasses.replace(loaded, claims={**loaded.claims, "rms_requested": 139.0})
    failed = [check.name for check in forged.recertify().checks if not check.passed]
    assert failed == ["standard deviation of the estimation error over its bound, less 1"]
