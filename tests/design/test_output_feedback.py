"""Controllers of generalised plants: H2, H-infinity and mixed, and why there is none."""

from dataclasses import replace

import control
import cvxpy as cp
import numpy as np
import pytest
from scipy.linalg import block_diag, solve_discrete_lyapunov
from support.generalized_plants import random_plant, sampled
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import DetectabilityError, InfeasibleError, ProblemError
from lbt_synth.linear import GeneralizedPlant, StateSpace
from lbt_synth.linear.output_feedback.two_riccati import free_parameter, scaled_plant


def common_lyapunov_rms(plant, gamma):
    """Bound on the standard deviation that one Lyapunov matrix for both norms proves.

    C. Scherer, P. Gahinet, M. Chilali, IEEE Trans. Autom. Control 42, 896 (1997),
    doi:10.1109/9.599969, in discrete time.
    """
    n, (m1, m2, p1, p2) = len(plant.A), plant.sizes
    P = replace(plant, C1=plant.C1 / gamma, D11=plant.D11 / gamma, D12=plant.D12 / gamma)
    X, Y = (cp.Variable((n, n), symmetric=True) for _ in range(2))
    A, B, C, D = (cp.Variable(size) for size in ((n, n), (n, p2), (m2, n), (m2, p2)))
    W = cp.Variable((p1, p1), symmetric=True)
    J = cp.bmat([[X, np.eye(n)], [np.eye(n), Y]])
    AT = cp.bmat([[P.A @ X + P.B2 @ C, P.A + P.B2 @ D @ P.C2], [A, Y @ P.A + B @ P.C2]])
    BT = cp.vstack([P.B1 + P.B2 @ D @ P.D21, Y @ P.B1 + B @ P.D21])
    CT = cp.hstack([P.C1 @ X + P.D12 @ C, P.C1 + P.D12 @ D @ P.C2])
    DT = P.D11 + P.D12 @ D @ P.D21
    none, across = np.zeros((2 * n, p1)), np.zeros((2 * n, m1))
    decay = [[J, AT, BT], [AT.T, J, across], [BT.T, across.T, np.eye(m1)]]
    output = [[W, CT, DT], [CT.T, J, across], [DT.T, across.T, np.eye(m1)]]
    sides = none, CT.T, DT.T
    norm = [[*row, side] for row, side in zip(decay, sides, strict=True)]
    norm.append([none.T, CT, DT, np.eye(p1)])
    blocks = [cp.bmat(rows) for rows in (norm, decay, output)]
    programme = cp.Problem(cp.Minimize(cp.trace(W)), [(M + M.T) / 2 >> 0 for M in blocks])
    programme.solve(solver=cp.CLARABEL, tol_gap_rel=1e-5, tol_gap_abs=1e-5, tol_feas=1e-6)
    return gamma * float(np.sqrt(programme.value))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_singular_feedthrough(seed):
    """A control without a weight and a measurement without noise: the limit of small ones."""
    plant = random_plant(seed, n=4, D12=0.0 if seed % 2 else None, D21=0.0 if seed % 3 else None)
    _, m2, _, p2 = plant.sizes
    noise, weight = 1e-5 * np.eye(p2), 1e-5 * np.eye(m2)
    near = replace(
        plant,
        B1=np.pad(plant.B1, ((0, 0), (0, p2))),
        C1=np.pad(plant.C1, ((0, m2), (0, 0))),
        D11=np.pad(plant.D11, ((0, m2), (0, p2))),
        D12=np.vstack([plant.D12, weight]),
        D21=np.hstack([plant.D21, noise]),
    )
    singular, least = lbt.hinf_controller(plant), lbt.hinf_controller(near).gamma_least
    assert singular.gamma_least == pytest.approx(least, rel=1e-4)
    assert singular.gamma_infeasible <= singular.gamma_least


