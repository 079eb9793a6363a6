"""Figures on shaping that docs/decisions/design.md cites.

Run with ``python benchmarks/robustness_shaping.py`` from the repository (a minute or two).
"""

import time

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

import lbt_synth as lbt
from lbt_synth.design.shaping.channel import Channel, laguerre_basis, mode_loop
from lbt_synth.design.shaping.solution import ModeSolution, solve_mode, solve_with_few
from lbt_synth.linear import Controller

RATE_HZ, NOISE_NM = 800.0, 15.5
PATH = lbt.LoopHardware(frame_rate_hz=RATE_HZ, modes=1)
AIR = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
DEMANDS = (
    lbt.design.shaping.ModulusMargin(at_least=0.45),
    lbt.design.shaping.LoopErrors(low=0.25, high=1.3),
)


def specification(gains: tuple[float, ...]) -> lbt.design.shaping.Specification:
    """Turbulence, noise and a vibration of 797 nm rms from 16.5 to 23.5 Hz."""
    terms: list[lbt.design.shaping.ResidualVariance | lbt.design.shaping.VibrationBand] = []
    for gain in gains:
        terms += [
            lbt.design.shaping.ResidualVariance(
                turbulence=AIR, noise_nm=NOISE_NM, sensor_gain=gain
            ),
            lbt.design.shaping.VibrationBand(
                low_hz=16.5, high_hz=23.5, rms_nm=797, sensor_gain=gain
            ),
        ]
    return lbt.design.shaping.Specification(
        objective=lbt.design.shaping.Total(terms=tuple(terms)), demands=DEMANDS
    )


def timed(
    spec: lbt.design.shaping.Specification, size: int, pole: float
) -> tuple[ModeSolution, float]:
    """Solve with Laguerre functions, and take the time."""
    basis = laguerre_basis(size, pole, dt_s=PATH.dt_s)
    start = time.perf_counter()
    found = solve_mode(spec, Channel(hardware=PATH, basis=basis))
    return found, time.perf_counter() - start


def truncated(long: Controller, order: int) -> Controller:
    """Balanced truncation; the basis is input-normal already."""
    observed = solve_discrete_lyapunov(long.A.T, long.A.T @ long.C.T @ long.C @ long.A)
    _, vectors = np.linalg.eigh(observed)
    keep = vectors[:, -order:]
    return Controller(
        A=keep.T @ long.A @ keep,
        B=keep.T @ long.B,
        C=long.C @ keep,
        D=np.zeros((1, 1)),
        dt_s=long.dt_s,
    )


def objective_nm(spec: lbt.design.shaping.Specification, parameter: Controller) -> float:
    """Root of the objective; nan if a loop is unstable."""
    try:
        return float(np.sqrt(spec.objective.measured_nm2(mode_loop(PATH, parameter))))
    except lbt.errors.UnstableLoopError:
        return float("nan")


def main() -> None:
    """Print all figures."""
    unit = specification((1.0,))
    limit = lbt.loop.least_worst_residual(
        PATH,
        lbt.Truth(turbulence=AIR, noise_nm=NOISE_NM),
        band_hz=(16.5, 23.5),
        rms_nm=797,
        direction=(1.0,),
    )
    print(f"limit without demands: {limit.rms_nm:.2f} nm")
    print("functions, pole: root of the objective at unit gain, seconds")
    for size, pole in ((60, 0.0), (120, 0.0), (30, 0.7), (60, 0.5), (60, 0.7), (60, 0.85)):
        found, seconds = timed(unit, size, pole)
        print(f"{size:4d} {pole:5.2f}: {found.objective_nm:6.2f} nm  {seconds:5.1f} s", flush=True)

    free = lbt.design.shaping.Specification(objective=unit.objective)
    print(f"without demands, 60 functions: {timed(free, 60, 0.7)[0].objective_nm:.2f} nm")

    several = specification((1.0, 0.7, 0.5, 0.358))
    long, seconds = timed(several, 60, 0.7)
    steps = ", ".join(f"{np.sqrt(v):.3f}" for v in long.objectives_nm2)
    print(f"four sensor gains, 60 functions: {long.objective_nm:.2f} nm, {seconds:.1f} s")
    print(f"  objective after each programme: {steps} nm")
    print("functions: truncated without a weight, truncated with it and solved again [nm]")
    for order in (30, 19, 15, 11):
        start = time.perf_counter()
        few = solve_with_few(several, long, order)
        seconds = time.perf_counter() - start
        cut = objective_nm(several, truncated(long.parameter, order))
        left = float("nan") if few is None else few.objective_nm
        print(f"{order:4d}: {cut:8.2f} {left:8.2f}  ({seconds:.1f} s)", flush=True)


if __name__ == "__main__":
    main()
