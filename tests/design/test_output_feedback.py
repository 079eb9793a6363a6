"""Controllers of generalised plants: H2, H-infinity and mixed, and why there is none."""

from dataclasses import replace

import control
import numpy as np
import pytest
import scipy.signal
from scipy.linalg import block_diag, solve_discrete_lyapunov
from support.common_lyapunov import common_lyapunov_rms
from support.generalized_plants import random_plant, sampled

import lbt_synth as lbt
from lbt_synth.errors import DetectabilityError, InfeasibleError, ProblemError
from lbt_synth.linear import GeneralizedPlant, StateSpace, mixed_sensitivity
from lbt_synth.linear.output_feedback.two_riccati import free_parameter, scaled_plant


@pytest.mark.parametrize("route", ["riccati", "lmi"])
def test_routes_agree(route):
    plant = replace(random_plant(3, n=4), dt_s=1e-3)
    design = lbt.hinf_controller(plant, gamma_ratio=1.1, route=route)
    assert design.gamma <= design.gamma_requested * (1 + 1e-9)
    assert design.gamma_least == pytest.approx(lbt.hinf_controller(plant).gamma_least, rel=1e-6)
    assert design.certificate.passed


@pytest.mark.parametrize("seed", range(8))
def test_singular_feedthrough(seed):
    """A control without a weight and a measurement without noise: the limit of small ones."""
    plant = random_plant(seed, n=4, D12=0.0 if seed % 2 else None, D21=0.0 if seed % 3 else None)
    singular = lbt.hinf_controller(plant)
    small = 1e-5
    n = len(plant.A)
    m1, m2, p1, p2 = plant.sizes
    near = GeneralizedPlant(
        A=plant.A,
        B1=np.hstack([plant.B1, np.zeros((n, p2))]),
        B2=plant.B2,
        C1=np.vstack([plant.C1, np.zeros((m2, n))]),
        C2=plant.C2,
        D11=np.block([[plant.D11, np.zeros((p1, p2))], [np.zeros((m2, m1 + p2))]]),
        D12=np.vstack([plant.D12, small * np.eye(m2)]),
        D21=np.hstack([plant.D21, small * np.eye(p2)]),
        D22=plant.D22,
    )
    assert singular.gamma_least == pytest.approx(lbt.hinf_controller(near).gamma_least, rel=1e-4)
    assert singular.gamma_infeasible <= singular.gamma_least


def test_unreachable_mode_is_named():
    plant = GeneralizedPlant(
        A=[[1.2, 0.0, 0.0], [0.0, 0.5, 1.0], [0.0, 0.0, 0.3]],
        B1=np.ones((3, 1)),
        B2=[[0.0], [0.0], [1.0]],
        C1=np.ones((1, 3)),
        C2=np.ones((1, 3)),
        D12=1.0,
        D21=1.0,
    )
    with pytest.raises(DetectabilityError, match=r"at 1\.2 .* no control .* states 0 \(1\)") as got:
        lbt.hinf_controller(plant)
    assert got.value.eigenvalue == pytest.approx(1.2)
    assert got.value.eigenvector == pytest.approx([1, 0, 0], abs=1e-9)


def test_unseen_mode_is_named():
    """A weight that integrates: nobody can stabilise it."""
    plant = GeneralizedPlant(
        A=[[0.5, 0.0], [1.0, 1.0]],
        B1=[[1.0], [0.0]],
        B2=[[1.0], [0.0]],
        C1=[[0.0, 1.0], [0.0, 0.0]],
        C2=[[1.0, 0.0]],
        D12=[[0.0], [1.0]],
        D21=[[1.0]],
    )
    with pytest.raises(DetectabilityError, match=r"no measurement sees it.*states 1 \(1\)") as got:
        lbt.hinf_controller(plant)
    assert got.value.eigenvalue == pytest.approx(1.0)


def test_infeasible_level_names_least_and_reason():
    plant = random_plant(3, n=4)
    least = lbt.hinf_controller(plant).gamma_least
    with pytest.raises(InfeasibleError, match="because") as got:
        lbt.hinf_controller(plant, gamma=0.9 * least)
    assert got.value.gamma_least == pytest.approx(least)


def test_arguments():
    plant = random_plant(3, n=3)
    with pytest.raises(ProblemError, match="not both"):
        lbt.hinf_controller(plant, gamma=3.0, gamma_ratio=1.1)
    with pytest.raises(ProblemError, match="gamma_ratio must be at least 1"):
        lbt.hinf_controller(plant, gamma_ratio=0.9)
    with pytest.raises(ProblemError, match="must be a GeneralizedPlant"):
        lbt.hinf_controller(np.eye(2))