def test_a_mode_that_no_control_reaches_or_no_measurement_sees_is_named():
    ones, last, first = np.ones((3, 1)), np.eye(3)[:, 2:], np.eye(2, 1)
    A = [[1.2, 0.0, 0.0], [0.0, 0.5, 1.0], [0.0, 0.0, 0.3]]
    unreachable = GeneralizedPlant(A=A, B1=ones, B2=last, C1=ones.T, C2=ones.T, D12=1.0, D21=1.0)
    words = r"at 1\.2 .* no control .* states 0 \(1\)"
    error = refused(lambda: lbt.hinf_controller(unreachable), DetectabilityError, words)
    assert error.eigenvalue == pytest.approx(1.2)
    assert error.eigenvector == pytest.approx([1, 0, 0], abs=1e-9)
    A, weighted = [[0.5, 0.0], [1.0, 1.0]], [[0.0, 1.0], [0.0, 0.0]]  # a weight that integrates
    through = {"D12": [[0.0], [1.0]], "D21": 1.0}
    unseen = GeneralizedPlant(A=A, B1=first, B2=first, C1=weighted, C2=first.T, **through)
    words = r"no measurement sees it.*states 1 \(1\)"
    error = refused(lambda: lbt.hinf_controller(unseen), DetectabilityError, words)
    assert error.eigenvalue == pytest.approx(1.0)


def test_refusals():
    plant = random_plant(3, n=3)
    least = lbt.hinf_controller(plant).gamma_least

    def hinf(plant=plant, **options):
        return lambda: lbt.hinf_controller(plant, **options)

    def mixed(**options):
        return lambda: lbt.mixed_controller(plant, **options)

    require_refusals(
        [
            (hinf(gamma=3.0, gamma_ratio=1.1), ProblemError, "not both"),
            (hinf(gamma_ratio=0.9), ProblemError, "gamma_ratio must be at least 1"),
            (hinf(np.eye(2)), ProblemError, "must be a GeneralizedPlant"),
            (mixed(gamma=0.9 * least), InfeasibleError, "because"),
            (mixed(gamma=1.002 * least, taps=1), InfeasibleError, "with 1 taps"),
        ]
    )
    low = refused(hinf(gamma=0.9 * least), InfeasibleError, "because")
    assert low.gamma_least == pytest.approx(least)


# Problems on which python-control (152, 367, 973) and Octave (13, 14) fail, hang or give no reason.
# They are posed in continuous time, and sampled by the bilinear map, which keeps the norm.

A, B, C = np.eye(2, k=1), np.eye(2)[:, 1:], np.eye(2)[:1]


def sampled_problem(system):
    """Return the plant of a continuous system whose last output is measured, last input controls."""
    return GeneralizedPlant.of(sampled(system, 0.01), measurements=1, controls=1)


def without_feedthrough(A, B1, B2, C1, C2, D12):
    """Return a plant of a continuous system from [w; u] to [z; y] with D12 alone."""
    D = np.zeros((len(C1) + 1, B1.shape[1] + 1))
    D[:-1, -1:] = D12
    return sampled_problem(control.ss(A, np.hstack([B1, B2]), np.vstack([C1, C2]), D))


def test_spring_and_mass_with_a_static_weight():
    """python-control 367: D12 is zero where the frequency is infinite."""
    weighted, one = [1, 12, 20], [1]
    numerators = [[[-1], [-1]], [[0], [1]], [[-1], [-1]]]
    denominators = [[[1, 1], weighted], [one, one], [[1, 1], weighted]]
    design = lbt.hinf_controller(sampled_problem(control.tf(numerators, denominators)))
    assert design.gamma_infeasible > 0.999 * design.gamma_least


@pytest.mark.filterwarnings("ignore:connect:FutureWarning")  # python-control's own
def test_weight_that_asks_for_the_highest_frequencies():
    """python-control 152, and 973, which hung: the sensitivity tends to one, its weight counts."""
    A, B = [[-0.01, -0.992], [0, -0.75]], [[0.992, 0], [0, 1]]
    plant = sampled_problem(control.ss(A, B, [[1, -0.8], [0, -1]], [[0.8, 0], [1, 0]]))
    transfers = control.tf([1, 1], [1, 0.5, 4]), control.tf([2, -2.2, 1], [3, 0.2, 0.01])
    weighted = control.augw(*(sampled(system, 0.01) for system in transfers))
    weighted = GeneralizedPlant.of(weighted, measurements=1, controls=1)
    for problem, expected, rel in ((plant, 0.8, 1e-6), (weighted, 2 / 3, 1e-5)):
        design = lbt.hinf_controller(problem)
        levels = design.gamma, design.gamma_infeasible
        assert levels == pytest.approx((expected, expected), rel=rel)
        assert design.witness.reason.endswith("at 50 Hz")


