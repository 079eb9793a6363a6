"""Identification of random closed loops: lines found, filters designed, gains, times.

    python benchmarks/identification.py [--records 200] [--jobs 2] [--seconds 60]
    python benchmarks/identification.py --errors    only how honest the standard errors are
    python benchmarks/identification.py --errors --colour 0.3 ...    with first-order noise
    python benchmarks/identification.py --errors --close ...         with pairs of close lines
    python benchmarks/identification.py --errors --wide 2 ...        with two wide resonances

One axis at 1 kHz with a delay of 2 frames, an integrator of gain 0.2 to 0.6, sensor gain 0.4 to
1, noise 2 to 30 nm a frame (evenly in its logarithm). Even records: second-order turbulence of
200 to 800 nm, 0.2 to 3 Hz (in its logarithm) and damping 0.1 to 1. Odd records: frozen flow over
8.22 m, seeing 0.5 to 1.5 arcsec, outer scale 15 to 40 m, wind 5 to 25 m/s, which no process of
finite order has. 0 to 5 resonances of 5 to 100 nm rms, 5 to 150 Hz, damping 0.002 to 0.01 (in its
logarithm).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from harness import (
    frozen_flow,
    least_squares,
    log_uniform,
    random_line,
    record_options,
    run_all,
    run_integrator,
    second_order,
)

import lbt_synth as lbt
from lbt_synth.identification.fit.identified_model import IdentifiedAxis, IdentifiedLine
from lbt_synth.identification.records.record import split_halves

RATE = 1000.0
NEAR_HZ = 0.1


@dataclass
class Case:
    """A loop and its record."""

    frozen: bool
    drift: lbt.models.ARModel | None
    path: lbt.LoopHardware
    truth: lbt.Truth
    record: lbt.identification.LoopRecord
    total_nm: np.ndarray


def case(
    seed: int,
    frames: int,
    *,
    rate: float = RATE,
    drift: lbt.models.ARModel | None = None,
    colour: float = 0.0,
    close: bool = False,
    wide: int = 0,
) -> Case:
    """Draw a loop, perhaps with a drift on top of its turbulence, and run it.

    ``colour`` is the correlation of the noise of neighbouring frames; ``close`` puts a second line
    within 4 half widths of each, and ``wide`` is how many resonances have a damping of 0.05 to 0.2.
    """
    rng = np.random.default_rng([seed, 1])
    path = lbt.LoopHardware(frame_rate_hz=rate, delay_frames=2, modes=1)
    noise = log_uniform(rng, 2, 30)
    sensor_gain = float(rng.uniform(0.4, 1.0))
    frozen = bool(seed % 2)
    turbulence: lbt.models.Spectrum
    if frozen:
        turbulence = frozen_flow(rng)
    else:
        corner = log_uniform(rng, 0.2, 3)
        damping, rms = float(rng.uniform(0.1, 1.0)), float(rng.uniform(200, 800))
        turbulence = second_order(corner, damping, rms, rate)
    lines = tuple(random_line(rng, (1.0,)) for _ in range(int(rng.integers(0, 6))))
    if close:
        lines += tuple(
            replace(
                line,
                frequency_hz=line.frequency_hz * (1 + rng.uniform(1, 4) * line.damping),
                rms_nm=line.rms_nm * rng.uniform(0.3, 1),
            )
            for line in lines
        )
    lines += tuple(random_line(rng, (1.0,), damping=(0.05, 0.2)) for _ in range(wide))
    total = turbulence if drift is None else lbt.models.SumSpectrum(parts=[turbulence, drift])
    truth = lbt.Truth(turbulence=total, vibrations=lines, noise_nm=noise, sensor_gain=sensor_gain)
    gain = float(rng.uniform(0.2, 0.6))
    seen = truth
    if colour:  # to the loop, noise is a part of the phase that it cannot remove
        own = lbt.models.ARModel(
            coefficients=[colour],
            driving_rms_nm=noise / sensor_gain * np.sqrt(1 - colour**2),
            frame_rate_hz=rate,
        )
        whole = lbt.models.SumSpectrum(parts=[total, own])
        seen = replace(truth, turbulence=whole, noise_nm=1e-3 * noise)
    record, run = run_integrator(
        path,
        seen,
        gain,
        frames,
        seed=seed,
        settle_frames=2000,
        frame_means=bool(colour),  # noise is a process of means over frames
    )
    return Case(frozen, drift, path, truth, record, run.total_nm[0])


def exact_plant(it: Case) -> lbt.models.TipTiltPlant:
    """Return the plant of the truth; frozen flow as the AR2 process fitted to its spectrum."""
    truth, turbulence, rate = it.truth, it.truth.turbulence, it.path.frame_rate_hz
    lines = list(truth.vibrations)
    if isinstance(turbulence, lbt.models.SumSpectrum):
        turbulence = turbulence.parts[0]
    if isinstance(turbulence, lbt.Atmosphere):
        turbulence = lbt.models.ar2_turbulence(
            turbulence, frame_rate_hz=rate, noise_nm=truth.noise_nm / truth.sensor_gain
        )
    assert isinstance(turbulence, lbt.models.ARModel)
    if it.drift is not None:
        # the drift takes the place of the turbulence, which becomes a resonance
        pole = np.log(complex(max(np.linalg.eigvals(turbulence.companion), key=np.imag)))
        lines.append(
            lbt.Vibration(
                frequency_hz=abs(pole) * rate / (2 * np.pi),
                damping=min(-pole.real / abs(pole), 1 - 1e-9),
                rms_nm=turbulence.rms_nm,
                direction=(1.0,),
            )
        )
        turbulence = it.drift
    return lbt.tip_tilt_plant(
        frame_rate_hz=rate,
        delay_frames=2,
        turbulence=turbulence,
        vibrations=lines,
        noise_nm=truth.noise_nm,
        sensor_gain=truth.sensor_gain,
        modes=1,
    )


def left(it: Case, controller: lbt.Controller) -> float:
    """Variance that a controller leaves of the truth [nm^2], exactly; inf if it is unstable."""
    loop = lbt.close_loop(it.path, controller, sensor_gain=it.truth.sensor_gain)
    if not loop.is_stable:
        return float("inf")
    return lbt.residual_budget(loop, it.truth, frame_means=True).rms_nm ** 2


def background(it: Case, line: lbt.Vibration) -> float:
    """Density of everything but a line, at its frequency, as the sensor sees it [nm^2/Hz]."""
    f = np.array([line.frequency_hz])
    truth = it.truth
    found = 2 / RATE * (truth.noise_nm / truth.sensor_gain) ** 2
    found += float(truth.turbulence.psd(f)[0])
    others = (other for other in truth.vibrations if other is not line)
    return found + sum(float(other.ar_model(RATE).psd(f)[0]) for other in others)


def paired(
    it: Case, axis: IdentifiedAxis
) -> tuple[list[tuple[lbt.Vibration, IdentifiedLine | None, float]], list]:
    """Pair the lines there are with those found, and how far away; then those that are spare."""
    spare, out = list(axis.lines), []
    for line in sorted(it.truth.vibrations, key=lambda v: -v.rms_nm):
        near = min(spare, key=lambda x: abs(x.frequency_hz - line.frequency_hz), default=None)
        away = np.inf if near is None else abs(near.frequency_hz - line.frequency_hz)
        if away < max(NEAR_HZ, 5 * bound(it, line)):
            spare.remove(near)
            out.append((line, near, float(away)))
        else:
            out.append((line, None, float(away)))
    return out, spare


def bound(it: Case, line: lbt.Vibration) -> float:
    """Least standard error of any estimate of a frequency from so many seconds [Hz]."""
    return float(np.sqrt(line.frequency_hz * line.damping / (2 * np.pi * it.record.duration_s)))


def judged(it: Case, axis: IdentifiedAxis) -> dict[str, list[tuple[float, ...]]]:
    """Return which lines were found, the strongest first, which missed, and which are false."""
    out: dict[str, list[tuple[float, ...]]] = {"found": [], "missed": [], "false": []}
    pairs, spare = paired(it, axis)
    for line, _, away in pairs:
        own = float(line.ar_model(RATE).psd(np.array([line.frequency_hz]))[0])
        if own > background(it, line):  # with it, twice the background
            facts = (
                line.frequency_hz,
                line.damping,
                line.rms_nm,
                own / background(it, line),
                away,
                bound(it, line),
            )
            out["found" if away < NEAR_HZ else "missed"].append(facts)
    out["false"] = [(x.frequency_hz, x.damping, x.rms_nm, x.evidence) for x in spare]
    return out


def stood_for(it: Case, axis: IdentifiedAxis) -> list[tuple[IdentifiedLine, list[lbt.Vibration]]]:
    """Return each line found, with the true lines to which it is nearest, within 4 half widths."""
    out: dict[int, list[lbt.Vibration]] = {i: [] for i in range(len(axis.lines))}
    for line in it.truth.vibrations:
        away = [abs(x.frequency_hz - line.frequency_hz) for x in axis.lines]
        if away and min(away) < NEAR_HZ + 4 * line.frequency_hz * line.damping:
            out[int(np.argmin(away))].append(line)
    return [(axis.lines[i], lines) for i, lines in out.items() if lines]


def deviations(it: Case, axis: IdentifiedAxis) -> dict[str, list[float]]:
    """Return how far estimates are from the truth, in their standard errors."""
    truth, gain_error = it.truth, axis.sensor_gain_error
    pairs = stood_for(it, axis)
    found = [(lines[0], near) for near, lines in pairs if len(lines) == 1]
    merged = [
        (near, [line.frequency_hz for line in lines], [line.rms_nm**2 for line in lines])
        for near, lines in pairs
        if len(lines) > 1
    ]
    return {
        "sensor gain": []
        if gain_error is None
        else [(axis.sensor_gain - truth.sensor_gain) / gain_error],
        "noise": [(axis.noise_nm - truth.noise_nm) / max(axis.noise_error_nm, 1e-300)],
        "line, frequency": [
            (x.frequency_hz - line.frequency_hz) / x.frequency_error_hz for line, x in found
        ],
        "line, rms": [(x.rms_nm - line.rms_nm) / x.rms_error_nm for line, x in found],
        "line, damping": [(x.damping - line.damping) / x.damping_error for line, x in found],
        "one for several, mean": [
            (x.frequency_hz - np.average(f, weights=power)) / x.frequency_error_hz
            for x, f, power in merged
        ],
        "one for several, rms": [
            (x.rms_nm - np.sum(power) ** 0.5) / x.rms_error_nm for x, _, power in merged
        ],
    }


def coverage(results: list[dict]) -> None:
    """Print how often estimates lie within 1 and 1.96 of their standard errors of the truth."""
    print("estimates within 1 and 1.96 standard errors of the truth (68 and 95 %)")
    for name in results[0]["errors"]:
        away = np.array([value for r in results for value in r["errors"][name]])
        if away.size:
            inside = [100 * np.mean(np.abs(away) < reach) for reach in (1, 1.96)]
            print(
                f"  {name:26s} {away.size:4d} {inside[0]:6.1f} % {inside[1]:6.1f} %, mean "
                f"{np.mean(away):5.2f}, deviation {np.std(away):.2f}"
            )


def only_errors(seed: int, frames: int, **options: Any) -> dict:
    """Return the deviations of one record."""
    it = case(seed, frames, **options)
    begin = time.process_time()
    model = lbt.identify(it.record)
    return {
        "seed": seed,
        "errors": deviations(it, model.axes[0]),
        "seconds": time.process_time() - begin,
        "coloured": model.axes[0].noise_correlation != 0,
        "warned": any("warning" in note for note in model.notes)
        or model.axes[0].sensor_gain_error is None,
    }


def show_errors(results: list[dict]) -> None:
    """Print the coverage, large deviations, and how many records have a warning."""
    coverage(results)
    unwarned = [r for r in results if not r["warned"]]
    if 0 < len(unwarned) < len(results):
        print(f"of the {len(unwarned)} records without a warning:")
        coverage(unwarned)
    for r in results:
        far = {name: np.round(v, 1) for name, v in r["errors"].items() if np.any(np.abs(v) > 4)}
        if far:
            print(f"  record {r['seed']}{', warned' * r['warned']}: {far}")
    print(
        f"coloured noise in {sum(r['coloured'] for r in results)}, a warning in "
        f"{sum(r['warned'] for r in results)} of {len(results)} records; median time "
        f"{np.median([r['seconds'] for r in results]):.2f} s"
    )


def studied(seed: int, frames: int) -> dict:
    """Everything that is measured of one record."""
    it = case(seed, frames)
    begin = time.process_time()
    model = lbt.identify(it.record)
    middle = time.process_time()
    filter_ = lbt.kalman(model.plant())
    end = time.process_time()
    axis = model.axes[0]
    best = left(it, lbt.kalman(exact_plant(it)).controller)
    limit = lbt.loop.least_residual(it.path, it.truth, frame_means=True).rms_nm ** 2
    first, _ = split_halves(it.record)
    halved = lbt.identify(first)
    table = lbt.identification.prediction_against_data(
        it.record, exact_plant(it), {"Kalman": lbt.kalman(halved.plant()).controller}
    )
    filtered, ((start, stop),) = table["Kalman"].replayed, table.test
    true_open = it.record.pseudo_open_loop(it.truth.sensor_gain)
    predicted = least_squares(true_open, it.path.mirror_taps, 32, table.fit)[start:stop]
    noise_nm2 = (it.truth.noise_nm / it.truth.sensor_gain) ** 2
    error = axis.sensor_gain_error
    return {
        "seed": seed,
        "frozen": it.frozen,
        **judged(it, axis),
        "errors": deviations(it, axis),
        "ratio": left(it, filter_.controller) / best,
        "limit": left(it, filter_.controller) / limit,
        "replay_ratio": filtered.total_nm2 / float(np.mean(predicted**2) - noise_nm2),
        "gain": axis.sensor_gain / it.truth.sensor_gain - 1,
        "gain_deviation": np.nan
        if error is None
        else (axis.sensor_gain - it.truth.sensor_gain) / error,
        "white": axis.whiteness.white,
        "identify_s": middle - begin,
        "design_s": end - middle,
    }


def table(results: list[dict]) -> None:
    """Print what was found."""
    found, missed, false = (
        [(r["seed"], *facts) for r in results for facts in r[key]]
        for key in ("found", "missed", "false")
    )
    total = len(found) + len(missed)
    print(f"records                                    {len(results)}")
    print(f"lines above twice their background         {total}")
    print(f"found within {NEAR_HZ:g} Hz                       {100 * len(found) / total:.1f} %")
    print(f"false lines a record                       {len(false) / len(results):.3f}")
    line, away = "record {} {:.2f} Hz, damping {:.4f}, {:.1f} nm,", "nearest {:.3f} Hz away,"
    for facts in missed:
        print(
            f"  missed: {line} {{:.3g}} x background; {away} least error {{:.3f}} Hz".format(*facts)
        )
    for facts in false:
        print(f"  false: {line} evidence {{:.1f}}".format(*facts))
    coverage(results)
    groups = {"all": results}
    groups["second-order turbulence"] = [r for r in results if not r["frozen"]]
    groups["frozen flow"] = [r for r in results if r["frozen"]]
    for name, group in groups.items():
        if not group:
            continue
        print(name)
        for key, words in (
            ("ratio", "residual variance, identified / truth"),
            ("limit", "the same / limit of performance"),
            ("replay_ratio", "of the first half / least squares, on the second"),
        ):
            values = np.array([r[key] for r in group])
            print(
                f"  {words:48s} median {np.median(values):.4f}, 95th percentile "
                f"{np.percentile(values, 95):.4f}, largest {np.max(values):.4f}, "
                f"below 1: {100 * np.mean(values < 1):.0f} %"
            )
        gains = np.array([r["gain"] for r in group])
        deviations = np.array([r["gain_deviation"] for r in group])
        told = np.isfinite(deviations)
        print(
            f"  sensor gain found in {np.sum(told)} of {len(group)}: median error "
            f"{100 * np.median(np.abs(gains[told])):.2f} %, largest "
            f"{100 * np.max(np.abs(gains[told])):.1f} %, rms "
            f"{np.sqrt(np.mean(deviations[told] ** 2)):.2f} standard errors"
        )
        print(f"  innovations white at 1 %: {100 * np.mean([r['white'] for r in group]):.0f} %")
    times = np.array([[r["identify_s"], r["design_s"]] for r in results])
    print(
        f"processor time, one axis: identify median {np.median(times[:, 0]):.2f} s, largest "
        f"{np.max(times[:, 0]):.2f} s; design {np.median(times[:, 1]):.3f} s"
    )


def main() -> None:
    """Run the study."""
    asked = record_options(
        __doc__, records=200, jobs=2, seconds=60.0, errors=False, colour=0.0, close=False, wide=0
    )
    study, show, options = studied, table, {}
    if asked.errors:
        study, show = only_errors, show_errors
        options = {name: getattr(asked, name) for name in ("colour", "close", "wide")}
    show(run_all(partial(study, frames=int(asked.seconds * RATE), **options), asked))


if __name__ == "__main__":
    main()
