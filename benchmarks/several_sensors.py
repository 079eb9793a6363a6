"""Filters of several sensors against the lifted problem and a Monte Carlo run, on random plants.

Prints the table of docs/several_sensors.md: ``python benchmarks/several_sensors.py``. The plants
have up to 8 states, 3 measurements, 12 phases and noise that is correlated; ``--plants 20`` and
``--frames 100000`` make it quicker.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

import lbt_synth as lbt
from lbt_synth.linear.infeasibility_proof import worst_invisible_disturbance
from lbt_synth.linear.riccati.filtering import FilterRiccati, least_gamma

sys.path.insert(0, "tests")
from support.periodic_problems import lifted_problem, random_periodic_problem, relative_distance

CASES, LONGEST_SETTLING = 200, 20_000
SETTLED = 1e-6  # what is left of the first error


def score(
    problem: lbt.linear.EstimationProblem,
    solution: FilterRiccati,
    frames: int,
    seed: int,
) -> float | None:
    """Return the simulated power of the error less the exact one, in standard errors.

    The plant and its filter run beside each other; no matrix of the error is formed. None if the
    error settles too slowly.
    """
    gains = solution.gain_predictor
    radius = problem.error_system(gains).radius_per_frame
    settle = int(np.ceil(np.log(SETTLED) / np.log(radius)))
    if settle > LONGEST_SETTLING:
        return None
    rng, period, per_case = np.random.default_rng((seed, 1)), problem.period, frames // CASES
    x, estimate = np.zeros((2, problem.n_states, CASES))
    powers = np.zeros(CASES)
    first = -(-settle // period) * period
    last = first + -(-per_case // period) * period
    for k in range(last):
        t = k % period
        (A, B, C, D), read = (each[t] for each in problem.stacks()), problem.read[t]
        if k >= first:
            powers += np.sum((problem.L @ (x - estimate)) ** 2, axis=0)
        w = rng.standard_normal((B.shape[1], CASES))
        y = C @ x + D @ w
        innovation = np.where(read[:, None], y - C @ estimate, 0.0)
        x, estimate = A @ x + B @ w, A @ estimate + gains[t] @ innovation
        if k % 50 == 0:  # the error does not depend on x: an unstable plant must not overflow
            x, estimate = x - estimate, 0.0 * estimate
    powers /= last - first
    exact = np.mean([np.trace(problem.L @ P @ problem.L.T) for P in solution.P])
    return float((powers.mean() - exact) / (powers.std(ddof=1) / np.sqrt(CASES)))


def bracket(problem: lbt.linear.EstimationProblem, solution: FilterRiccati) -> float:
    """Return how far the least gamma is above what is proved that no filter reaches, relative."""
    norm = lbt.hinf_norm(problem.error_system(solution.gain_predictor)).upper
    _, least, met = least_gamma(problem, lower=0.0, upper=norm, start=solution)
    witness = worst_invisible_disturbance(problem, met.P, least, solution.P)
    return 1 - lbt.linear.infeasible_level(problem, witness, solution.P) / least


def main() -> None:
    """Print how far the filters are from both oracles."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=200)
    parser.add_argument("--frames", type=int, default=1_000_000)
    given = parser.parse_args()
    apart, open_by, scores, start = [], [], {}, time.process_time()
    for seed in range(given.plants):
        problem = random_periodic_problem(seed)
        solution = lbt.linear.kalman_riccati(problem)
        lifted = lbt.linear.kalman_riccati(lifted_problem(problem))
        apart.append(relative_distance(solution.P[0], lifted.P))
        open_by.append(bracket(problem, solution))
        found = score(problem, solution, given.frames, seed)
        if found is not None:
            scores[seed] = found
    minutes, z = (time.process_time() - start) / 60, np.array(list(scores.values()))
    worst = max(scores, key=lambda seed: abs(scores[seed]))
    problem = random_periodic_problem(worst)
    again = score(problem, lbt.linear.kalman_riccati(problem), given.frames, worst + given.plants)
    print("| what | figure |\n|---|---:|")
    print(f"| random plants | {given.plants} |")
    print(f"| covariance against the lifted problem, worst relative | {max(apart):.1e} |")
    shares = ", ".join(f"{x:.1e}" for x in np.quantile(open_by, [0.5, 0.95, 1.0]))
    print(f"| bracket of the least gamma: median, 95 %, worst | {shares} |")
    print(f"| plants run for {given.frames:,} frames | {len(z)} |")
    print(f"| mean power less the exact one, in standard errors: mean | {z.mean():+.2f} |")
    print(f"| the same: rms | {np.sqrt(np.mean(z**2)):.2f} |")
    print(f"| the same: worst, and again | {scores[worst]:+.2f}, {again:+.2f} |")
    print(f"| within 2 standard errors | {100 * np.mean(np.abs(z) < 2):.0f} % |")
    print(f"| processor time | {minutes:.0f} min |")


if __name__ == "__main__":
    main()
