"""Designs of the package and their rivals on records: trained on the past, scored on the future.

    python benchmarks/league.py [RECORD ...] [--records 7] [--seconds 30] [--splits 3]

Without files, record k is simulated with the change number k modulo 7; 0 is none. Two axes, an
integrator runs. What competes on a split has learned from the frames before it only; the best
integrator in hindsight alone knows the test. The table has the measured residual above the best of
each record (with noise, geometric mean, %), its standard error, and the share of records within
1 %; then the same per record.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from harness import least_squares
from scipy.linalg import solve_toeplitz
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

import lbt_synth as lbt
from lbt_synth.identification.prediction.residual import (
    ResidualEstimate,
    estimate_residual,
    gather,
    mode_noise,
    replay,
    settled_test,
)
from lbt_synth.identification.records.faults import mark
from lbt_synth.identification.records.record import Stretches, cut_stretches, keep_frames
from lbt_synth.linear.controller import as_controller
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray

Entry = lbt.Controller | lbt.Design | FloatArray
CHANGES = ("none", "wind", "seeing", "drifting", "dying", "flux", "gain")
DELAY, GAIN = 2, 0.35
AR_ORDER = 20  # of the predictor, as pyRTC's default
GAIN_TOLERANCE = 1e-3  # of the search for the best integrator
NEAR = 0.01  # of the best residual: as good as the best


def sampled_resonance(frequency_hz, damping, rate):
    """Return a1, a2 and the driving rms of a sampled resonance of unit variance, damping < 1."""
    omega = 2 * np.pi * frequency_hz / rate
    a1 = 2 * np.exp(-damping * omega) * np.cos(omega * np.sqrt(1 - damping**2))
    a2 = -np.exp(-2 * damping * omega)
    return a1, a2, np.sqrt((1 + a2) * ((1 - a2) ** 2 - a1**2) / (1 - a2))


def resonance(rng, frames, rate, frequency_hz, damping, rms_nm):
    """A second-order process whose frequency and rms may change from frame to frame, (frames,)."""
    frequency = np.broadcast_to(frequency_hz, frames)
    level = np.broadcast_to(rms_nm, frames)
    if np.ptp(frequency) == 0:
        a1, a2, drive = sampled_resonance(frequency[0], damping, rate)
        more = 20 * round(rate / (2 * np.pi * frequency[0] * damping))
        white = rng.standard_normal(frames + more)
        unit = lfilter([drive], [1, -a1, -a2], white)[more:]
        return level * unit
    phase = 2 * np.pi * np.cumsum(frequency) / rate
    width = 2 * np.pi * np.mean(frequency) * damping / rate
    pole, more = np.exp(-width), 20 * round(1 / width)
    white = rng.standard_normal((2, frames + more)) * np.sqrt(1 - pole**2)
    cosine, sine = lfilter([1], [1, -pole], white, axis=1)[:, more:]
    return level * (cosine * np.cos(phase) + sine * np.sin(phase))


def simulate_record(seed: int, seconds: float) -> lbt.identification.LoopRecord:
    """Return a record of two axes with one kind of change."""
    rng = np.random.default_rng([17, seed])
    change = CHANGES[seed % len(CHANGES)]
    rate = float(rng.choice([500, 800, 1000]))
    frames = round(seconds * rate)
    ramp = np.linspace(0, 1, frames)
    gain = np.full(frames, rng.uniform(0.5, 1.0))
    noise = np.full(frames, np.exp(rng.uniform(np.log(3), np.log(25))))
    corner, rms = np.exp(rng.uniform(np.log(0.4), np.log(2))), rng.uniform(200, 600)
    if change == "flux":
        noise = noise * np.exp(rng.uniform(0.5, 1.0) * (2 * ramp - 1))
    if change == "gain":
        gain = gain * (1 + rng.uniform(-0.3, 0.3) * (ramp - 0.5))
    total = np.zeros((frames, 2))
    for axis in range(2):
        level = rms * 2.0 ** (rng.uniform(-1, 1) * (2 * ramp - 1)) if change == "seeing" else rms
        air = resonance(rng, frames, rate, corner, 0.7, level)
        if change == "wind":  # one flow fades into another, twice as fast
            faster = resonance(rng, frames, rate, 2 * corner, 0.7, level)
            air = np.cos(np.pi / 2 * ramp) * air + np.sin(np.pi / 2 * ramp) * faster
        total[:, axis] = lfilter([0.05], [1, -0.95], air)
        for _ in range(int(rng.integers(1, 5))):
            f, damping = (
                rng.uniform(6, 0.12 * rate),
                np.exp(rng.uniform(np.log(0.002), np.log(0.03))),
            )
            size = rng.uniform(10, 120)
            if change == "drifting":
                f = f * (1 + rng.uniform(-0.08, 0.08) * ramp)
            if change == "dying":
                size = size * (
                    1 / (1 + np.exp(rng.choice([-20, 20]) * (ramp - rng.uniform(0.3, 0.9))))
                )
            total[:, axis] += resonance(rng, frames, rate, f, damping, size)
    y, u = np.zeros((frames, 2)), np.zeros((frames, 2))
    w = noise[:, None] * rng.standard_normal((frames, 2))
    for k in range(frames):
        correction = u[k - DELAY] if k >= DELAY else 0
        y[k] = gain[k] * (total[k] - correction) + w[k]
        u[k] = (u[k - 1] if k else 0) + GAIN * y[k]
    return lbt.identification.loop_record(
        y, u, frame_rate_hz=rate, delay_frames=DELAY, unit="nm", source=change
    )


def best_gain(left: Callable[[float], float], hardware: lbt.models.LoopHardware) -> float:
    """Return the gain of an integrator that leaves least, below the limit of stability."""
    limit = lbt.design.integrator_gain_limit(hardware)
    gains = np.geomspace(0.02, 0.95, 24) * limit  # finer than the width of a minimum
    values = [left(gain) for gain in gains]
    k = int(np.argmin(values))
    bracket = gains[max(k - 1, 0)], gains[min(k + 1, len(gains) - 1)]
    options = {"xatol": GAIN_TOLERANCE * gains[k]}
    return float(minimize_scalar(left, bounds=bracket, method="bounded", options=options).x)


def integrators(hardware: lbt.models.LoopHardware, gains: Sequence[float]) -> lbt.Controller:
    """Return an integrator per axis."""
    eye = np.eye(len(gains))
    B = np.diag(gains) @ np.linalg.inv(hardware.sensor)
    return lbt.Controller(A=eye, B=B, C=eye, D=np.zeros_like(eye), dt_s=hardware.dt_s)


@dataclass(frozen=True, eq=False)
class Split:
    """Frames to learn from, later ones that count, and the model that the first give."""

    record: lbt.identification.LoopRecord
    training: Stretches
    test: Stretches
    model: lbt.identification.IdentifiedModel

    @property
    def hardware(self) -> LoopHardware:
        return self.model.hardware

    @property
    def open_loop(self) -> FloatArray:
        return self.record.pseudo_open_loop(self.model.sensor_gains)

    def residual(self, entry: Entry) -> ResidualEstimate:
        """Return what a controller would have left of the test, or a series leaves (frames, n)."""
        runs, left_nm = self.record.stretches(), entry
        kept = settled_test(runs, self.test, self.hardware)
        if not isinstance(left_nm, np.ndarray):
            loop = lbt.close_loop(self.hardware, as_controller(entry))
            loop.require_stable()
            left_nm = replay(loop, self.open_loop, runs)
        noise_nm2 = np.diag([axis.noise_nm**2 for axis in self.model.axes])
        noise = mode_noise(self.hardware, noise_nm2, 0.0)
        return estimate_residual(gather(left_nm, kept), kept, *noise)


def best_integrator(split: Split) -> lbt.Controller:
    """Return the integrators that leave least of the test itself: no integrator leaves less."""
    axes = split.hardware.modes

    def left(gain: float, axis: int) -> float:
        residual = split.residual(integrators(split.hardware, [gain] * axes))
        return float(np.mean(residual.measured_nm[:, axis] ** 2))

    gains = [best_gain(lambda gain, i=axis: left(gain, i), split.hardware) for axis in range(axes)]
    return integrators(split.hardware, gains)


def ar_filter(split: Split) -> lbt.Design:
    """Return a Kalman filter for an AR model of each axis by Yule-Walker, as pyRTC's ar_kalman."""
    start, stop = max(split.training, key=lambda stretch: stretch[1] - stretch[0])
    hardware, models = split.hardware, []
    for z in split.open_loop[start:stop].T:
        z = z - np.mean(z)
        r = np.array([z[: len(z) - lag] @ z[lag:] / len(z) for lag in range(AR_ORDER + 1)])
        a = solve_toeplitz(r[:-1], r[1:])
        models.append(
            lbt.models.ARModel(
                coefficients=a,
                driving_rms_nm=np.sqrt(r[0] - a @ r[1:]),
                frame_rate_hz=hardware.frame_rate_hz,
            )
        )
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=hardware.frame_rate_hz,
        turbulence=models,
        noise_nm=[axis.noise_nm for axis in split.model.axes],
        delay_frames=hardware.delay_frames,
        sensor_matrix=hardware.sensor,
        modes=hardware.modes,
    )
    return lbt.kalman(plant)


