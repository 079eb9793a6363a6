"""The tables and figures of docs/mirror.md.

Run with ``python benchmarks/mirror.py`` from the repository (some 30 seconds). With a
directory as its argument it writes the figures there.
"""

import sys
from dataclasses import replace

import numpy as np

import lbt_synth as lbt
from lbt_synth.loop.least_residual import least_residual
from lbt_synth.report.draw import save_figure
from lbt_synth.report.figures.studies import mirror_figure
from lbt_synth.studies.robustness import compare_on_mirror

CONFIG = lbt.load_config("examples/lbt.yaml")
SHELL = {"natural_frequency_hz": 20.0, "damping": 0.5}
MIRRORS = {"settled": None} | {
    f"{hz} Hz": lbt.models.PositionLoop.from_bandwidth(**SHELL, bandwidth_hz=hz)
    for hz in (500, 250, 150, 100, 60)
}


def moving(
    plant: lbt.models.TipTiltPlant, mirror: lbt.models.PositionLoop | None
) -> lbt.models.TipTiltPlant:
    """Return the same plant with another mirror."""
    return replace(plant, hardware=replace(plant.hardware, mirror=mirror))


def study(plant: lbt.models.TipTiltPlant) -> None:
    """Residual, Strehl ratio and what is left, for every mirror and design."""
    names = "integrator", "kalman, settled", "kalman, real", "lqg"
    print(f"{'mirror':8s} {'settles':>8s}" + "".join(f"{n:>26s}" for n in names))
    for name, mirror in MIRRORS.items():
        here = moving(plant, mirror)
        settling = 0.0 if mirror is None else 1e3 * mirror.step_response().settling_s
        rows = compare_on_mirror(here, CONFIG.truth, CONFIG.imaging).rows
        cells = [
            f"{r.residual_nm:8.2f} {100 * r.strehl:6.2f}" if r.stable else "unstable" for r in rows
        ]
        print(f"{name:8s} {settling:5.2f} ms" + "".join(f"{c:>26s}" for c in cells))


def delays() -> None:
    """Fractional delays of a settled mirror: the interpolated target and the LQG."""
    print("delay: Kalman (interpolated target), lqg, limit, the model as the truth [nm]")
    pole = CONFIG.plant
    for delay in (2.0, 2.25, 2.4, 2.6, 2.75, 3.0):
        plant = lbt.tip_tilt_plant(
            frame_rate_hz=800,
            delay_frames=delay,
            turbulence=pole.turbulence,
            vibrations=pole.vibrations,
            noise_nm=pole.R,
        )
        found = [
            lbt.residual_budget(lbt.close_loop(plant.hardware, d.controller), plant).rms_nm
            for d in (lbt.kalman(plant), lbt.lqg(plant))
        ]
        limit = least_residual(plant.hardware, plant).rms_nm
        print(f"{delay:5.2f}: {found[0]:8.3f} {found[1]:8.3f} {limit:8.3f}")


def stable_to(hardware: lbt.LoopHardware, design: lbt.Design, low: float, high: float) -> float:
    """Last stable bandwidth [Hz] between a stable and an unstable one.

    Print it rounded towards the stable side.
    """

    def is_stable(bandwidth: float) -> bool:
        mirror = lbt.models.PositionLoop.from_bandwidth(**SHELL, bandwidth_hz=bandwidth)
        real = replace(hardware, mirror=mirror)
        return lbt.close_loop(real, design.controller).is_stable

    if is_stable(low) and is_stable(high):
        return high  # it is stable in all that is tried
    inside, outside = (low, high) if is_stable(low) else (high, low)
    for _ in range(30):
        middle = (inside * outside) ** 0.5
        inside, outside = (middle, outside) if is_stable(middle) else (inside, middle)
    return inside


def errors() -> None:
    """How wrong the mirror may be: ends of stability, residual with a wrong bandwidth."""
    settled = lbt.kalman(CONFIG.plant)
    edge = stable_to(CONFIG.hardware, settled, 500, 250)
    mirror = lbt.models.PositionLoop.from_bandwidth(**SHELL, bandwidth_hz=edge)
    real = replace(CONFIG.hardware, mirror=mirror)
    poles = lbt.close_loop(real, settled.controller).system.poles
    fails_hz = abs(np.angle(poles[np.argmax(np.abs(poles))])) * real.frame_rate_hz / (2 * np.pi)
    there = np.sum(real.mirror_taps * (-1.0) ** np.arange(real.mirror_taps.size))
    print(
        f"kalman, settled: stable down to {np.ceil(10 * edge) / 10:.1f} Hz, settling in "
        f"{1e3 * mirror.step_response().settling_s:.2f} ms; fails at {fails_hz:.0f} Hz, where the "
        f"amplitude of the mirror is {abs(there):.3f}"
    )
    for believed in (500, 100):
        here = moving(CONFIG.plant, MIRRORS[f"{believed} Hz"])
        design = lbt.lqg(here)
        margins = lbt.loop_margins(lbt.close_loop(here.hardware, design.controller))
        low = stable_to(here.hardware, design, believed, max(believed / 20, 20.0))
        high = stable_to(here.hardware, design, believed, believed * 8)
        print(
            f"lqg for {believed} Hz: stable from {np.ceil(10 * low) / 10:.1f} to "
            f"{np.floor(10 * high) / 10:.1f} Hz, "
            f"modulus {margins.modulus:.3f}, delay margin {margins.delay_frames:.2f} frames"
        )
        for factor in (0.9, 0.95, 1.05, 1.1):
            real = lbt.models.PositionLoop.from_bandwidth(**SHELL, bandwidth_hz=believed * factor)
            loop = lbt.close_loop(replace(here.hardware, mirror=real), design.controller)
            budget = lbt.residual_budget(loop, CONFIG.truth) if loop.is_stable else None
            text = "unstable" if budget is None else f"{budget.rms_nm:.2f} nm"
            print(f"  real bandwidth {believed * factor:g} Hz: {text}")


def main() -> None:
    """Print the tables, write the figures."""
    print("AR1 turbulence in the filters (examples/lbt.yaml)")
    study(CONFIG.plant)
    print("AR2 turbulence in the filters")
    ar2 = lbt.models.ar2_turbulence(CONFIG.atmosphere, frame_rate_hz=800, noise_nm=CONFIG.noise_nm)
    study(
        lbt.tip_tilt_plant(
            frame_rate_hz=800,
            turbulence=ar2,
            vibrations=CONFIG.plant.vibrations,
            noise_nm=CONFIG.noise_nm,
        )
    )
    delays()
    errors()
    if len(sys.argv) > 1:
        for name, file in (("500 Hz", "mirror_quick.png"), ("100 Hz", "mirror_slow.png")):
            shell = MIRRORS[name]
            figure = mirror_figure(shell, replace(CONFIG.hardware, mirror=shell))
            print(save_figure(figure, f"{sys.argv[1]}/{file}"))


if __name__ == "__main__":
    main()
