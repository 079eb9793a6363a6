"""Filters over an interval of vibration frequencies: the worst norm and the worst rms of each.

Run as ``python benchmarks/decisions_polytopic.py``; one axis of the example with a damping of 0.01.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lbt_synth as lbt
from lbt_synth.design.worst_case import bound_worst_error, error_size, search_worst_error
from lbt_synth.models.plant.frequency_interval import FrequencyInterval

SLOW = lbt.models.ARModel(
    coefficients=[0.9886], driving_rms_nm=591.6 * np.sqrt(1 - 0.9886**2), frame_rate_hz=800
)
LINE = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1.0,))
COMMON = {"frame_rate_hz": 800, "turbulence": SLOW, "noise_nm": 15.5, "modes": 1}
PLANT = lbt.tip_tilt_plant(vibrations=[LINE], **COMMON)


def predictor(design: lbt.design.FilterDesign) -> lbt.Controller:
    """Filter from ybar(k) to the estimate of z(k+1)."""
    return lbt.EstimationProblem.controller(design.problem, design.gain_predictor)


def mixture(interval: FrequencyInterval, lines: int, *, covering: bool) -> lbt.models.TipTiltPlant:
    """Plant with lines over the interval, as strong together as the worst plant, or below it.

    Where its vibration has more power at every frequency than the worst plant of the interval
    (on a fine grid), its norm with any filter bounds the norm over the interval; where it has
    less, what no filter reaches for it no filter reaches for the interval.
    """
    angle = np.linspace(0.001, np.pi - 0.001, 200_001)
    kept, (low, high) = interval.retention, interval.coefficients
    across = (1 + kept) * np.cos(angle)
    drive = LINE.ar_model(800).driving_rms_nm
    worst = (2 * drive**2 / 800) / (
        (across - np.clip(across, low, high)) ** 2 + ((1 - kept) * np.sin(angle)) ** 2
    )
    frequencies = np.linspace(interval.low_hz, interval.high_hz, lines)
    moved = [LINE.at_frequency(float(f)) for f in frequencies]
    total = sum(line.ar_model(800).psd(angle * 800 / (2 * np.pi)) for line in moved)
    size = float(np.sqrt(np.max(worst / total) if covering else np.min(worst / total)))
    return lbt.tip_tilt_plant(
        vibrations=[replace(line, rms_nm=line.rms_nm * size) for line in moved], **COMMON
    )


def main() -> None:
    """Print the tables."""
    for half in (0.2, 1.0, 2.0, 4.0):
        interval = FrequencyInterval(plant=PLANT, half_width_hz=half)
        designs = {
            "hinf, least gamma": predictor(lbt.hinf(PLANT, route="riccati")),
            "hinf, ratio 1.2": predictor(lbt.hinf(PLANT, gamma_ratio=1.2, route="riccati")),
            "kalman": predictor(lbt.kalman(PLANT)),
        }
        for lines in (5, 15):
            spread = lbt.models.spread_plant(PLANT, half_width_hz=half, lines=lines)
            designs[f"kalman, {lines} lines"] = predictor(lbt.kalman(spread))
        made = {
            norm: lbt.design.polytopic(PLANT, half_width_hz=half, norm=norm)
            for norm in ("hinf", "h2")
        }
        for lines in (5, 9):
            plant = mixture(interval, lines, covering=True)
            designs[f"hinf, {lines} covering"] = predictor(lbt.hinf(plant, route="riccati"))
        designs |= {f"polytopic {norm}": design.predictor for norm, design in made.items()}
        print(f"20 Hz +- {half:g} Hz: worst norm (guaranteed) and worst rms [nm], mean rms, states")
        for name, filtered in designs.items():
            norm, _ = search_worst_error(interval, filtered, "hinf")
            rms, _ = search_worst_error(interval, filtered, "h2")
            sure = bound_worst_error(interval, filtered, "hinf")
            variances = []
            for f in np.linspace(interval.low_hz, interval.high_hz, 41):
                error = interval.error_system(interval.coefficient(float(f)), filtered)
                variances.append(error_size(error, "h2") ** 2)
            mean = float(np.sqrt(np.mean(variances)))
            sizes = f"{norm:8.2f} ({sure:8.2f}) {rms:8.2f} {mean:8.2f}"
            print(f"  {name:20s} {sizes} {filtered.n_states:4d}")
        for norm, design in made.items():
            print(
                f"  {norm}: programme {design.bound_programme:.3f}, guaranteed "
                f"{design.bound_guaranteed:.3f}, found {design.worst_achieved:.3f}"
            )
        refuted = [
            lbt.hinf(mixture(interval, lines, covering=False), route="riccati").gamma_infeasible
            for lines in (2, 3, 5, 9)
        ]
        print(f"  no filter of any order reaches {max(level or 0.0 for level in refuted):.2f}")
        for name, design in made.items():
            gains = lbt.loop.stable_sensor_gains(PLANT.hardware, design.controller)
            print(f"  polytopic {name}: sensor gains {gains[0]:.3f} to {gains[1]:.3f}")


if __name__ == "__main__":
    main()