def test_systems_of_others():
    """python-control and scipy.signal give the same plant, and take the controller back."""
    plant = random_plant(3, n=3)
    whole = plant.whole
    _, controls, _, measurements = plant.sizes
    least = lbt.hinf_controller(plant).gamma_least
    scipys = scipy.signal.StateSpace(whole.A, whole.B, whole.C, whole.D, dt=1.0)
    for system in (whole.to_control(), scipys):
        same = GeneralizedPlant.of(system, measurements=measurements, controls=controls)
        design = lbt.hinf_controller(same)
        assert design.gamma_least == pytest.approx(least, rel=1e-9)
    back = StateSpace.of(design.controller.to_control())
    assert back.D == pytest.approx(design.controller.D)


def test_printed_design():
    text = lbt.hinf_controller(random_plant(3, n=3), gamma_ratio=1.1).summary()
    assert "gamma that no controller reaches" in text
    assert "below: " in text


# Problems on which python-control (152, 367, 973) and Octave (13, 14) fail, hang or give no reason.
# They are posed in continuous time, and sampled by the bilinear map, which keeps the norm.

MASS = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])


def sampled_problem(system, dt_s=0.01):
    """The plant of a continuous system whose last output is measured, and last input controls."""
    return GeneralizedPlant.of(sampled(system, dt_s), measurements=1, controls=1)


def without_feedthrough(A, B1, B2, C1, C2, D12):
    """A continuous system from [w; u] to [z; y] with D12 alone."""
    D = np.zeros((len(C1) + 1, B1.shape[1] + 1))
    D[:-1, -1:] = D12
    return control.ss(A, np.hstack([B1, B2]), np.vstack([C1, C2]), D)


def test_spring_and_mass_with_a_static_weight():
    """python-control 367: D12 is zero where the frequency is infinite."""
    tf = control.tf(
        [[[-1], [-1]], [[0], [1]], [[-1], [-1]]],
        [[[1, 1], [1, 12, 20]], [[1], [1]], [[1, 1], [1, 12, 20]]],
    )
    design = lbt.hinf_controller(sampled_problem(tf))
    assert design.gamma_infeasible > 0.999 * design.gamma_least


def test_weight_that_asks_for_the_highest_frequencies():
    """python-control 152: the sensitivity tends to one, and its weight to 1 / 1.25."""
    plant = control.ss(
        [[-0.01, -0.992], [0, -0.75]],
        [[0.992, 0], [0, 1]],
        [[1, -0.8], [0, -1]],
        [[0.8, 0], [1, 0]],
    )
    design = lbt.hinf_controller(sampled_problem(plant))
    assert design.gamma == pytest.approx(0.8, rel=1e-6)
    assert design.gamma_infeasible == pytest.approx(0.8, rel=1e-6)
    assert design.witness.reason.endswith("at 50 Hz")


def test_mixed_sensitivity_that_hung():
    """python-control 973: again the weight at the highest frequencies, 2 / 3."""
    G, weight = control.tf([1, 1], [1, 0.5, 4]), control.tf([2, -2.2, 1], [3, 0.2, 0.01])
    design = lbt.hinf_controller(mixed_sensitivity(sampled(G), performance=sampled(weight)))
    assert design.gamma == pytest.approx(2 / 3, rel=1e-5)
    assert design.gamma_infeasible == pytest.approx(2 / 3, rel=1e-5)


def test_copies_of_a_plant_that_no_control_reaches():
    """Octave 13: four copies of a mass; the disturbance has one of its own."""
    A, B, C = MASS
    none, two = np.zeros((2, 1)), np.vstack([C, 0 * C])
    parts = [(B, none), (none, B), (B, none), (none, B)]
    system = without_feedthrough(
        block_diag(A, A, A, A),
        np.vstack([first for first, _ in parts]),
        np.vstack([second for _, second in parts]),
        np.hstack([two, two, 0 * two, 0 * two]),
        np.hstack([0 * C, 0 * C, C, C]),
        [[0.0], [1.0]],
    )
    with pytest.raises(DetectabilityError, match="mode at 1 does not decay, and no control") as got:
        lbt.hinf_controller(sampled_problem(system))
    assert np.argmax(got.value.eigenvector) in (1, 5)  # the velocities of the copies


