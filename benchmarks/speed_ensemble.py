"""Cases of many loops at once: fixed gain files, and filters designed for each sample."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from harness import Row, paired, with_growth

import lbt_synth as lbt
from lbt_synth.studies.study.sample import evaluate_samples

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
FEW = 16  # loops that the peer does; its time is scaled up
TOLD = """
version: 1
config: {config}
samples: 4096
seed: 1
controllers:
  told: {{design: kalman, for: sample}}
parameters:
  atmosphere.seeing_arcsec: {{uniform: [0.5, 1.2]}}
  atmosphere.wind_speed_m_s: {{uniform: [10, 30]}}
  model.vibrations[0].frequency_hz: {{uniform: [19, 21]}}
  truth.vibrations[0].rms_mas: {{uniform: [40, 100], also: ["model.vibrations[0].rms_mas"]}}
  truth.sensor_gain: {{uniform: [0.4, 1.1]}}
"""


def fixed_design() -> dict[int, Row]:
    """Frequency x sensor gain x delay of one Kalman filter, no two alike."""
    config = lbt.load_config(EXAMPLES / "lbt.yaml")
    hardware, (line,) = config.hardware, config.truth.vibrations
    controller = lbt.kalman(config.plant).controller
    rng = np.random.default_rng(0)
    rows = {}
    for count in (64, 512, 4096):
        frequency = rng.uniform(18, 22, count)
        gain, delay = rng.uniform(0.4, 1.1, count), rng.uniform(2, 2.3, count)
        ensemble = lbt.loop.LoopEnsemble(
            sensor_gain=gain,
            delay_frames=delay,
            noise_nm=config.noise_nm,
            turbulence=config.atmosphere,
            vibrations=(lbt.loop.EnsembleVibration(frequency_hz=frequency, rms_nm=line.rms_nm),),
        )

        def ours(met: lbt.loop.LoopEnsemble = ensemble) -> object:
            return lbt.strehl(
                lbt.loop.ensemble_residuals(controller, hardware, met), config.imaging
            )

        def peer(f: np.ndarray = frequency, g: np.ndarray = gain, d: np.ndarray = delay) -> object:
            found = []
            for i in range(FEW):
                loop = lbt.close_loop(
                    replace(hardware, delay_frames=d[i]), controller, sensor_gain=g[i]
                )
                truth = replace(
                    config.truth,
                    sensor_gain=g[i],
                    vibrations=(replace(line, frequency_hz=f[i]),),
                )
                found.append(lbt.strehl(lbt.residual_budget(loop, truth), config.imaging))
            return found

        rows[count] = _scaled(paired(ours, peer, 3), count)
    return with_growth(rows)


def told_designs() -> dict[int, Row]:
    """Kalman filters of samples, designed and evaluated."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "told.yaml"
        file.write_text(TOLD.format(config=EXAMPLES / "lbt.yaml"))
        study = lbt.studies.load_study(file)
    rows = {}
    for count in (64, 512, 4096):
        values = study.values(0, count)
        row = paired(
            lambda v=values: evaluate_samples(study, v, 0),
            lambda v=values: evaluate_samples(study, v[:FEW], 0, together=False),
            3,
        )
        rows[count] = _scaled(row, count)
    return with_growth(rows)


def _scaled(row: Row, count: int) -> Row:
    """Scale the peer's time, of some loops, to all of them."""
    factor = count / FEW
    return row | {"peer_s": row["peer_s"] * factor, "ratio": row["ratio"] * factor}


ENSEMBLE = (
    ("many loops of a gain file at once (loop by loop)", "loops", fixed_design),
    ("Kalman filters for samples, designed and evaluated (one by one)", "samples", told_designs),
)


if __name__ == "__main__":
    for title, size, case in ENSEMBLE:
        print(title)
        for count, row in case().items():
            print(f"  {count:5d} {size}: {1e3 * row['ours_s']:8.1f} ms, {row['ratio']:6.0f} times")
