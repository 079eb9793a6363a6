"""Prediction against data: run with ``python benchmarks/prediction.py`` from the repository.

An integrator ran for a minute. Tables of a model that is right, of one whose lines are 3 Hz too
high, and of one whose sensor gain is 20 % too large; how well the standard errors of 200 nights
cover the truth; and how long a table takes.
"""

from __future__ import annotations

import numpy as np
from harness import seconds

import lbt_synth as lbt
from lbt_synth.identification import LoopRecord, prediction_against_data
from lbt_synth.models import LoopHardware, TipTiltPlant
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


def night(path: LoopHardware, seed: int, frames: int = FRAMES) -> tuple[LoopRecord, lbt.Controller]:
    """Return the record of an integrator's loop, and its controller."""
    ran = lbt.integrator(path, gain=0.3).controller
    truth = lbt.Truth(turbulence=SWELL, vibrations=LINES, noise_nm=NOISE_NM)
    run = lbt.simulate(ran, truth, hardware=path, frames=frames, seed=seed, settle_frames=0)
    loop = {"frame_rate_hz": RATE, "delay_frames": 2, "unit": "nm"}
    return lbt.identification.loop_record(run.measurements[0], run.commands[0], **loop), ran


def show(name: str, plant: TipTiltPlant, designs: dict[str, lbt.Design]) -> None:
    """Print the table of a model, and the difference of two residuals on the same frames."""
    record, ran = night(model().hardware, 2)
    table = prediction_against_data(record, plant, designs, running=ran, imaging=CAMERA)
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
        record, _ = night(path, 1000 + seed, 12_000)
        residual = prediction_against_data(record, plant, {"Kalman": design})["Kalman"].replayed
        deviations.append((residual.total_nm2 - budget.rms_nm**2) / residual.total_error_nm2)
    print(
        f"{nights} nights of 12,000 frames: deviations have a mean of {np.mean(deviations):+.2f} "
        f"and a scatter of {np.std(deviations):.2f} standard errors, the largest "
        f"{np.max(np.abs(deviations)):.1f}"
    )


def times() -> None:
    """Print how long a table of four controllers on 30,000 frames takes."""
    plant = model()
    path = plant.hardware
    record, _ = night(path, 2, 30_000)
    four = {str(gain): lbt.integrator(path, gain=gain).controller for gain in (0.1, 0.2, 0.3, 0.5)}
    table = seconds(lambda: prediction_against_data(record, plant, four, imaging=CAMERA), 5)
    search = seconds(lambda: lbt.integrator(plant.hardware, truth=plant), 5)
    print(f"the table {1e3 * table:.0f} ms, of which the best integrator {1e3 * search:.0f} ms")


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
