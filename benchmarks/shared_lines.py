"""Lines along diagonals, and what only looks like them: what is found, how well, what it is worth.

    python benchmarks/shared_lines.py [--records 100] [--jobs 2] [--seconds 60]
    python benchmarks/shared_lines.py --errors    only how honest the standard errors are

Two axes at 1 kHz with a delay of 2 frames, integrator, sensor gain, noise, turbulence and lines as
in benchmarks/identification.py (odd records: frozen flow). Four sets:

- diagonal: one to three lines of any direction;
- independent: up to three lines on either axis;
- twins: one line on either axis, independent, with the same damping and with frequencies that
  differ by at most a half width;
- air: turbulence of 50 to 95 % of the variance along a direction between 20 and 70 degrees, one
  line on either axis.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from unittest import mock

import numpy as np
from harness import (
    frozen_flow,
    log_uniform,
    random_line,
    record_options,
    run_all,
    run_integrator,
    second_order,
)
from identification import coverage

import lbt_synth as lbt
from lbt_synth.identification.fit import identify

RATE = 1000.0
SETS = ("diagonal", "independent", "twins", "air")
TIP, TILT = (1.0, 0.0), (0.0, 1.0)


def along(degrees: float) -> tuple[float, float]:
    """Return a direction over the axes."""
    return float(np.cos(np.radians(degrees))), float(np.sin(np.radians(degrees)))


def vibrations(kind: str, rng: np.random.Generator, air: lbt.Vibration) -> list[lbt.Vibration]:
    """Draw the vibrations of a set."""
    if kind == "diagonal":
        return [random_line(rng, along(rng.uniform(-90, 90))) for _ in range(rng.integers(1, 4))]
    if kind == "independent":
        return [random_line(rng, on) for on in (TIP, TILT) for _ in range(rng.integers(0, 4))]
    if kind == "twins":
        first = random_line(rng, TIP)
        apart = rng.uniform(-1, 1) * first.damping * first.frequency_hz
        size = float(rng.uniform(5, 100))
        moved = first.frequency_hz + float(apart)
        return [first, replace(first, frequency_hz=moved, rms_nm=size, direction=TILT)]
    return [air, random_line(rng, TIP), random_line(rng, TILT)]


def draw_truth(kind: str, seed: int) -> tuple[lbt.Truth, float]:
    """Draw a truth, and the gain of the integrator."""
    rng = np.random.default_rng([seed, 7, SETS.index(kind)])
    noise = log_uniform(rng, 2, 30)
    sensor_gain, gain = float(rng.uniform(0.4, 1.0)), float(rng.uniform(0.2, 0.6))
    corner = log_uniform(rng, 0.2, 3)
    damping, rms = float(rng.uniform(0.1, 0.95)), float(rng.uniform(200, 800))
    part = float(rng.uniform(0.5, 0.95)) if kind == "air" else 0.0
    common = lbt.Vibration(
        frequency_hz=corner,
        damping=damping,
        rms_nm=rms * np.sqrt(max(part, 0.01)),
        direction=along(rng.uniform(20, 70) * rng.choice([-1, 1])),
    )
    turbulence: lbt.models.Spectrum = second_order(corner, damping, rms * np.sqrt(1 - part), RATE)
    if seed % 2 and kind != "air":
        turbulence = frozen_flow(rng)
    truth = lbt.Truth(
        turbulence=turbulence,
        vibrations=tuple(vibrations(kind, rng, common)),
        noise_nm=noise,
        sensor_gain=sensor_gain,
    )
    return truth, gain


def exact_plant(truth: lbt.Truth) -> lbt.models.TipTiltPlant:
    """Return the plant of the truth; frozen flow as the AR2 process fitted to its spectrum."""
    turbulence = truth.turbulence
    if isinstance(turbulence, lbt.Atmosphere):
        turbulence = lbt.models.ar2_turbulence(
            turbulence, frame_rate_hz=RATE, noise_nm=truth.noise_nm / truth.sensor_gain
        )
    assert isinstance(turbulence, lbt.models.ARModel)
    return lbt.tip_tilt_plant(
        frame_rate_hz=RATE,
        turbulence=turbulence,
        vibrations=truth.vibrations,
        noise_nm=truth.noise_nm,
        sensor_gain=truth.sensor_gain,
    )


def left(truth: lbt.Truth, plant: lbt.models.TipTiltPlant) -> float:
    """Variance that the Kalman filter of a plant leaves of a truth [nm^2]."""
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    loop = lbt.close_loop(path, lbt.kalman(plant).controller, sensor_gain=truth.sensor_gain)
    return (
        lbt.residual_budget(loop, truth, frame_means=True).rms_nm ** 2
        if loop.is_stable
        else float("inf")
    )


def clear(truth: lbt.Truth, line: lbt.Vibration) -> bool:
    """Whether a line stands twice above all the rest, on its own direction."""
    f = np.array([line.frequency_hz])
    rest = 2 / RATE * (float(np.max(truth.noise_nm)) / truth.sensor_gain) ** 2
    rest += float(truth.turbulence.psd(f)[0])
    for other in truth.vibrations:
        if other is not line:
            seen = float(np.dot(other.direction, line.direction)) ** 2
            rest += seen * float(other.ar_model(RATE).psd(f)[0])
    return float(line.ar_model(RATE).psd(f)[0]) > rest


def judged(
    truth: lbt.Truth, model: lbt.identification.IdentifiedModel, kind: str
) -> tuple[list[dict], int]:
    """Match shared lines with those there are; return their facts, and the number of false ones.

    The second of two lines that were found for one is not false.
    """
    spare, out = list(model.shared), []
    real = [line for line in truth.vibrations if min(np.abs(line.direction)) > 0]
    for line in real:
        angle = angle_deg(line)
        reach = line.frequency_hz if kind == "air" else reach_hz(line)
        near = [x for x in spare if abs(x.frequency_hz - line.frequency_hz) < reach]
        fact = {"angle": angle, "clear": clear(truth, line), "found": bool(near)}
        if near:
            got = min(near, key=lambda x: abs(x.frequency_hz - line.frequency_hz))
            spare.remove(got)
            turned = np.degrees(np.arctan2(got.direction[1], got.direction[0])) - angle
            turned = (turned + 90) % 180 - 90
            error = got.direction_error_deg
            fact |= {
                "direction": np.nan if error is None else turned / error,
                "turned": turned,
                "frequency": (got.frequency_hz - line.frequency_hz) / got.frequency_error_hz,
                "rms": (got.rms_nm - line.rms_nm) / got.rms_error_nm,
            }
        out.append(fact)
    near = [[abs(x.frequency_hz / line.frequency_hz - 1) < 0.03 for line in real] for x in spare]
    return out, sum(not any(each) for each in near)


def run_loop(kind: str, seed: int, frames: int) -> tuple[lbt.Truth, lbt.identification.LoopRecord]:
    """Return a truth, and the record of a loop that it shook."""
    truth, gain = draw_truth(kind, seed)
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    record, _ = run_integrator(path, truth, gain, frames, seed=seed, settle_frames=2000)
    return truth, record


def only_errors(kind: str, seed: int, frames: int) -> dict:
    """Return how far the estimates of a record are from the truth, in their standard errors."""
    truth, record = run_loop(kind, seed, frames)
    model = lbt.identify(record)
    noise = float(np.max(truth.noise_nm))
    gains = {(axis.sensor_gain, axis.sensor_gain_error) for axis in model.axes}
    errors = {
        "sensor gain": [(g - truth.sensor_gain) / error for g, error in gains if error is not None],
        "noise": [(axis.noise_nm - noise) / axis.noise_error_nm for axis in model.axes],
    }
    for name, diagonal in (("line of an axis", False), ("shared line", True)):
        lines = [v for v in truth.vibrations if (min(np.abs(v.direction)) > 0) == diagonal]
        pairs = pair_lines(lines, [part for part in model.parts if part.kind == "line"])
        errors |= {
            f"{name}, frequency": [
                (x.frequency_hz - v.frequency_hz) / x.frequency_error_hz for v, x in pairs
            ],
            f"{name}, rms": [(x.rms_nm - v.rms_nm) / x.rms_error_nm for v, x in pairs],
            f"{name}, damping": [(x.damping - v.damping) / x.damping_error for v, x in pairs],
        }
    errors["shared line, direction"] = [
        (np.degrees(np.arctan(np.tan(np.radians(x.direction_deg - angle_deg(v))))))
        / x.direction_error_deg
        for v, x in pairs
    ]
    return {"errors": errors, "frozen": isinstance(truth.turbulence, lbt.Atmosphere)}


def angle_deg(line: lbt.Vibration) -> float:
    """Return the direction of a line [degrees]."""
    return float(np.degrees(np.arctan2(line.direction[1], line.direction[0])))


def pair_lines(lines: list[lbt.Vibration], found: list) -> list[tuple]:
    """Return the lines, the strongest first, with the nearest found along as many axes."""
    spare, out = list(found), []
    for line in sorted(lines, key=lambda v: -v.rms_nm):
        shared = min(np.abs(line.direction)) > 0
        near = [
            x
            for x in spare
            if (x.direction_error_deg is not None) == shared
            and (shared or np.allclose(x.direction, line.direction))
            and abs(x.frequency_hz - line.frequency_hz) < reach_hz(line)
        ]
        if near:
            out.append((line, min(near, key=lambda x: abs(x.frequency_hz - line.frequency_hz))))
            spare.remove(out[-1][1])
    return out


def reach_hz(line: lbt.Vibration) -> float:
    """Return how far from a line its estimate from a minute may lie [Hz]."""
    return max(0.1, 5 * float(np.sqrt(line.frequency_hz * line.damping / (2 * np.pi * 60))))


def studied(kind: str, seed: int, frames: int) -> dict:
    """Everything that is measured of one record."""
    truth, record = run_loop(kind, seed, frames)
    couple, alone = identify.couple_axes, {}

    def watched(record, axes, *rest):
        begin = time.process_time()
        out = couple(record, axes, *rest)
        alone.update(axes=tuple(axes), seconds=time.process_time() - begin)
        return out

    with mock.patch.object(identify, "couple_axes", watched):
        model = lbt.identify(record)
    separate = replace(model, axes=alone["axes"], shared=())
    facts, false = judged(truth, model, kind)
    plants = [exact_plant(truth), separate.plant(), model.plant()]
    variances = [left(truth, plant) for plant in plants]
    return {
        "seed": seed,
        "lines": facts,
        "false": false,
        "variances": variances,
        "states": [plant.n_states for plant in plants],
        "seconds": alone["seconds"],
        "shared": bool(model.shared),
    }


def table(kind: str, results: list[dict]) -> None:
    """Print what was found in one set."""
    lines = [line for r in results for line in r["lines"]]
    print(f"{kind}: {len(results)} records")
    if lines:
        seen = [line for line in lines if line["clear"]]
        for name, group in (("all", lines), ("clear", seen)):
            found = np.mean([line["found"] for line in group]) if group else np.nan
            print(f"  shared lines, {name:6s} {len(group):4d}, found as one {100 * found:.1f} %")
        found = [line for line in lines if line["found"]]
        for key in ("direction", "frequency", "rms"):
            values = np.array([line[key] for line in found])
            values = values[np.isfinite(values)]
            if not values.size:
                continue
            inside = [100 * np.mean(np.abs(values) < k) for k in (1, 2)]
            print(
                f"  {key:10s} rms {np.sqrt(np.mean(values**2)):.2f} standard errors, "
                f"within one {inside[0]:.0f} %, within two {inside[1]:.0f} %"
            )
        turned = np.abs([line["turned"] for line in found])
        if turned.size:
            print(
                f"  direction: median error {np.median(turned):.2f} deg, largest {turned.max():.1f}"
            )
    false = sum(r["false"] for r in results)
    print(f"  false couplings {false}")
    variance = np.array([r["variances"] for r in results])
    stable = np.all(np.isfinite(variance), axis=1)
    if not stable.all():
        print(
            f"  unstable on the true loop: {np.sum(~stable)} (of which alone, too: "
            f"{np.sum(np.isinf(variance[:, 1]))})"
        )
    variance = variance[stable]
    coupled = np.array([r["shared"] for r in results])[stable]
    for name, i, j in (
        ("together / alone", 2, 1),
        ("alone / truth", 1, 0),
        ("together / truth", 2, 0),
    ):
        ratio = variance[:, i] / variance[:, j]
        ratio = ratio[coupled] if coupled.any() else ratio
        print(
            f"  residual variance, {name:16s} median {np.median(ratio):.4f}, 5 % "
            f"{np.percentile(ratio, 5):.4f}, 95 % {np.percentile(ratio, 95):.4f}, largest "
            f"{ratio.max():.4f}"
        )
    states = np.mean([r["states"] for r in results], axis=0)
    print("  states, truth {:.1f}, alone {:.1f}, together {:.1f}".format(*states))
    seconds = np.array([r["seconds"] for r in results])
    print(f"  processor time median {np.median(seconds):.3f} s, largest {seconds.max():.3f} s")


def main() -> None:
    """Run the study."""
    asked = record_options(__doc__, records=100, jobs=2, seconds=60.0, sets=SETS, errors=False)
    for kind in asked.sets:
        study = only_errors if asked.errors else studied
        results = run_all(partial(study, kind, frames=int(asked.seconds * RATE)), asked)
        if not asked.errors:
            table(kind, results)
            continue
        for frozen in (False, True):
            some = [r for r in results if r["frozen"] == frozen]
            print(f"{kind}, {'frozen flow' if frozen else 'second order'}: {len(some)} records")
            coverage(some)


if __name__ == "__main__":
    main()
