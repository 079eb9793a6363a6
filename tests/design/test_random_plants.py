"""Designs of many random plants, run by ``make study``."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

import lbt_synth as lbt


def random_plant(rng: np.random.Generator) -> lbt.models.TipTiltPlant:
    """One axis with 1 to 6 vibrations, AR1 or AR2 turbulence, noise over six decades."""
    rate = 800.0
    if rng.random() < 0.5:
        coefficients = [rng.uniform(0.9, 0.9999)]
    else:
        slow = 2 * np.pi * rng.uniform(0.2, 5) / rate
        damping = rng.uniform(0.05, 0.9)
        decay = np.exp(-damping * slow)
        coefficients = [2 * decay * np.cos(slow * np.sqrt(1 - damping**2)), -(decay**2)]
    unit = lbt.models.ARModel(coefficients=coefficients, driving_rms_nm=1.0, frame_rate_hz=rate)
    turbulence = lbt.models.ARModel(
        coefficients=coefficients, driving_rms_nm=600 / unit.rms_nm, frame_rate_hz=rate
    )
    vibrations = [
        lbt.Vibration(
            frequency_hz=rng.uniform(5, 150),
            damping=10 ** rng.uniform(-4, -1),
            rms_nm=10 ** rng.uniform(0, 3),
            direction=(1,),
        )
        for _ in range(rng.integers(1, 7))
    ]
    return lbt.tip_tilt_plant(
        frame_rate_hz=rate,
        delay_frames=int(rng.integers(1, 4)),
        turbulence=turbulence,
        vibrations=vibrations,
        noise_nm=10 ** rng.uniform(-3, 3),
        modes=1,
    )


def plain_residual(plant, P):
    """Relative residual of the filter equation in the 1-norm, in double precision."""
    cross = plant.C @ P @ plant.A.T
    APA = plant.A @ P @ plant.A.T
    gain = np.linalg.solve(plant.R + plant.C @ P @ plant.C.T, cross)
    residual = APA - P + plant.Q - cross.T @ gain
    return np.linalg.norm(residual, 1) / sum(np.linalg.norm(t, 1) for t in (P, APA, plant.Q))


@pytest.mark.study
def test_ten_thousand_random_plants_of_this_field(capsys):
    """Each equation is solved and stable; the plants on which scipy fails are counted beside."""
    rng = np.random.default_rng(0)
    worst, plain, radius, refused, wrong, routes = 0.0, 0.0, 0.0, 0, 0, set()
    count = 10_000
    for _ in range(count):
        plant = random_plant(rng)
        parts = (plant.A.T, plant.C.T, plant.Q, plant.R)
        solution = lbt.solve_dare(*parts)
        worst, plain = max(worst, solution.residual), max(plain, plain_residual(plant, solution.X))
        radius = max(radius, float(np.max(np.abs(solution.poles))))
        routes.add(solution.route)
        try:
            X = scipy.linalg.solve_discrete_are(*parts)
            gain = np.linalg.solve(plant.R + plant.C @ X @ plant.C.T, plant.C @ X @ plant.A.T)
            wrong += not np.max(np.abs(np.linalg.eigvals(plant.A - gain.T @ plant.C))) < 1
        except (np.linalg.LinAlgError, ValueError):
            refused += 1
    with capsys.disabled():
        print(
            f"\n{count} plants: worst residual {worst:.2g} in balanced units, {plain:.2g} in the "
            f"plant's, largest spectral radius 1 - {1 - radius:.2g}, routes {sorted(routes)}; "
            f"scipy refused {refused} and gave {wrong} unstable filters"
        )
    assert worst < 1e-12
    assert plain < 1e-12
    assert radius < 1


@pytest.mark.study
def test_designs_of_random_plants(capsys):
    """Kalman and H-infinity designs of 1,000 plants, certified, the least gamma bracketed."""
    rng = np.random.default_rng(0)
    gaps = []
    for _ in range(1000):
        plant = random_plant(rng)
        assert lbt.kalman(plant).certificate.passed
        design = lbt.hinf(plant, gamma_ratio=1.2, route="riccati")
        assert design.certificate.passed
        gaps.append(design.gamma_least / design.gamma_infeasible - 1)
    with capsys.disabled():
        print(
            f"\n1000 plants: gap of the least gamma, median {np.median(gaps):.2g}, 99th percentile "
            f"{np.percentile(gaps, 99):.2g}, largest {max(gaps):.2g}"
        )
    assert max(gaps) < 1e-5
