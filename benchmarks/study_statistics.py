"""How far statistics of studies can be trusted, and their cost: docs/study_statistics.md."""

from __future__ import annotations

import resource
import time

import numpy as np
from scipy.stats import qmc

import lbt_synth as lbt
from lbt_synth.studies.study.statistics import first_order_index, percentiles

KINDS = ("independent", "latin hypercube", "sobol")


def draw(kind, n, dimensions, seed):
    if kind == "independent":
        return np.random.default_rng(seed).random((n, dimensions))
    engine = qmc.Sobol if kind == "sobol" else qmc.LatinHypercube
    return engine(dimensions, rng=seed).random(n)


def ishigami(u):
    x = np.pi * (2 * u - 1)
    return np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])


def exact_indices():
    first = (1 + 0.1 * np.pi**4 / 5) ** 2 / 2
    second, both = 7**2 / 8, 0.1**2 * np.pi**8 * (1 / 18 - 1 / 50)
    return np.array([first, second, 0, 0]) / (first + second + both)


def index_errors(repeats=100):
    print("Ishigami, six parameters: rms error of the four indices over 100 samplings, and the")
    print("mean of the standard errors [%]")
    for n in (256, 1024, 4096, 16384):
        for kind in KINDS:
            found = []
            for seed in range(repeats if n < 10_000 else 20):
                u = draw(kind, n, 6, seed)
                y = ishigami(u)
                orders = [np.argsort(u[:, j]) for j in range(4)]
                found.append([first_order_index(u[o, j], y[o]) for j, o in enumerate(orders)])
            values, errors = np.moveaxis(np.array(found), 2, 0)
            rms = 100 * np.sqrt(np.mean((values - exact_indices()) ** 2, axis=0))
            print(
                f"{n:6d}  {kind:16s}",
                " ".join(f"{value:5.2f}" for value in rms),
                "  | ",
                " ".join(f"{value:5.2f}" for value in 100 * errors.mean(axis=0)),
            )


def pairs_of_a_sobol_sequence():
    """A function of one parameter alone, and the index of each of the seven others."""
    print("\nSobol sequences of eight parameters, y = exp(-25 (x_i - 1/2)^2): the largest index")
    print("of any other parameter in 20 sequences [%], and its ratio to its standard error")
    for n in (512, 1024, 2048, 4096, 16384):
        worst, ratio = 0.0, 0.0
        for seed in range(20):
            u = draw("sobol", n, 8, seed)
            y = np.exp(-25 * (u - 0.5) ** 2)
            for j in range(8):
                order = np.argsort(u[:, j])
                for i in set(range(8)) - {j}:
                    value, error = first_order_index(u[order, j], y[order, i])
                    worst, ratio = max(worst, value), max(ratio, value / error)
        print(f"{n:6d}  {100 * worst:5.2f}  {ratio:4.1f}")


def coverage(repeats=2000, n=512):
    """Of a sum of three parameters, the intervals of 95 %."""
    print(f"\nIntervals that hold the true percentile, {repeats} samplings of {n} [%]")
    weights = np.array([1, 0.5, 0.2])
    reference = draw("sobol", 2**20, 3, 10**6) @ weights
    chosen = (1, 5, 50)
    true = np.percentile(reference, chosen)
    for kind in KINDS:
        held = np.zeros(3)
        for seed in range(repeats):
            found = percentiles(draw(kind, n, 3, seed) @ weights, chosen)
            held += [
                not (each.low > value or each.high < value)
                for each, value in zip(found.values(), true, strict=True)
            ]
        print(
            f"{kind:16s}",
            "  ".join(
                f"{percent} %: {100 * part:5.1f}"
                for percent, part in zip(chosen, held / repeats, strict=True)
            ),
        )


def cost(n=2**20):
    rng = np.random.default_rng(0)
    names = [f"p{i}" for i in range(7)]
    columns = {name: rng.random(n) for name in names}
    for name in "abcd":
        columns[f"{name}.stable"] = np.ones(n)
        columns[f"{name}.strehl"] = 0.8 * columns["p0"] * rng.random(n)
        columns[f"{name}.residual_nm"] = rng.random(n)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    start = time.process_time()
    lbt.studies.study_statistics(columns, names, list("abcd"))
    spent = time.process_time() - start
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"\n{n} samples, 7 parameters, 4 controllers: {spent:.1f} s, {after - before:.0f} MB more"
    )


if __name__ == "__main__":
    index_errors()
    pairs_of_a_sobol_sequence()
    coverage()
    cost()