def fir_predictor(split: Split, taps: int) -> FloatArray:
    """Return what the best FIR predictor of the training leaves, (frames, n)."""
    return least_squares(split.open_loop, split.hardware.mirror_taps, taps, split.training)


ENTRIES: dict[str, Callable[[Split], Entry]] = {
    "best integrator": best_integrator,
    f"AR({AR_ORDER}) filter": ar_filter,
    "least squares, 32 taps": lambda split: fir_predictor(split, 32),
    "least squares, 64 taps": lambda split: fir_predictor(split, 64),
    "Kalman": lambda split: lbt.kalman(split.model.plant()),
    "H-infinity, 1.2 of least": lambda split: lbt.hinf(split.model.plant(), gamma_ratio=1.2),
    "automatic": lambda split: lbt.design_from_record(past(split)).design,
}


def past(split: Split) -> lbt.identification.LoopRecord:
    """Return the record as it was when the training ended."""
    stop = split.training[-1][1]
    names = ("measurements", "commands", "usable", "measured", "commanded")
    series = {name: getattr(split.record, name) for name in names}
    return replace(split.record, **{k: x[:stop] for k, x in series.items() if x is not None})


def residuals_of(
    record: lbt.identification.LoopRecord, splits: int
) -> dict[str, list[ResidualEstimate]]:
    """Return what each entry leaves of each test, without those that fail."""
    model, residuals, failed = None, {name: [] for name in ENTRIES}, set()
    stretches, usable = record.stretches(), int(np.sum(record.usable))
    for k in range(splits):
        end = int((1 + k / splits) / 2 * usable)
        training = cut_stretches(stretches, 0, end)
        test = cut_stretches(stretches, end, end + usable // (2 * splits))
        kept = mark(np.array(training), record.frames)
        model = lbt.identify(keep_frames(record, kept), start=model)
        split = Split(record, training, test, model)
        for name in [name for name in ENTRIES if name not in failed]:
            try:
                residuals[name].append(split.residual(ENTRIES[name](split)))
            except lbt.LbtSynthError as error:
                print(f"{name} is not in the table: {error}")
                failed.add(name)
    return {name: parts for name, parts in residuals.items() if name not in failed}


def relative_residual(
    parts: Sequence[ResidualEstimate],
    best: Sequence[ResidualEstimate],
) -> tuple[float, float]:
    """Return a measured residual over the least one, less 1, and its standard error."""
    least = np.mean([part.measured_nm2 for part in best])
    differences, errors = np.transpose([p.above(b) for p, b in zip(parts, best, strict=True)])
    ratio = np.sqrt(1 + np.mean(differences) / least)
    return ratio - 1, np.linalg.norm(errors) / len(errors) / (2 * ratio * least)


def play(records: dict[str, lbt.identification.LoopRecord], splits: int) -> None:
    """Print the table of the league."""
    chains = {}
    for name, record in records.items():
        try:
            residuals = residuals_of(record, splits)
        except lbt.LbtSynthError as error:
            print(f"{name} is not in the table: {error}")
            continue
        best = min(residuals.values(), key=lambda parts: sum(x.measured_nm2 for x in parts))
        chains[name] = {entry: relative_residual(x, best) for entry, x in residuals.items()}
    rows = []
    for entry in ENTRIES:
        ratios = {name: chain[entry] for name, chain in chains.items() if entry in chain}
        if ratios:
            above, errors = np.array(list(ratios.values())).T
            mean = np.expm1(np.mean(np.log1p(above)))
            error = np.linalg.norm(errors) / len(errors)
            near = np.sum(above <= NEAR) / len(chains)
            rows.append((-len(ratios), mean, error, near, entry, ratios))
    print(f"\n{'above the best [%]':26s}   mean     +- within 1 %", *(f"{n:>12}" for n in chains))
    for _, mean, error, near, entry, ratios in sorted(rows, key=lambda row: row[:2]):
        cells = [f"{100 * ratios[n][0]:12.2f}" if n in ratios else f"{'-':>12}" for n in chains]
        print(f"{entry:26s} {100 * mean:6.2f} {100 * error:6.2f} {100 * near:8.0f} %", *cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("files", nargs="*", metavar="RECORD", help="what loops recorded")
    parser.add_argument("--records", type=int, default=7, help="simulated records")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--splits", type=int, default=3)
    asked = parser.parse_args()
    records = {Path(path).stem: lbt.load_record(path) for path in asked.files} or {
        f"{seed:02d}-{CHANGES[seed % len(CHANGES)]}": simulate_record(seed, asked.seconds)
        for seed in range(asked.records)
    }
    play(records, asked.splits)


if __name__ == "__main__":
    main()
