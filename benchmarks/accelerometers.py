"""Accelerometers beside the wavefront: channels found, motions, phases and clocks.

    python benchmarks/accelerometers.py [--records 100] [--jobs 2] [--seconds 60]

Two axes at 1 kHz with a delay of 2 frames and an integrator of gain 0.2 to 0.5; turbulence of 200
to 600 nm, 0.3 to 2 Hz, damping 0.3 to 1; noise 5 to 30 nm a frame. Three lines of 10 to 100 nm, 8
to 120 Hz and at least 3 Hz apart, of damping 0.002 to 0.02 (in its logarithm) and any direction.
Four channels: two useful ones, each moving with two or three lines by 0.3 to 3 nm per nm, with or
against the wavefront, in noise of a tenth to once the acceleration; a dead one with the rounding of
its last digit; an unrelated one with noise and three lines of its own. Their clock is up to 20
frames late.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from harness import log_uniform, record_options, run_all, second_order
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.config.write import config_text, identified_config
from lbt_synth.identification.accelerometers.transfers import accelerometer_transfers
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.loop.disturbances import run_oscillator
from lbt_synth.models.plant.seen_vibration import seen_vibration

RATE = 1000.0
MARGIN = 100  # frames before and after the record


@dataclass
class Case:
    """A record with accelerations, and what made them."""

    record: lbt.identification.LoopRecord
    accelerations: np.ndarray  # (frames, 4): two useful channels, a dead and an unrelated one
    truth: lbt.Truth
    motions: np.ndarray  # (2, lines), 0 where a channel does not move with a line
    late: int  # frames by which the readings come later than the wavefront
    noise_m_s2: np.ndarray  # (2,): of the useful channels


def random_lines(rng: np.random.Generator) -> list[lbt.Vibration]:
    """Draw three lines of any direction that lie apart."""
    frequencies = np.zeros(3)
    while np.min(np.diff(np.sort(frequencies))) < 3:
        frequencies = np.exp(rng.uniform(np.log(8), np.log(120), 3))
    out = []
    for frequency in frequencies:
        angle = rng.uniform(-np.pi / 2, np.pi / 2)
        out.append(
            lbt.Vibration(
                frequency_hz=float(frequency),
                damping=log_uniform(rng, 0.002, 0.02),
                rms_nm=float(rng.uniform(10, 100)),
                direction=(float(np.cos(angle)), float(np.sin(angle))),
            )
        )
    return out


def series(
    line: lbt.Vibration, frames: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw mean positions [nm] and mean accelerations [m/s^2] of a line in frames."""
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    mirror = lbt.models.Accelerometer(
        name="mirror", rate_hz=RATE, delay_frames=1, channels=("m1",), noise_m_s2=1.0
    )
    seen = seen_vibration(line, {"m1": lbt.models.Motion(size=1)}, (mirror,), path)
    drive = rng.standard_normal((1, 1 + frames, seen.B.shape[-1]))
    positions, accelerations = run_oscillator(seen, line, drive)[0].T
    return positions, accelerations


