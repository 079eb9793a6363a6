"""What things cost and buy: run with ``python benchmarks/architecture.py`` from the repository."""

import subprocess
import sys
import time
import warnings

import control
import numpy as np

import lbt_synth as lbt
from lbt_synth.models import TipTiltPlant

CONFIG = lbt.load_config("examples/lbt.yaml")
PLANT: TipTiltPlant = CONFIG.plant


def ratios() -> None:
    """Properties of the filter over the ratio of gamma to the least one."""
    designs = {"kalman": lbt.kalman(PLANT)}
    designs |= {
        f"hinf {ratio}": lbt.hinf(PLANT, gamma_ratio=ratio, route="riccati")
        for ratio in (1.0, 1.01, 1.05, 1.1, 1.2, 1.3, 1.5)
    }
    for name, design in designs.items():
        low, high = lbt.loop.stable_sensor_gains(PLANT.hardware, design.controller)
        loop = lbt.close_loop(PLANT.hardware, design.controller)
        budget = lbt.residual_budget(loop, CONFIG.truth, frame_means=True)
        print(
            f"{name:10s} norm {design.gamma:7.2f} nm, rms {design.rms:7.2f} nm, stable for sensor "
            f"gains {low:.3f} to {high:.3f}, residual {budget.rms_nm:5.1f} nm"
        )


def reduced() -> None:
    """The Kalman gain with and without the known input among the states."""
    form = PLANT.full()
    problem = lbt.EstimationProblem(
        **{name: getattr(form, name) for name in "ABCDL"}, dt_s=PLANT.dt_s
    )
    small, full = lbt.kalman(PLANT), lbt.kalman(problem)
    rows = small.gain_predictor.shape[0]
    print(
        f"full form: {len(full.gain_predictor)} states, gain differs by "
        f"{np.max(np.abs(full.gain_predictor[:rows] - small.gain_predictor)):.1e}, "
        f"gain on the command {np.max(np.abs(full.gain_predictor[rows:])):.1e}"
    )


def turbulence_models() -> None:
    """AR1 and AR2 turbulence against the integrator, without any vibration."""
    calm = lbt.Truth(turbulence=CONFIG.atmosphere, noise_nm=CONFIG.noise_nm)
    path = PLANT.hardware
    designs = {"integrator": lbt.design.optimal_integrator(path, calm)}
    for name, model in (
        ("Kalman, AR1", lbt.models.ar1_turbulence(CONFIG.atmosphere, frame_rate_hz=800)),
        (
            "Kalman, AR2",
            lbt.models.ar2_turbulence(
                CONFIG.atmosphere, frame_rate_hz=800, noise_nm=CONFIG.noise_nm
            ),
        ),
    ):
        designs[name] = lbt.kalman(
            lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=model, noise_nm=CONFIG.noise_nm)
        )
    for name, design in designs.items():
        budget = lbt.residual_budget(
            lbt.close_loop(path, design.controller), calm, frame_means=True
        )
        low, high = lbt.loop.stable_sensor_gains(path, design.controller)
        print(
            f"{name:12s} residual {budget.rms_nm:5.1f} nm (turbulence {budget.turbulence_nm:.1f}, "
            f"noise {budget.noise_nm:.1f}), Strehl "
            f"{100 * lbt.strehl(budget, CONFIG.imaging):.1f} %, "
            f"sensor gains {low:.3f} to {high:.3f}"
        )


def fractional() -> None:
    """What interpolation between two frames costs at a fractional delay."""
    for delay in (2.0, 2.25, 2.5, 2.75, 3.0):
        plant = lbt.tip_tilt_plant(
            frame_rate_hz=800,
            turbulence=PLANT.turbulence,
            vibrations=PLANT.vibrations,
            noise_nm=CONFIG.noise_nm,
            delay_frames=delay,
        )
        design = lbt.kalman(plant)
        loop = lbt.close_loop(plant.hardware, design.controller)
        model = lbt.Truth(
            turbulence=PLANT.turbulence[0], vibrations=PLANT.vibrations, noise_nm=CONFIG.noise_nm
        )
        print(
            f"delay {delay}: estimation error {design.rms:.2f} nm, "
            f"residual {lbt.residual_budget(loop, model, frame_means=True).rms_nm:.2f} nm"
        )


def norms() -> None:
    """The H-infinity norm of an error system: level sets, python-control, a fine grid."""
    warnings.simplefilter("ignore")  # python-control warns of poles near the unit circle
    error = PLANT.error_system(lbt.kalman(PLANT).gain_predictor)
    ours = lbt.hinf_norm(error)
    grid = np.linspace(0, 400, 400_001)
    best = float(np.max(lbt.linear.largest_singular_values(error, grid)))
    theirs = control.norm(error.to_control(), "inf")
    print(f"norm: level sets {ours.value:.9f}, grid {best:.9f}, python-control {theirs:.9f}")
    lag = lbt.linear.StateSpace(A=[[1 - 1e-6]], B=[[1e-6]], C=[[1.0]], D=[[0.0]])
    print(
        f"norm of a pole at 1 - 1e-6: level sets {lbt.hinf_norm(lag).value:.9f}, "
        f"python-control {control.norm(lag.to_control(), 'inf')}"
    )


def speed() -> None:
    """Simulation by blocks and frame by frame."""
    design = lbt.kalman(PLANT)
    began = time.perf_counter()
    fast = lbt.simulate(
        design.controller, CONFIG.truth, hardware=PLANT.hardware, frames=8000, settle_frames=1000
    )
    middle = time.perf_counter()
    slow = lbt.simulate(
        design.controller.start(),
        CONFIG.truth,
        hardware=PLANT.hardware,
        frames=8000,
        settle_frames=1000,
    )
    end = time.perf_counter()
    apart = np.max(np.abs(fast.residual_nm - slow.residual_nm))
    print(
        f"9000 frames: blocks {middle - began:.3f} s, frame by frame {end - middle:.3f} s, "
        f"residuals differ by {apart:.1e} nm"
    )


def imports() -> None:
    """Modules that a plain import and a Riccati design bring in."""
    heavy = ("cvxpy", "control", "matplotlib", "astropy", "pydantic", "scipy")
    for code in (
        "import lbt_synth",
        "import lbt_synth as lbt; lbt.kalman; lbt.hinf",
    ):
        script = f"import sys; {code}; print([m for m in {heavy} if m in sys.modules])"
        began = time.perf_counter()
        loaded = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, check=True
        ).stdout.strip()
        print(f"{code!r}: {time.perf_counter() - began:.2f} s, of {len(heavy)} loaded {loaded}")


if __name__ == "__main__":
    print(f"noise {CONFIG.noise_nm:.2f} nm, tilt {CONFIG.atmosphere.tilt_rms_nm:.1f} nm")
    ratios()
    reduced()
    turbulence_models()
    fractional()
    norms()
    speed()
    imports()
