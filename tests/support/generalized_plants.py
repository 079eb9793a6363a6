"""Random generalised plants."""

from dataclasses import replace

import control
import numpy as np
from scipy.linalg import block_diag

import lbt_synth as lbt


def random_plant(seed, *, n=None, D22=True, D12=None, D21=None):
    """A generalised plant of 2 to 20 states, stable or unstable, with all feedthroughs."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 21)) if n is None else n
    m1, m2, p1, p2 = (int(rng.integers(1, 4)) for _ in range(4))
    m1, p1 = max(m1, p2), max(p1, m2)
    D12, D21 = (1.0 if factor is None else factor for factor in (D12, D21))

    def draw(*shape):
        return rng.normal(size=shape)

    A = draw(n, n)
    size = rng.uniform(0.5, 1.3)
    A = A * (size / np.max(np.abs(np.linalg.eigvals(A))))
    parts = {"A": A, "B1": draw(n, m1), "B2": draw(n, m2), "C1": draw(p1, n), "C2": draw(p2, n)}
    parts |= {"D11": draw(p1, m1), "D12": D12 * draw(p1, m2), "D21": D21 * draw(p2, m1)}
    if D22:
        parts["D22"] = 0.3 * draw(p2, m2)
    return lbt.linear.GeneralizedPlant(**parts)


def sampled(system, dt_s=1.0):
    """A continuous system of python-control at a sampling period, with the norm that it has."""
    return control.sample_system(control.ss(system), dt_s, method="bilinear")


def lightly_damped_plant(seed):
    """A plant of 2 to 8 states whose modes decay by 1e-8 to 1e-2 per sample, of many sizes."""
    rng = np.random.default_rng(seed + 10**6)
    plant = random_plant(seed, n=int(rng.integers(1, 9)), D22=False)
    modes = max(len(plant.A) // 2, 1)
    slow = rng.random(modes) < 0.3
    angles = np.where(slow, 10 ** rng.uniform(-6, -1, modes), rng.uniform(0, np.pi, modes))
    turns = [[[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]] for a in angles]
    A = block_diag(*((1 - 10 ** rng.uniform(-8, -2)) * np.array(turn) for turn in turns))

    def draw(size):
        return rng.normal(size=(2 * modes, size)) * 10 ** rng.uniform(-4, 0, (2 * modes, 1))

    m1, m2, p1, p2 = plant.sizes
    B1, B2, C1, C2 = draw(m1), draw(m2), draw(p1).T, draw(p2).T
    return replace(plant, A=A, B1=B1, B2=B2, C1=C1, C2=C2)


def stacked(plant):
    """Sizes and matrices in the order of SLICOT."""
    P = plant
    m1, m2, p1, p2 = P.sizes
    B, C = np.hstack([P.B1, P.B2]), np.vstack([P.C1, P.C2])
    D = np.block([[P.D11, P.D12], [P.D21, P.D22]])
    return (len(P.A), m1 + m2, p1 + p2, m2, p2), (P.A, B, C, D)
