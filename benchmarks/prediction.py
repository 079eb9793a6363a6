"""Prediction against data: run with ``python benchmarks/prediction.py`` from the repository.

An integrator ran for a minute. Tables of a model that is right, of one whose lines are 3 Hz too
high, and of one whose sensor gain is 20 % too large; how well the standard errors of 200 nights
cover the truth; and how long replays take.
"""

from __future__ import annotations

import numpy as np
from harness import seconds

import lbt_synth as lbt
from lbt_synth.identification import prediction_against_data, replayed_residual
from lbt_synth.models import LoopHardware, TipTiltPlant
from lbt_synth.models.loop_hardware import past_corrections
from lbt_synth.models.plant.tip_tilt import retuned_plant

RATE, GAIN, FRAMES, NOISE_NM = 800, 0.6, 48_000, 15.5
CAMERA = lbt.Imaging(diameter_m=8.22)
LINES = (
    lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=300, direction=(1, 0)),
    lbt.Vibration(frequency_hz=33, damping=0.02, rms_nm=100, direction=(0, 1)),
)
SWELL = lbt.models.ar2_turbulence(
    lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22),
    frame_rate_hz=RATE,
    noise_nm=NOISE_NM,
)


def model(sensor_gain: float = GAIN) -> TipTiltPlant:
    return lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=SWELL,
        vibrations=LINES,
        noise_nm=NOISE_NM,
        sensor_gain=sensor_gain,
    )


def night(path: LoopHardware, seed: int, frames: int = FRAMES):
    """Return measurements and commands of an integrator's loop, and its controller."""
    ran = lbt.integrator(path, gain=0.3).controller
    truth = lbt.Truth(turbulence=SWELL, vibrations=LINES, noise_nm=NOISE_NM)
    run = lbt.simulate(ran, truth, hardware=path, frames=frames, seed=seed, settle_frames=0)
    return run.measurements[0], run.commands[0], ran


def open_loop(y: np.ndarray, u: np.ndarray, path: LoopHardware) -> np.ndarray:
    """Return the pseudo-open-loop series, without the first frames."""
    return (y @ np.linalg.inv(path.sensor).T + past_corrections(path.mirror_taps, u))[2:]


def show(name: str, plant: TipTiltPlant, designs: dict[str, lbt.Design]) -> None:
    """Print the table of a model, and the difference of two residuals on the same frames."""
    path = plant.hardware
    y, u, ran = night(model().hardware, 2)
    z = open_loop(y, u, path)
    table = prediction_against_data(
        plant, z, designs, measurements=y[2:], running=ran, imaging=CAMERA
    )
    print(f"{name}: fit {table.fit}, test {table.test}")
    for row in table.entries:
        tip, tilt = row.model_axis_nm
        if row.replayed is not None:
            tip, tilt = np.sqrt(row.replayed.variance_nm2)
        print(
            f"| {row.name} | {tip:.1f}, {tilt:.1f} | {row.replayed_nm:.1f} +- "
            f"{row.replayed_error_nm:.1f} | {row.model_nm:.1f} | {row.ratio:.2f} | "
            f"{100 * row.strehl:.1f} | {100 * row.model_strehl:.1f} |"
        )
    if len(designs) > 1:
        first, second = (table[label].replayed for label in designs)
        difference, error = second.above(first)
        apart = np.hypot(first.total_error_nm2, second.total_error_nm2)
        print(f"less Kalman: {difference:.0f} +- {error:.0f} nm^2, unpaired +- {apart:.0f}")


def errors(nights: int = 200) -> None:
    """Print how far replays are from the exact residual, in their standard errors."""
    plant = model()
    path, design = plant.hardware, lbt.kalman(plant)
    budget = lbt.residual_budget(lbt.close_loop(path, design.controller), plant, frame_means=True)
    deviations = []
    for seed in range(nights):
        y, u, _ = night(path, 1000 + seed, 6000)
        residual = replayed_residual(
            open_loop(y, u, path), design.controller, path, noise_nm=NOISE_NM
        )
        deviations.append((residual.total_nm2 - budget.rms_nm**2) / residual.total_error_nm2)
    print(
        f"{nights} nights of 6000 frames: deviations have a mean of {np.mean(deviations):+.2f} and "
        f"a scatter of {np.std(deviations):.2f} standard errors, the largest "
        f"{np.max(np.abs(deviations)):.1f}"
    )


def times() -> None:
    """Print how long four replays of 30,000 frames take, and a table of them."""
    plant = model()
    path = plant.hardware
    y, u, _ = night(path, 2, 30_002)
    z = open_loop(y, u, path)
    four = {str(gain): lbt.integrator(path, gain=gain).controller for gain in (0.1, 0.2, 0.3, 0.5)}
    replays = seconds(
        lambda: [replayed_residual(z, k, path, noise_nm=NOISE_NM) for k in four.values()], 5
    )
    table = seconds(lambda: prediction_against_data(plant, z, four, imaging=CAMERA), 5)
    search = seconds(lambda: lbt.integrator(plant.hardware, truth=plant), 5)
    print(
        f"four replays {1e3 * replays:.0f} ms, the table {1e3 * table:.0f} ms, of which the best "
        f"integrator {1e3 * search:.0f} ms"
    )


if __name__ == "__main__":
    right = model()
    bound = lbt.hinf(right, gamma_ratio=1.2, route="riccati")
    show("a model that is right", right, {"Kalman": lbt.kalman(right), "H-infinity, 1.2": bound})
    for name, wrong in (
        ("lines 3 Hz too high in the model", retuned_plant(right, 3.0)),
        ("sensor gain believed 20 % too large", model(1.2 * GAIN)),
    ):
        show(name, wrong, {"Kalman": lbt.kalman(wrong)})
    errors()
    times()
