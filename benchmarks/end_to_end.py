"""End-to-end figures quoted in the documentation: leak, gain with the vibration, the clamp, OMGI.

Needs the extra e2e; run with ``python benchmarks/end_to_end.py leak|gain|noise|omgi|sensors``.
"""

import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import lbt_synth as lbt
from lbt_synth.interop.specula import optics
from lbt_synth.interop.specula.simulation import EndToEndRun

SETUP = replace(lbt.load_config("examples/lbt.yaml").end_to_end, frames=800)
STILL = replace(SETUP, vibrations=())


@lru_cache
def calibration(config: str) -> optics.Calibration:
    return optics.calibrate(lbt.load_config(config).end_to_end)


def run(
    setup: optics.EndToEndSetup,
    controller: Any = None,
    config: str = "examples/lbt.yaml",
) -> EndToEndRun:
    known = calibration(config)
    return lbt.interop.run_end_to_end(setup, controller, calibration=known)


def mean(runs: list[EndToEndRun]) -> str:
    strehls = [100 * run.strehl for run in runs]
    gains = [run.tip_tilt_gain for run in runs]
    noise = [run.summary()["tip_tilt_noise_nm"] for run in runs]
    return (
        f"Strehl ratio {np.mean(strehls):.1f} % ({', '.join(f'{s:.1f}' for s in strehls)}), "
        f"optical gain {np.mean(gains):.3f}, left of tip and tilt {np.mean(noise):.1f} nm"
    )


def leaks() -> None:
    for leak in (1.0, 0.99, 0.98, 0.97, 0.95):
        runs = [run(replace(STILL, leak=leak, seed=s)) for s in (1, 2)]
        print(f"leak {leak} from mode 50 on: {mean(runs)}", flush=True)


def gains() -> None:
    for gain in (0.5, 0.56, 0.7, 0.9, 1.1):
        runs = [run(replace(SETUP, seed=1), lbt.integrator(SETUP.hardware, gain=gain))]
        rms = np.hypot(*runs[0].rms_nm[:2])
        print(f"classical, gain {gain} with the vibration: {mean(runs)}, {rms:.0f} nm", flush=True)


def clamp() -> None:
    for value, name in ((optics.NO_CLAMP, "negative pixels kept"), (0.0, "set to zero")):
        optics.NO_CLAMP = value
        runs = [run(replace(STILL, seed=1))]
        print(f"{name}: {mean(runs)}", flush=True)


def optimised() -> None:
    """Gains from the telemetry of one run, tried on the same air and on another."""
    setup = replace(STILL, frames=3200)
    first = run(replace(setup, seed=1))
    path = setup.hardware
    gains = np.maximum(first.optical_gain()[0], 0.1)
    found = lbt.design.modal.modal_gains_from_telemetry(
        first.measurements,
        first.commands,
        hardware=path,
        sensor_gain=gains,
        margin=0.3,
    )
    for low, high in ((0, 2), (2, 20), (20, 100), (100, 300), (300, 672)):
        part = slice(low, high)
        print(
            f"modes {low} to {high - 1}: optical gain {gains[part].mean():.2f}, "
            f"optimised gain {found.gains[part].mean():.2f}",
            flush=True,
        )
    control = lbt.design.modal.MixedController(gains=found.gains, leak=setup.leaks)
    for seed in (1, 2):
        uniform = first if seed == 1 else run(replace(setup, seed=seed))
        still = replace(setup, vibrations=(), motions=(), settle_frames=400, seed=seed)
        best = run(still, control)
        print(f"seed {seed}, gain {setup.gain}: {mean([uniform])}", flush=True)
        print(f"seed {seed}, optimised: {mean([best])}", flush=True)


def sensors() -> None:
    """A dim star with and without its accelerometer, beside the exact analysis of each run."""
    text = Path("examples/several_sensors.yaml").read_text(encoding="utf-8")
    print(
        "| gain of the model | filter | Strehl ratio | tip | exact | tilt | exact | optical gain |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for assumed in (1.0, 0.35):
        with TemporaryDirectory() as folder:
            file = Path(folder) / "dim.yaml"
            file.write_text(text.replace("model:", f"model:\n  sensor_gain: {assumed}", 1))
            config = lbt.load_config(file)
        alone = {"wavefront alone": lbt.kalman(config.plant.own_sensor_alone())}
        for name, design in ({"with accelerometer": config.design("kalman")} | alone).items():
            rows = np.array([sensor_row(config, design, seed) for seed in range(3)])
            mid, error = rows.mean(axis=0), rows.std(axis=0, ddof=1)
            cells = [f"{100 * mid[0]:.1f} ± {100 * error[0]:.1f}"]
            cells += [f"{m:.0f} ± {e:.0f}" for m, e in zip(mid[1:5], error[1:5], strict=True)]
            print(f"| {assumed} | {name} | {' | '.join(cells)} | {mid[5]:.2f} |", flush=True)


def sensor_row(config: lbt.config.Config, design: lbt.Design, seed: int) -> list[float]:
    """Return Strehl ratio, tip and its exact residual, tilt and its own, and the optical gain."""
    setup = replace(config.end_to_end, seed=seed)
    seen = run(setup, design, "examples/several_sensors.yaml")
    # gains are relative to what the design assumes
    gain = seen.tip_tilt_gain / config.sensor_gain
    truth = replace(config.truth, noise_nm=seen.summary()["tip_tilt_noise_nm"], sensor_gain=gain)
    missing = ("truth",) if design.other_sensors else ()
    own = design.controllers[frozenset(missing)]
    loop = lbt.close_loop(config.hardware, own, sensor_gain=gain, blind=missing)
    exact = np.sqrt(np.diag(lbt.residual_budget(loop, truth, frame_means=True).total_nm2))
    tip, tilt = seen.rms_nm[:2]
    return [seen.strehl, tip, exact[0], tilt, exact[1], seen.tip_tilt_gain]


if __name__ == "__main__":
    {"leak": leaks, "gain": gains, "noise": clamp, "omgi": optimised, "sensors": sensors}[
        sys.argv[1]
    ]()
