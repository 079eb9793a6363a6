"""How accurate the engine is, and what its choices buy: ``python benchmarks/decisions_linear.py``.

Needs the test dependencies (SLICOT through slycot, mpmath).
"""

import sys

import mpmath
import numpy as np
from scipy.optimize import minimize

import lbt_synth as lbt
from lbt_synth.linear.lyapunov import stationary_covariance

sys.path.insert(0, "tests")
from support.darex import (
    EXAMPLES,
    example_2_1,
    example_2_4,
    peers,
    relative,
)
from support.plants import lbt_axis_plant
from support.systems import random_system


def exact_solution(e) -> mpmath.matrix:
    """Newton's method with 40 digits on the data as they are in double precision."""
    with mpmath.workdps(40):
        A, B, Q, R, X = (mpmath.matrix(M.tolist()) for M in (e.A, e.B, e.Q, e.R, e.X))
        for _ in range(6):
            gain = mpmath.inverse(R + B.T * X * B) * (B.T * X * A)
            power = A - B * gain
            X = Q + gain.T * R * gain
            for _ in range(60):
                X, power = X + power.T * X * power, power * power
        return X


def error_in_digits(X: np.ndarray, exact: mpmath.matrix) -> float:
    with mpmath.workdps(40):
        difference = mpmath.matrix(X.tolist()) - exact
        return float(mpmath.sqrt(sum(x * x for x in difference) / sum(x * x for x in exact)))


def darex() -> None:
    """Relative errors on the examples with known solutions."""
    print(f"{'DAREX':20s} {'ours':>9s} {'scipy':>9s} {'slycot':>9s}")
    for e in EXAMPLES:
        found = peers(e)
        errors = [relative(lbt.solve_dare(e.A, e.B, e.Q, e.R).X, e.X)]
        errors += [relative(found[k], e.X) if k in found else np.nan for k in ("scipy", "slycot")]
        print(f"{e.name:20s} " + " ".join(f"{x:9.1e}" for x in errors))
    print("the same against the exact solution of the data in double precision:")
    for e in (example_2_1(1e6), example_2_4(1e6)):
        exact = exact_solution(e)
        answers = {"ours": lbt.solve_dare(e.A, e.B, e.Q, e.R).X} | peers(e)
        errors = [f"{name} {error_in_digits(X, exact):.1e}" for name, X in answers.items()]
        print(f"{e.name:20s} " + ", ".join(errors))


def responses() -> None:
    """The Schur form and single solutions next to a pole at 1 - 1e-6."""
    A, B, C, D = random_system(0, 6, 1, 2, 1 - 1e-6)
    system = lbt.linear.StateSpace(A=A, B=B, C=C, D=D)
    with mpmath.workdps(40):
        G = mpmath.matrix(C.tolist()) * mpmath.lu_solve(
            -mpmath.eye(6) - mpmath.matrix(A.tolist()), mpmath.matrix(B.tolist())
        ) + mpmath.matrix(D.tolist())
        exact = float(mpmath.sqrt(sum(abs(x) ** 2 for x in G)))
    one = lbt.linear.largest_singular_values(system, [0.5])[0]
    many = lbt.linear.largest_singular_values(system, np.linspace(0, 0.5, 101))[-1]
    print(
        f"response next to a pole at 1 - 1e-6: Schur form {abs(many / exact - 1):.1e}, "
        f"one by one {abs(one / exact - 1):.1e}"
    )


def mixed() -> None:
    """Least variance at 1.05 times the least gamma: central, best own gain, mixed."""
    plant = lbt_axis_plant()
    bound = 1.05 * lbt.hinf(plant, route="riccati").gamma_least
    central = lbt.design.central_filter(plant, gamma=bound)
    gain = central.gain_predictor
    unit = np.abs(gain.ravel())

    def deviation(g):
        error = plant.error_system((g * unit).reshape(gain.shape))
        if not error.spectral_radius < 1:
            return 1e6
        P = stationary_covariance(error.A, error.B @ error.B.T)
        return float(np.sqrt(np.trace(plant.L @ P @ plant.L.T)))

    def room(g):
        error = plant.error_system((g * unit).reshape(gain.shape))
        return (bound - float(lbt.hinf_norm(error))) / 100 if error.spectral_radius < 1 else -10.0

    found = minimize(
        lambda g: deviation(g) ** 2 / 1e4,
        gain.ravel() / unit,
        method="SLSQP",
        constraints=[{"type": "ineq", "fun": room}],
        options={"maxiter": 200, "ftol": 1e-10},
    )
    own = deviation(found.x)
    print(f"rms at {bound:.2f} nm: central {central.rms:.2f}, best own gain {own:.2f}")
    for taps in (1, 4, 16, 48, 64):
        design = lbt.mixed(plant, gamma=bound, taps=taps)
        print(f"  mixed, {taps} taps: {design.rms:.3f} nm, {design.solver.iterations} rounds")


if __name__ == "__main__":
    with np.errstate(all="ignore"):
        darex()
    responses()
    mixed()