def case(seed: int, frames: int) -> Case:
    """Draw a loop with accelerometers, and run it."""
    rng = np.random.default_rng([seed, 22])
    lines = random_lines(rng)
    corner, damping = log_uniform(rng, 0.3, 2), float(rng.uniform(0.3, 1))
    rms, noise = float(rng.uniform(200, 600)), float(rng.uniform(5, 30))
    turbulence = second_order(corner, damping, rms, RATE)
    drawn = [series(line, frames + 2 * MARGIN, rng) for line in lines]
    positions, accelerations = np.array(drawn).transpose(1, 0, 2)
    total = np.array([line.direction for line in lines]).T @ positions[:, MARGIN:-MARGIN]
    slow = lfilter(
        [1],
        np.append(1, -turbulence.coefficients),
        turbulence.driving_rms_nm * rng.standard_normal((2, frames + 20_000)),
    )[:, -frames:]
    late = int(rng.integers(0, 21))
    motions = rng.uniform(0.3, 3, (2, 3)) * rng.choice([-1, 1], (2, 3))
    motions[np.arange(2), rng.integers(0, 3, 2)] *= rng.integers(0, 2, 2)
    unrelated = sum(series(line, frames + 2 * MARGIN, rng)[1] for line in random_lines(rng))
    start = MARGIN - 1 - late  # the wavefront's reading of a frame is of the frame before
    readings = np.vstack([motions @ accelerations, unrelated])[:, start : start + frames]
    size = readings.std(axis=1, keepdims=True)
    size = size * rng.uniform(0.1, 1, (3, 1))
    readings = readings + size * rng.standard_normal(readings.shape)
    dead = 2e-5 * rng.integers(0, 2, frames)
    gain = float(rng.uniform(0.2, 0.5))
    y, u = closed_loop(total + slow, noise, gain, rng)
    record = lbt.identification.loop_record(y, u, frame_rate_hz=RATE, delay_frames=2, unit="nm")
    columns = np.column_stack([readings[0], readings[1], dead, readings[2]])
    truth = lbt.Truth(turbulence=turbulence, vibrations=tuple(lines), noise_nm=noise)
    return Case(record, columns, truth, motions, late, size[:2, 0])


