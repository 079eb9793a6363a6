"""Prediction against data: run with ``python benchmarks/prediction.py`` from the repository."""

import time

import numpy as np

import lbt_synth as lbt
from lbt_synth.models.plant.tip_tilt import retuned_plant

RATE, GAIN, FRAMES = 800, 0.6, 48_000
CAMERA = lbt.Imaging(diameter_m=8.22)
LINE = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=300, direction=(1, 0))
SIDE = lbt.Vibration(frequency_hz=33, damping=0.02, rms_nm=100, direction=(0, 1))
SWELL = lbt.models.ar2_turbulence(
    lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22),
    frame_rate_hz=RATE,
    noise_nm=15.5,
)


def plant(lines=(LINE, SIDE), sensor_gain: float = GAIN, **more) -> lbt.models.TipTiltPlant:
    return lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=SWELL,
        vibrations=lines,
        noise_nm=15.5,
        sensor_gain=sensor_gain,
        **more,
    )


def night(path: lbt.LoopHardware, seed: int, frames: int = FRAMES):
    """Measurements and commands of an integrator's loop, and its controller."""
    ran = lbt.integrator(path, gain=0.3).controller
    truth = lbt.Truth(turbulence=SWELL, vibrations=(LINE, SIDE), noise_nm=15.5)
    run = lbt.simulate(ran, truth, hardware=path, frames=frames, seed=seed, settle_frames=0)
    return run.measurements[0], run.commands[0], ran


def open_loop(y, u, path: lbt.LoopHardware):
    z = y @ np.linalg.inv(path.sensor).T
    for i, tap in enumerate(path.mirror_taps):
        z[1 + i :] += tap * u[: len(u) - 1 - i]
    return z


def identity() -> None:
    shell = lbt.models.PositionLoop.from_bandwidth(
        natural_frequency_hz=20, damping=0.5, bandwidth_hz=300
    )
    truth = lbt.Truth(turbulence=SWELL, vibrations=(LINE, SIDE), noise_nm=15.5)
    for name, more in (
        ("delay 2", {}),
        ("delay 2.4", {"delay_frames": 2.4}),
        ("moving mirror", {"mirror": shell}),
    ):
        model = plant(**more)
        path, design = model.hardware, lbt.lqg(model)
        y, u, _ = night(path, 1, 5000)
        z = open_loop(y, u, path)
        found = lbt.identification.replayed_residual(
            z, design.controller, path, noise_nm=15.5, test=[(2500, 5000)]
        )
        would = lbt.simulate(
            design.controller.start(), truth, hardware=path, frames=5000, seed=1, settle_frames=0
        )
        missed = found.measured_nm - would.measurements[0, 2500:] / GAIN
        print(f"identity, {name}: {np.max(np.abs(missed)) / np.max(np.abs(found.measured_nm)):.1e}")


def show(table: lbt.identification.PredictionTable) -> None:
    for row in table.entries:
        tip, tilt = row.model_axis_nm
        if row.replayed is not None:
            tip, tilt = np.sqrt(row.replayed.variance_nm2)
        print(
            f"| {row.name} | {tip:.1f}, {tilt:.1f} | {row.replayed_nm:.1f} +- "
            f"{row.replayed_error_nm:.1f} | {row.model_nm:.1f} | {row.ratio:.3f} | "
            f"{row.deviations:+.1f} | {100 * row.strehl:.1f} | {100 * row.model_strehl:.1f} |"
        )
    print(f"fit {table.fit}, test {table.test}")


