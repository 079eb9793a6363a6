"""Identification of random closed loops: lines found, filters designed, gains, times.

    python benchmarks/identification.py [--records 200] [--jobs 2] [--seconds 60]
    python benchmarks/identification.py --times

One axis at 1 kHz with a delay of 2 frames, an integrator of gain 0.2 to 0.6, sensor gain 0.4 to
1, noise 2 to 30 nm a frame (evenly in its logarithm). Even records: second-order turbulence of
200 to 800 nm, 0.2 to 3 Hz (in its logarithm) and damping 0.1 to 1. Odd records: frozen flow over
8.22 m, seeing 0.5 to 1.5 arcsec, outer scale 15 to 40 m, wind 5 to 25 m/s, which no process of
finite order has. 0 to 5 resonances of 5 to 100 nm rms, 5 to 150 Hz, damping 0.002 to 0.01 (in its
logarithm).
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

import lbt_synth as lbt
from lbt_synth.models.resonance_spectrum import coefficients

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
    seed: int, frames: int, *, rate: float = RATE, drift: lbt.models.ARModel | None = None
) -> Case:
    """Draw a loop, perhaps with a drift on top of its turbulence, and run it."""
    rng = np.random.default_rng([seed, 1])
    path = lbt.LoopHardware(frame_rate_hz=rate, delay_frames=2, modes=1)
    noise = float(np.exp(rng.uniform(np.log(2), np.log(30))))
    sensor_gain = float(rng.uniform(0.4, 1.0))
    frozen = bool(seed % 2)
    turbulence: lbt.models.Spectrum
    if frozen:
        turbulence = lbt.Atmosphere(
            seeing_arcsec=float(rng.uniform(0.5, 1.5)),
            outer_scale_m=float(rng.uniform(15, 40)),
            wind_speed_m_s=float(rng.uniform(5, 25)),
            diameter_m=8.22,
        )
    else:
        corner = float(np.exp(rng.uniform(np.log(0.2), np.log(3))))
        damping, rms = float(rng.uniform(0.1, 1.0)), float(rng.uniform(200, 800))
        a1, a2, drive = coefficients(2 * np.pi * corner / rate, damping)
        turbulence = lbt.models.ARModel(
            coefficients=[a1, a2], driving_rms_nm=rms * np.sqrt(drive), frame_rate_hz=rate
        )
    lines = tuple(
        lbt.Vibration(
            frequency_hz=float(rng.uniform(5, 150)),
            damping=float(np.exp(rng.uniform(np.log(0.002), np.log(0.01)))),
            rms_nm=float(rng.uniform(5, 100)),
            direction=(1.0,),
        )
        for _ in range(int(rng.integers(0, 6)))
    )
    total = turbulence if drift is None else lbt.models.SumSpectrum(parts=[turbulence, drift])
    truth = lbt.Truth(turbulence=total, vibrations=lines, noise_nm=noise, sensor_gain=sensor_gain)
    ran = lbt.integrator(path, gain=float(rng.uniform(0.2, 0.6)))
    run = lbt.simulate(
        ran.controller, truth, hardware=path, frames=frames, seed=seed, settle_frames=2000
    )
    record = lbt.identification.loop_record(
        run.measurements[0], run.commands[0], frame_rate_hz=rate, delay_frames=2, unit="nm"
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
        vibrations=lines or None,
        noise_nm=truth.noise_nm,
        sensor_gain=truth.sensor_gain,
        modes=1,
    )


def left(it: Case, controller: lbt.Controller) -> float:
    """Variance that a controller leaves of the truth [nm^2], exactly; inf if it is unstable."""
    loop = lbt.close_loop(it.path, controller, sensor_gain=it.truth.sensor_gain)
    if not loop.is_stable:
        return float("inf")
    return lbt.residual_budget(loop, it.truth).rms_nm ** 2


def background(it: Case, line: lbt.Vibration) -> float:
    """Density of everything but a line, at its frequency, as the sensor sees it [nm^2/Hz]."""
    f = np.array([line.frequency_hz])
    truth = it.truth
    found = 2 / RATE * (truth.noise_nm / truth.sensor_gain) ** 2
    found += float(truth.turbulence.psd(f)[0])
    others = (other for other in truth.vibrations if other is not line)
    return found + sum(float(other.ar_model(RATE).psd(f)[0]) for other in others)


def judged(it: Case, axis: lbt.identification.IdentifiedAxis) -> dict[str, list[tuple[float, ...]]]:
    """Match the lines that were found with those there are, the strongest first."""
    spare = list(axis.lines)
    out: dict[str, list[tuple[float, ...]]] = {"found": [], "missed": [], "false": []}
    for line in sorted(it.truth.vibrations, key=lambda v: -v.rms_nm):
        own = float(line.ar_model(RATE).psd(np.array([line.frequency_hz]))[0])
        clear = own > background(it, line)  # with it, twice the background
        near = min(spare, key=lambda x: abs(x.frequency_hz - line.frequency_hz), default=None)
        away = np.inf if near is None else abs(near.frequency_hz - line.frequency_hz)
        # the least standard error of any estimate from so many seconds
        bound = np.sqrt(line.frequency_hz * line.damping / (2 * np.pi * it.record.duration_s))
        if near is not None and away < max(NEAR_HZ, 5 * bound):
            spare.remove(near)
        if clear:
            facts = (
                line.frequency_hz,
                line.damping,
                line.rms_nm,
                own / background(it, line),
                float(away),
                float(bound),
            )
            out["found" if away < NEAR_HZ else "missed"].append(facts)
    out["false"] = [(x.frequency_hz, x.damping, x.rms_nm, x.evidence) for x in spare]
    return out


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
    limit = lbt.loop.least_residual(it.path, it.truth).rms_nm ** 2
    half, other = lbt.identification.split_halves(it.record.stretches(), it.record.frames)
    halved = lbt.identify(it.record, stretches=half)
    gain = halved.sensor_gains[0]
    predictor = lbt.identification.least_squares_predictor(
        it.record.pseudo_open_loop(gain),
        it.path,
        taps=32,
        sensor_gain=gain,
        stretches=half,
    )
    half_filter = lbt.kalman(halved.plant()).controller
    true_open = it.record.pseudo_open_loop(it.truth.sensor_gain)
    replays = [
        lbt.identification.replayed_residual(
            true_open,
            controller,
            it.path,
            noise_nm=it.truth.noise_nm,
            sensor_gain=it.truth.sensor_gain,
            stretches=it.record.stretches(),
            test=other,
        ).total_nm2
        for controller in (half_filter, predictor.controller)
    ]
    error = axis.sensor_gain_error
    return {
        "seed": seed,
        "frozen": it.frozen,
        **judged(it, axis),
        "ratio": left(it, filter_.controller) / best,
        "limit": left(it, filter_.controller) / limit,
        "half_ratio": left(it, half_filter) / left(it, predictor.controller),
        "replay_ratio": replays[0] / replays[1],
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
    for facts in missed:
        print(
            "  missed: record {} {:.2f} Hz, damping {:.4f}, {:.1f} nm, {:.3g} x background; "
            "nearest {:.3f} Hz away, least error {:.3f} Hz".format(*facts)
        )
    for facts in false:
        print(
            "  false: record {} {:.2f} Hz, damping {:.4f}, {:.1f} nm, evidence {:.1f}".format(
                *facts
            )
        )
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
            ("half_ratio", "first half: identified / predictor, exact"),
            ("replay_ratio", "the same, replayed on the second half"),
        ):
            values = np.array([r[key] for r in group])
            print(
                f"  {words:42s} median {np.median(values):.4f}, 95th percentile "
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


def times() -> None:
    """Print the processor time of two axes of a minute with five lines."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=2)
    lines = tuple(
        lbt.Vibration(frequency_hz=f, damping=0.005, rms_nm=r, direction=d)
        for f, r, d in (
            (13.0, 40.0, (1.0, 0.0)),
            (31.0, 80.0, (1.0, 0.0)),
            (74.0, 15.0, (1.0, 0.0)),
            (22.0, 60.0, (0.0, 1.0)),
            (110.0, 20.0, (0.0, 1.0)),
        )
    )
    air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
    truth = lbt.Truth(turbulence=air, vibrations=lines, noise_nm=10.0, sensor_gain=0.6)
    run = lbt.simulate(
        lbt.integrator(path, gain=0.5).controller, truth, hardware=path, frames=60_000
    )
    record = lbt.identification.loop_record(
        run.measurements[0], run.commands[0], frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
    lbt.identify(record)  # imports
    begin = time.process_time()
    model = lbt.identify(record)
    middle = time.process_time()
    lbt.kalman(model.plant())
    end = time.process_time()
    lbt.design_from_record(record)
    last = time.process_time()
    print(f"lines found              {[len(axis.lines) for axis in model.axes]}")
    print(f"identify, two axes       {middle - begin:.2f} s")
    print(f"design                   {end - middle:.3f} s")
    print(f"halves, test and design  {last - end:.2f} s")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--times", action="store_true", help="only the time of two axes")
    asked = parser.parse_args()
    if asked.times:
        times()
        return
    one = partial(studied, frames=int(asked.seconds * RATE))
    with ProcessPoolExecutor(asked.jobs) as pool:
        seeds = range(asked.first, asked.first + asked.records)
        table(list(pool.map(one, seeds)))


if __name__ == "__main__":
    main()
