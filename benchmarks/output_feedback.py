"""Controllers of random generalised plants: the least gamma against SLICOT, and its proof.

    python benchmarks/output_feedback.py [--plants 1000] [--first 0]
    python benchmarks/output_feedback.py singular [--plants 200]
    python benchmarks/output_feedback.py least [--plants 30]

The plants have 2 to 20 states, spectral radii of 0.5 to 1.3, and all feedthroughs. SLICOT's
SB10DD is asked for a level 1e-6 below our least gamma, and its controller is judged by its
closed loop. ``singular`` takes the weight of the control or the noise away, and compares the least
gamma with that of a plant with weights and noise of 1e-5. ``least`` compares the coefficients of
the controller of the least gamma with those at 1.05 times it, and times both routes, for 10 states.
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import replace

import numpy as np
import slycot

import lbt_synth as lbt
from lbt_synth.errors import LbtSynthError
from lbt_synth.linear import GeneralizedPlant, StateSpace


def random_plant(seed: int, states: tuple[int, int] = (2, 20)) -> GeneralizedPlant:
    """Draw a plant with all feedthroughs."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(states[0], states[1] + 1))
    m1, m2, p1, p2 = (int(rng.integers(1, 4)) for _ in range(4))
    m1, p1 = max(m1, p2), max(p1, m2)
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.5, 1.3) / np.max(np.abs(np.linalg.eigvals(A)))
    sizes = {"B1": (n, m1), "B2": (n, m2), "C1": (p1, n), "C2": (p2, n), "D11": (p1, m1)}
    sizes |= {"D12": (p1, m2), "D21": (p2, m1), "D22": (p2, m2)}
    return GeneralizedPlant(A=A, **{name: rng.normal(size=size) for name, size in sizes.items()})


def slicot_norm(plant: GeneralizedPlant, gamma: float) -> float:
    """Norm of the loop of SB10DD at a level; infinite where it fails or is unstable."""
    P = plant
    m1, m2, p1, p2 = P.sizes
    B, C = np.hstack([P.B1, P.B2]), np.vstack([P.C1, P.C2])
    D = np.block([[P.D11, P.D12], [P.D21, P.D22]])
    given = (len(P.A), m1 + m2, p1 + p2, m2, p2, gamma, P.A, B, C, D)
    try:
        K = StateSpace(**dict(zip("ABCD", slycot.sb10dd(*given)[1:5], strict=True)))
        loop = plant.closed_loop(K)
        return lbt.hinf_norm(loop).upper if loop.spectral_radius < 1 else np.inf
    except (slycot.exceptions.SlycotError, LbtSynthError):
        return np.inf


def compare(first: int, count: int) -> None:
    """Print what became of each plant."""
    lower, failed, refused, gaps, times = 0, 0, [], [], []
    for seed in range(first, first + count):
        plant = random_plant(seed)
        start = time.process_time()
        try:
            design = lbt.hinf_controller(plant)
        except LbtSynthError as error:
            refused.append(f"{seed}: {type(error).__name__}: {str(error)[:120]}")
            continue
        times.append(time.process_time() - start)
        least = design.gamma_least
        gaps.append(1 - design.gamma_infeasible / least)
        lower += slicot_norm(plant, least * (1 - 1e-6)) < least * (1 - 1e-6)
        failed += not np.isfinite(slicot_norm(plant, least * 1.001))
    gap = np.array(gaps)
    print(f"plants {count}, certified {len(gaps)}, refused {len(refused)}")
    print(
        f"SLICOT lower by more than 1e-6: {lower}; SLICOT without a controller at 1.001: {failed}"
    )
    for limit in (1e-9, 1e-6, 1e-3):
        print(f"bracket closed to {limit:g}: {np.mean(gap < limit):.1%}")
    median, high = np.quantile(times, [0.5, 0.99])
    print(f"processor time {1e3 * median:.0f} ms in the median, {1e3 * high:.0f} ms in 99 %")
    print("\n".join(refused))


def compare_singular(first: int, count: int) -> None:
    """Print how far singular plants are from plants next to them."""
    apart, refused = [], []
    for seed in range(first, first + count):
        plant = random_plant(seed, (2, 10))
        if seed % 2:
            plant = replace(plant, D12=0 * plant.D12)
        if seed % 3 or not seed % 2:
            plant = replace(plant, D21=0 * plant.D21)
        try:
            least = lbt.hinf_controller(plant).gamma_least
            apart.append(abs(least / lbt.hinf_controller(_next_to(plant, 1e-5)).gamma_least - 1))
        except LbtSynthError as error:
            refused.append(f"{seed}: {type(error).__name__}: {str(error)[:120]}")
    within = np.mean(np.array(apart) < 1e-4)
    print(f"singular plants {count}: within 1e-4 {within:.1%}, largest {max(apart):.2g}")
    print("\n".join(refused))


def compare_least(first: int, count: int) -> None:
    """Print how wild controllers of the least gamma are, and the time of both routes."""
    ratios, times = [], {"riccati": [], "lmi": []}
    for seed in range(first, first + count):
        plant = random_plant(seed, (10, 10))
        for route, spent in times.items():
            start = time.process_time()
            least = lbt.hinf_controller(plant, route=route)
            spent.append(time.process_time() - start)
        usual = lbt.hinf_controller(plant, gamma_ratio=1.05)
        sizes = [
            max(np.abs(getattr(design.controller, name)).max() for name in "ABCD")
            for design in (least, usual)
        ]
        ratios.append(sizes[0] / sizes[1])
    median, high = np.quantile(ratios, [0.5, 1])
    print(f"largest coefficient over that at 1.05: median {median:.2f}, largest {high:.2f}")
    for route, spent in times.items():
        middle, most = 1e3 * np.median(spent), 1e3 * max(spent)
        print(f"{route}: {middle:.0f} ms in the median, {most:.0f} at most")


def _next_to(plant: GeneralizedPlant, share: float) -> GeneralizedPlant:
    """Return the plant with a weight of each control and noise of each measurement."""
    P, n = plant, len(plant.A)
    m1, m2, p1, p2 = P.sizes
    return replace(
        P,
        B1=np.hstack([P.B1, np.zeros((n, p2))]),
        C1=np.vstack([P.C1, np.zeros((m2, n))]),
        D11=np.block([[P.D11, np.zeros((p1, p2))], [np.zeros((m2, m1 + p2))]]),
        D12=np.vstack([P.D12, share * np.eye(m2)]),
        D21=np.hstack([P.D21, share * np.eye(p2)]),
    )


def main() -> None:
    """Run the comparison."""
    parser = argparse.ArgumentParser()
    kinds = ("regular", "singular", "least")
    parser.add_argument("what", nargs="?", choices=kinds, default="regular")
    parser.add_argument("--plants", type=int)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if given.what == "singular":
        compare_singular(given.first, given.plants or 200)
    elif given.what == "least":
        compare_least(given.first, given.plants or 30)
    else:
        compare(given.first, given.plants or 1000)


if __name__ == "__main__":
    main()