def test_mass_without_noise():
    """Octave 14: without its weights, and with 10 (s + 1) / (s + 100) of its thread."""
    plant = without_feedthrough(A, B, B, np.vstack([C, 0 * C]), C, [[0.0], [1.0]])
    design = lbt.hinf_controller(plant)
    assert design.gamma_infeasible == pytest.approx(1.0, abs=1e-5)  # u must balance w at 0 Hz
    assert design.gamma == pytest.approx(1.0, abs=1e-3)
    B1, B2 = (np.vstack([B, [[weight]]]) for weight in (0.0, 1.0))
    A3, C1, C2 = block_diag(A, -100.0), block_diag(C, -990.0), np.pad(C, ((0, 0), (0, 1)))
    design = lbt.hinf_controller(without_feedthrough(A3, B1, B2, C1, C2, [[0.0], [10.0]]))
    assert design.gamma_infeasible == pytest.approx(design.gamma_least, rel=5e-3)
    assert design.regularised > 0  # the measurement has no noise


@pytest.mark.parametrize("seed", range(2))
def test_no_neighbour_leaves_less(seed):
    """The variance is that of scipy's Lyapunov equation, and least among its neighbours."""
    plant, rng = random_plant(seed, n=4), np.random.default_rng(seed)
    design = lbt.h2_controller(plant)
    parts = {name: getattr(design.controller, name) for name in "ABCD"}

    def variance(controller):
        loop = plant.closed_loop(controller)
        P = solve_discrete_lyapunov(loop.A, loop.B @ loop.B.T)
        return np.trace(loop.C @ P @ loop.C.T + loop.D @ loop.D.T)

    least = variance(design.controller)
    assert design.rms == pytest.approx(np.sqrt(least), rel=1e-9)
    for _ in range(20):
        moved = {k: v + 1e-4 * rng.normal(size=v.shape) for k, v in parts.items()}
        assert variance(StateSpace(**moved)) >= least * (1 - 1e-12)


def test_scalar_closed_form():
    """A random walk with unit noises: the fourth power of the rms is 5."""
    noises = {"B1": [[1.0, 0.0]], "C1": [[1.0], [0.0]], "D12": [[0.0], [1.0]], "D21": [[0.0, 1.0]]}
    plant = GeneralizedPlant(A=1.0, B2=1.0, C2=1.0, **noises)
    assert lbt.h2_controller(plant).rms ** 4 == pytest.approx(5.0)


def test_never_worse_than_one_lyapunov_matrix():
    plant = random_plant(1, n=3, D22=False)
    least, quiet = lbt.hinf_controller(plant), lbt.h2_controller(plant)
    gamma = 0.5 * (least.gamma + quiet.gamma)
    design = lbt.mixed_controller(plant, gamma=gamma, taps=12)
    assert design.gamma <= gamma
    bound = common_lyapunov_rms(plant, gamma) * (1 + 1e-4)
    assert quiet.rms * (1 - 1e-9) <= design.rms <= bound
    loose = lbt.mixed_controller(plant, gamma=2 * quiet.gamma)
    assert loose.rms == pytest.approx(quiet.rms)


def test_variance_is_least_variance_and_size_of_the_filter():
    scaled = scaled_plant(random_plant(3, n=4))
    loop = free_parameter(scaled.equations(0.0))
    taps = 0.3 * np.random.default_rng(0).normal(size=(5, *loop.through.shape))
    closed = scaled.plant.closed_loop(loop.controller(taps))
    assert closed.spectral_radius < 1
    least = lbt.h2_controller(scaled.plant).rms
    rms = lbt.design.certificate.certify_error(closed).rms
    assert rms**2 == pytest.approx(least**2 + np.sum(taps**2), rel=1e-9)
