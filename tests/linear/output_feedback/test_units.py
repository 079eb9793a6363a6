"""Levels that do not depend on units, and singular plants whose D11 a control cancels."""

from dataclasses import replace

import control
import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.linear import GeneralizedPlant, mixed_sensitivity


def some_plant(seed: int, *, singular: bool) -> GeneralizedPlant:
    """An unstable plant of random sizes; of a singular one nothing passes directly."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((3, 3))
    A *= 1.05 / max(abs(np.linalg.eigvals(A)))
    m1, m2, p1, p2 = (int(size) for size in rng.integers(1, 4, 4))
    through = 0.0 if singular else 1.0
    B1, B2 = rng.standard_normal((3, m1)), rng.standard_normal((3, m2))
    C1, C2 = rng.standard_normal((p1, 3)), rng.standard_normal((p2, 3))
    D11, D12 = rng.standard_normal((p1, m1)), through * rng.standard_normal((p1, m2))
    D21 = through * rng.standard_normal((p2, m1))
    return GeneralizedPlant(A=A, B1=B1, B2=B2, C1=C1, C2=C2, D11=D11, D12=D12, D21=D21)


def in_units(plant: GeneralizedPlant, z: float, w: float) -> GeneralizedPlant:
    P = plant
    return replace(P, B1=w * P.B1, C1=z * P.C1, D11=z * w * P.D11, D12=z * P.D12, D21=w * P.D21)


@pytest.mark.parametrize("singular", [False, True])
@pytest.mark.parametrize("seed", [1, 3, 4, 7, 9])
def test_levels_scale_with_the_units_of_errors_and_disturbances(seed, singular):
    plant = some_plant(seed, singular=singular)
    first = lbt.hinf_controller(plant)
    least_rms = lbt.h2_controller(plant).rms
    for z, w in ((1e4, 1e4), (1e-4, 1e-4), (1e5, 1e-5)):
        other = lbt.hinf_controller(in_units(plant, z, w))
        assert other.gamma == pytest.approx(z * w * first.gamma, rel=1e-4)
        assert other.gamma_infeasible == pytest.approx(z * w * first.gamma_infeasible, rel=1e-4)
        assert other.gamma_infeasible <= other.gamma * (1 + 1e-9)
        assert lbt.h2_controller(in_units(plant, z, w)).rms == pytest.approx(
            z * w * least_rms, rel=1e-4
        )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("copies", [1, 2])
def test_a_large_direct_path_that_a_control_cancels(seed, copies):
    """The measurement shows a disturbance of 4360 at once; redundant channels change nothing."""
    rng = np.random.default_rng(seed)
    A, B1 = np.diag(rng.uniform(0.2, 0.9, 2)), 1e-3 * rng.standard_normal((2, 2))
    C1, B2 = rng.standard_normal((2, 2)), 1e-6 * rng.standard_normal((2, 1))
    D12, D21 = np.array([[1.0], [0.0]]), np.array([[1.0, 0.0]])
    plant = GeneralizedPlant(
        A=A,
        B1=B1,
        B2=np.hstack(copies * [B2]),
        C1=C1,
        C2=np.zeros((copies, 2)),
        D11=4360 * D12 @ D21,
        D12=np.hstack(copies * [D12]),
        D21=np.vstack(copies * [D21]),
    )
    # u = -4360 y cancels it; its loop has no feedback, and the rest is what the states leave
    pushed = B1 - 4360 * B2 @ D21
    steps = [np.linalg.matrix_power(A, k) @ pushed for k in range(400)]
    P = sum(step @ step.T for step in steps)
    cancelling_rms = np.sqrt(np.trace(C1 @ P @ C1.T))
    assert lbt.h2_controller(plant).rms <= cancelling_rms * (1 + 1e-6)
    least = lbt.hinf_controller(plant)
    assert least.gamma == pytest.approx(least.gamma_infeasible, rel=1e-6)


@pytest.mark.parametrize("pole", [0.99, 0.9998, 0.999998])
def test_a_weight_as_a_transfer_function_is_that_in_state_space(pole):
    dt = 1e-3
    plant = control.tf([0.2], [1, -0.8, 0, 0], dt)
    as_ratio = control.tf([0.5, -0.45], [1, -pole], dt)
    as_states = control.ss([[pole]], [[1.0]], [[0.5 * (pole - 0.9)]], [[0.5]], dt)
    levels = [
        lbt.hinf_controller(mixed_sensitivity(plant, performance=weight, control=0.1))
        for weight in (as_ratio, as_states)
    ]
    assert levels[0].gamma == pytest.approx(levels[1].gamma, rel=1e-5)
    for level in levels:
        assert level.gamma_infeasible == pytest.approx(level.gamma_least, rel=1e-3)
