"""The structured singular value against SLICOT and dkpy.

    python benchmarks/structured_singular_value.py [dkpy]

Bounds of 200 random complex matrices with 2 to 5 blocks of each family, against AB13MD (through
slycot, of the test dependencies), and the largest value of a random search. ``dkpy`` compares the
first 200 with the upper bounds of that package instead (`pip install dkpy`), which bisects.
"""

import sys
import time
import warnings

import numpy as np
import slycot

from lbt_synth.linear import mu_bound

sys.path.insert(0, "tests")
from support.blocks import random_case, random_uncertainty

CASES, SEARCHED = 200, 200
FAMILIES = {
    "full complex": ("full",),
    "complex numbers and full": ("full", "complex"),
    "with real numbers": ("full", "complex", "real"),
}


def main():
    """Print a line for each family of blocks."""
    print(
        "| blocks | cases | largest upper bound over AB13MD's, less 1 | lower over upper: median, "
        "least | lower above upper | random search above upper | ms a matrix |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name, kinds in FAMILIES.items():
        above, ratios, wrong, beaten, spent = [], [], 0, 0, 0.0
        for seed in range(CASES):
            matrix, blocks, (sizes, types) = random_case(seed, kinds)
            begin = time.perf_counter()
            found = mu_bound(matrix, blocks)
            spent += time.perf_counter() - begin
            reference = slycot.ab13md(matrix, sizes, types)[0]
            size = np.linalg.norm(matrix, 2)
            above.append((found.upper - reference) / max(reference, 1e-3 * size))
            if reference > 1e-3 * size:
                ratios.append(found.lower / found.upper)
            if found.delta is not None:
                wrong += 1 / np.linalg.norm(found.delta, 2) > found.upper * (1 + 1e-11)
            if "real" not in kinds:  # a phase makes the loop singular
                rng = np.random.default_rng(seed)
                tries = (random_uncertainty(rng, blocks) for _ in range(SEARCHED))
                radius = max(np.abs(np.linalg.eigvals(matrix @ each)).max() for each in tries)
                beaten += radius > found.upper
        print(
            f"| {name} | {CASES} | {max(above):.1e} | {np.median(ratios):.4f}, {min(ratios):.2f} "
            f"| {wrong} | {'-' if 'real' in kinds else beaten} | {1e3 * spent / CASES:.0f} |"
        )


def _dkpy_bound(bisection, matrix, blocks):
    """Bound of dkpy; None where its solver ends in a panic, which is no Exception."""
    try:
        return bisection.compute_ssv(matrix[:, :, None], blocks)[0][0]
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        return None


def compare_with_dkpy():
    """Print how upper bounds of full blocks differ from those of dkpy's bisection."""
    import dkpy

    bisection = dkpy.SsvLmiBisection(n_jobs=None, solver_params={"solver": "CLARABEL"})
    warnings.simplefilter("ignore")
    above, spent, failed = [], np.zeros(2), 0
    for seed in range(CASES):
        matrix, blocks, (sizes, _) = random_case(seed, FAMILIES["full complex"])
        begin = time.process_time()
        upper = mu_bound(matrix, blocks).upper
        middle = time.process_time()
        theirs = [dkpy.ComplexFullBlock(int(size), int(size)) for size in sizes]
        found = _dkpy_bound(bisection, matrix, theirs)
        spent += middle - begin, time.process_time() - middle
        if found is None:
            failed += 1
        else:
            above.append(upper / found - 1)
    low, median, high = np.quantile(above, [0, 0.5, 1])
    own, other = 1e3 * spent / CASES
    print(f"{CASES} matrices, {failed} without an answer of dkpy")
    print(f"upper bound over dkpy's, less 1: {low:.1e} to {high:.1e}, median {median:.1e}")
    print(f"{own:.0f} ms a matrix, dkpy {other:.0f}")


if __name__ == "__main__":
    compare_with_dkpy() if "dkpy" in sys.argv[1:] else main()