def test_mass_without_noise():
    """Octave 14, without its weights: the measurement has no noise, and D21 is zero."""
    A, B, C = MASS
    system = without_feedthrough(A, B, B, np.vstack([C, 0 * C]), C, [[0.0], [1.0]])
    design = lbt.hinf_controller(sampled_problem(system))
    assert design.gamma_infeasible == pytest.approx(1.0, abs=1e-5)  # u must balance w at 0 Hz
    assert design.gamma == pytest.approx(1.0, abs=1e-3)


def test_mass_with_a_weight_of_its_control():
    """Octave 14 with 10 (s + 1) / (s + 100), the weight of the control that its thread shows."""
    system = without_feedthrough(
        np.array([[0, 1, 0], [0, 0, 0], [0, 0, -100]]),
        np.array([[0.0], [1.0], [0.0]]),
        np.array([[0.0], [1.0], [1.0]]),
        np.array([[1, 0, 0], [0, 0, -990]]),
        np.array([[1.0, 0.0, 0.0]]),
        [[0.0], [10.0]],
    )
    design = lbt.hinf_controller(sampled_problem(system))
    assert design.gamma_infeasible == pytest.approx(design.gamma_least, rel=5e-3)
    assert design.regularised > 0  # the measurement has no noise


@pytest.mark.parametrize("seed", range(8))
def test_no_neighbour_leaves_less(seed):
    """The variance is that of scipy's Lyapunov equation, and least among its neighbours."""
    plant = random_plant(seed, n=4)
    design = lbt.h2_controller(plant)

    def variance(controller):
        loop = plant.closed_loop(controller)
        P = solve_discrete_lyapunov(loop.A, loop.B @ loop.B.T)
        return np.trace(loop.C @ P @ loop.C.T + loop.D @ loop.D.T)

    K = design.controller
    least = variance(K)
    assert design.rms == pytest.approx(np.sqrt(least), rel=1e-9)
    rng = np.random.default_rng(seed)
    for _ in range(20):
        parts = {name: getattr(K, name) for name in "ABCD"}
        moved = {k: v + 1e-4 * rng.normal(size=v.shape) for k, v in parts.items()}
        assert variance(lbt.linear.StateSpace(**moved)) >= least * (1 - 1e-12)


def test_scalar_closed_form():
    """A random walk with unit noises: the fourth power of the rms is 5."""
    plant = lbt.linear.GeneralizedPlant(
        A=1.0,
        B1=[[1.0, 0.0]],
        B2=1.0,
        C1=[[1.0], [0.0]],
        C2=1.0,
        D12=[[0.0], [1.0]],
        D21=[[0.0, 1.0]],
    )
    assert lbt.h2_controller(plant).rms ** 4 == pytest.approx(5.0)


@pytest.mark.parametrize("seed", [1, 2, 6])
def test_never_worse_than_one_lyapunov_matrix(seed):
    plant = random_plant(seed, n=3, D22=False)
    least, quiet = lbt.hinf_controller(plant), lbt.h2_controller(plant)
    gamma = 0.5 * (least.gamma + quiet.gamma)
    design = lbt.mixed_controller(plant, gamma=gamma, taps=12)
    assert design.gamma <= gamma
    assert quiet.rms * (1 - 1e-9) <= design.rms
    assert design.rms <= common_lyapunov_rms(plant, gamma) * (1 + 1e-4)


def test_variance_is_least_variance_and_size_of_the_filter():
    scaled = scaled_plant(random_plant(3, n=4))
    equations = scaled.equations(0.0)
    loop = free_parameter(equations)
    taps = 0.3 * np.random.default_rng(0).normal(size=(5, *loop.through.shape))
    closed = scaled.plant.closed_loop(loop.controller(taps))
    assert closed.spectral_radius < 1
    least = lbt.h2_controller(scaled.plant).rms
    rms = lbt.design.certificate.certify_error(closed).rms
    assert rms**2 == pytest.approx(least**2 + np.sum(taps**2), rel=1e-9)


def test_loose_bound_gives_the_least_variance():
    plant = random_plant(3, n=3)
    quiet = lbt.h2_controller(plant)
    assert lbt.mixed_controller(plant, gamma=2 * quiet.gamma).rms == pytest.approx(quiet.rms)


def test_bounds_that_cannot_be_met():
    plant = random_plant(3, n=3)
    least = lbt.hinf_controller(plant).gamma_least
    with pytest.raises(InfeasibleError, match="because"):
        lbt.mixed_controller(plant, gamma=0.9 * least)
    with pytest.raises(InfeasibleError, match="with 1 taps"):
        lbt.mixed_controller(plant, gamma=1.002 * least, taps=1)