def closed_loop(
    phase: np.ndarray, noise: float, gain: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Run an integrator on a phase (axes, frames): y(k) = phase(k-1) - u(k-2) + noise."""
    drive = np.pad(phase, ((0, 0), (1, 0)))[:, :-1] + noise * rng.standard_normal(phase.shape)
    # u(k) = u(k-1) + g y(k), y(k) = drive(k) - u(k-2)
    u = lfilter([gain], [1, -1, gain], drive)
    y = drive - np.pad(u, ((0, 0), (2, 0)))[:, :-2]
    return y.T, u.T


def examine(seed: int, frames: int) -> dict[str, list[float]]:
    """Identify one record and compare with the truth."""
    it = case(seed, frames)
    model = lbt.identify(it.record)
    found = accelerometer_transfers(model, it.record, it.accelerations)
    names = [row.channel for row in found.channels]
    used = {row.channel for row in found.used}
    out: dict[str, list[float]] = {
        "useful channels found": [float(name in used) for name in names[:2]],
        "dead or unrelated channels used": [float(name in used) for name in names[2:]],
        "lines found": [],
        "motion": [],
        "phase": [],
        "false": [],
        "error": [],
    }
    turn = it.late - (found.age_frames - 1)
    for row in found.transfers:
        c = names.index(row.channel)
        if c > 1:
            continue
        j = int(np.argmin([abs(v.frequency_hz - row.frequency_hz) for v in it.truth.vibrations]))
        line = it.truth.vibrations[j]
        if abs(line.frequency_hz - row.frequency_hz) > 0.5:
            continue
        # a line may be on either axis or have the other sign
        part = model.parts[row.line]
        along = float(np.dot(part.direction or (1.0, 0.0), line.direction))
        factor = it.motions[c, j] / along if part.direction else it.motions[c, j]
        if not it.motions[c, j]:
            out["false"].append(float(row.useful))
            continue
        out["lines found"].append(float(row.useful))
        if not row.useful:
            continue
        phase = np.angle(factor * np.exp(-2j * np.pi * line.frequency_hz / RATE * turn), deg=True)
        off = (row.phase_deg - phase + 180) % 360 - 180
        out["motion"].append((row.motion_nm_per_nm - abs(factor)) / row.motion_error_nm_per_nm)
        out["phase"].append(off / row.phase_error_deg)
        out["error"].append(abs(row.motion_nm_per_nm / abs(factor) - 1))
    out["shift"] = [(found.shift_frames - it.late)]
    out["shift errors"] = [x / found.shift_error_frames for x in out["shift"]]
    return out


def loss(seed: int, frames: int) -> float:
    """Return what an identified filter of all sensors leaves in the truth, over the true one."""
    it = case(seed, frames)
    model = lbt.identify(it.record)
    found = accelerometer_transfers(model, it.record, it.accelerations)
    settings, comments = identified_config(model, accelerometers=found)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.yaml"
        path.write_text(config_text(settings, comments), encoding="utf-8")
        config = lbt.load_config(path)
    best = true_plant(it, *(row.channel for row in found.channels[:2]))
    read = true_plant(it, *config.hardware.suite.channels)
    least_nm, rms_nm = residual_nm(it, best, best), residual_nm(it, config.plant, read)
    return (rms_nm / least_nm) ** 2 - 1


def residual_nm(it: Case, plant: lbt.models.TipTiltPlant, real: lbt.models.TipTiltPlant) -> float:
    """Return what the Kalman filter of a plant leaves in the loop of the truth."""
    controller = plant.controller(kalman_riccati(plant).gain_predictor)
    loop = lbt.close_loop(real.hardware, controller)
    return lbt.residual_budget(
        loop, replace(it.truth, motions=real.motions), frame_means=True
    ).rms_nm


def true_plant(it: Case, *channels: str) -> lbt.models.TipTiltPlant:
    """Return the plant of a record as it was drawn, with some of its useful channels."""
    own = lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=it.truth.turbulence,
        vibrations=it.truth.vibrations,
        noise_nm=it.truth.noise_nm,
    )
    if not channels:
        return own
    places = [int(name.removeprefix("channel")) - 1 for name in channels]
    instrument = lbt.models.Accelerometer(
        name="accelerometer",
        rate_hz=RATE,
        delay_frames=it.late + 2,
        channels=channels,
        noise_m_s2=it.noise_m_s2[places],
    )
    moving = [
        {
            name: lbt.models.Motion(size=abs(factor), phase_deg=180.0 if factor < 0 else 0.0)
            for name, factor in zip(channels, it.motions[places, j], strict=True)
            if factor
        }
        for j in range(len(it.truth.vibrations))
    ]
    return own.with_sensors(lbt.models.SensorSuite(sensors=(instrument,)), tuple(moving))


def main() -> None:
    """Print the table."""
    given = record_options(__doc__, records=100, jobs=2, seconds=60.0, designs=False)
    frames = int(given.seconds * RATE)
    if given.designs:
        lost = np.array(run_all(partial(loss, frames=frames), given))
        print(f"| variance above that of the filter from the truth, {len(lost)} records | |")
        print("|---|---:|")
        for name, value in (("median", np.median(lost)), ("largest", lost.max())):
            print(f"| {name} | {100 * value:.2f} % |")
        print(f"| within 5 % | {np.sum(lost < 0.05)} |")
        return
    results = run_all(partial(examine, frames=frames), given)
    every = {name: [x for each in results for x in each[name]] for name in results[0]}

    def share(name: str) -> str:
        return f"{100 * np.mean(every[name]):.1f} % of {len(every[name])}" if every[name] else "-"

    def within(name: str) -> str:
        size = np.abs(every[name])
        return f"{100 * np.mean(size < 1):.0f}, {100 * np.mean(size < 1.96):.0f} %"

    for name in ("useful channels found", "lines found"):
        print(f"| {name} | {share(name)} |")
    for name in ("dead or unrelated channels used", "false"):
        print(f"| {name} | {int(np.sum(every[name]))} of {len(every[name])} |")
    for name in ("motion", "phase", "shift errors"):
        print(f"| {name}, within 1 and 1.96 standard errors | {within(name)} |")
    print(f"| motion, relative error, median | {100 * np.median(every['error']):.2g} % |")
    off = np.abs(every["shift"])
    print(f"| shift, error, median and largest [frames] | {np.median(off):.2g}, {off.max():.2g} |")


if __name__ == "__main__":
    main()