def tables() -> None:
    model = plant()
    y, u, ran = night(model.hardware, 2)
    z = open_loop(y, u, model.hardware)
    print("a model that is right")
    designs = {
        "Kalman": lbt.kalman(model),
        "H-infinity, 1.2 gamma_min": lbt.hinf(model, gamma_ratio=1.2, route="riccati"),
    }
    known = {"measurements": y[2:], "running": ran, "imaging": CAMERA}
    table = lbt.identification.prediction_against_data(model, z[2:], designs, **known)
    show(table)
    gained, error = table["what ran"].replayed.above(table["Kalman"].replayed)
    print(f"what ran less Kalman: {gained:.0f} +- {error:.0f} nm^2")
    more, error = table["least-squares predictor"].replayed.above(table["Kalman"].replayed)
    apart = np.hypot(
        table["least-squares predictor"].replayed.total_error_nm2,
        table["Kalman"].replayed.total_error_nm2,
    )
    print(f"predictor less Kalman: {more:.0f} +- {error:.0f} nm^2, unpaired +- {apart:.0f}")

    print("lines 3 Hz too high in the model")
    wrong = retuned_plant(model, 3.0)
    show(
        lbt.identification.prediction_against_data(
            wrong, z[2:], {"Kalman": lbt.kalman(wrong)}, **known
        )
    )

    print("sensor gain believed 20 % too large")
    off = plant(sensor_gain=1.2 * GAIN)
    bent = open_loop(y, u, off.hardware)
    show(
        lbt.identification.prediction_against_data(
            off, bent[2:], {"Kalman": lbt.kalman(off)}, **known
        )
    )


def predictors() -> None:
    model = plant()
    y, u, _ = night(model.hardware, 2)
    z, limit = open_loop(y, u, model.hardware)[2:], lbt.kalman(model).rms
    for taps in (2, 4, 8, 16, 32, 64, 128):
        start = time.perf_counter()
        controller, _ = lbt.identification.least_squares_predictor(
            z, model.hardware, taps=taps, stretches=[(0, len(z) // 2)]
        )
        took = time.perf_counter() - start
        loop = lbt.close_loop(model.hardware, controller)
        found = lbt.identification.replayed_residual(
            z, controller, model.hardware, noise_nm=15.5, test=[(len(z) // 2, len(z))]
        )
        print(
            f"{taps} taps: {found.rms_nm:.2f} +- {found.rms_error_nm:.2f} nm on the data, "
            f"{lbt.residual_budget(loop, model, frame_means=True).rms_nm:.2f} nm by the model, "
            f"limit {limit:.2f} nm; "
            f"{1e3 * took:.0f} ms"
        )


def errors(nights: int = 200) -> None:
    model = plant()
    path, design = model.hardware, lbt.kalman(model)
    exact = (
        lbt.residual_budget(lbt.close_loop(path, design.controller), model, frame_means=True).rms_nm
        ** 2
    )
    seen = []
    for seed in range(nights):
        y, u, _ = night(path, 1000 + seed, 6000)
        found = lbt.identification.replayed_residual(
            open_loop(y, u, path)[2:], design.controller, path, noise_nm=15.5
        )
        seen.append(((found.total_nm2 - exact) / found.total_error_nm2, found.total_error_nm2))
    z = np.array(seen)[:, 0]
    print(
        f"{nights} nights of 6000 frames: deviations have a mean of {z.mean():+.2f} and a scatter "
        f"of {z.std():.2f} standard errors, the largest {np.abs(z).max():.1f}"
    )


def times() -> None:
    model = plant()
    y, u, _ = night(model.hardware, 2, 30_002)
    z = open_loop(y, u, model.hardware)[2:]
    four = [lbt.integrator(model.hardware, gain=gain).controller for gain in (0.2, 0.5)]
    four += [lbt.kalman(model).controller]
    four += [lbt.hinf(model, gamma_ratio=1.2, route="riccati").controller]

    def best(call) -> float:
        spent = []
        for _ in range(5):
            start = time.perf_counter()
            call()
            spent.append(time.perf_counter() - start)
        return 1e3 * min(spent)

    replay = best(
        lambda: [
            lbt.identification.replayed_residual(z, one, model.hardware, noise_nm=15.5)
            for one in four
        ]
    )
    named = dict(zip("abcd", four, strict=True))
    table = best(
        lambda: lbt.identification.prediction_against_data(model, z, named, imaging=CAMERA)
    )
    integrator = best(lambda: lbt.design.model_integrator(model))
    print(
        f"30 000 frames, 2 axes: four replays {replay:.0f} ms, the whole table {table:.0f} ms, of "
        f"which the best integrator {integrator:.0f} ms"
    )


if __name__ == "__main__":
    identity()
    tables()
    predictors()
    errors()
    times()
