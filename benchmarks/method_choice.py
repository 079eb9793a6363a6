"""How often the automatic choice of a method is near the best one on a quarter that nothing saw.

    python benchmarks/method_choice.py [--records 10] [--seconds 40] [--times | --designs]

The records are those of ``benchmarks/league.py``: in each, something changes. The choice is made
on the first three quarters, all methods are designed from these, and replayed on the last quarter.
The table has the measured residual above the best method's [%]. ``--times`` measures the processor
time of ``design_from_record`` instead, with a given method and with a choice; ``--designs`` that
of a design by each method, for plants of 1, 4 and 8 lines per axis.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from league import CHANGES, Split, past, simulate_record

import lbt_synth as lbt
from lbt_synth.errors import LbtSynthError
from lbt_synth.methods.registry import default_method, method_named, record_methods
from lbt_synth.methods.request import PlantInputs, design_request


def residuals_of_last_quarter(record) -> tuple[str, dict[str, float]]:
    """Return the choice from three quarters, and what each method measures in the last one [nm]."""
    training, test = lbt.identification.split_halves(
        record.stretches(), record.frames, fit_share=0.75
    )
    split = Split(record, training, test, lbt.identify(record, stretches=training))
    title = lbt.design_from_record(past(split), accept_record=True).name
    choice = next(name for name in record_methods() if method_named(name).title == title)
    left = {}
    for name in record_methods():
        inputs = PlantInputs(plant=split.model.plant(), design_defaults={"gamma_ratio": 1.2})
        design = design_request(name, method_named(name).reference_options).build(inputs)
        left[name] = float(np.sqrt(split.residual(design.controller).measured_nm2))
    return choice, left


def measure_times(seconds: float, records: int) -> None:
    """Print the processor times with a method and with a choice."""
    for seed in range(records):
        record, times = simulate_record(seed, seconds), []
        for method in (default_method(), None):
            begin = time.process_time()
            lbt.design_from_record(record, method=method, accept_record=True)
            times.append(time.process_time() - begin)
        print(f"{seed:02d} given {times[0]:.2f} s, chosen {times[1]:.2f} s", flush=True)


def measure_designs() -> None:
    """Print the processor time of a design by each method."""
    rng = np.random.default_rng(0)
    air = lbt.models.ARModel(coefficients=[1.995, -0.99505], driving_rms_nm=0.2, frame_rate_hz=1000)
    for count in (1, 4, 8):
        places = np.linspace(8, 110, count)
        lines = [
            lbt.Vibration(frequency_hz=float(f), damping=0.005, rms_nm=30, direction=direction)
            for direction in ((1.0, 0.0), (0.0, 1.0))
            for f in places + rng.uniform(-2, 2, count)
        ]
        plant = lbt.tip_tilt_plant(
            frame_rate_hz=1000, turbulence=air, vibrations=lines, noise_nm=8.0
        )
        for name in record_methods():
            request = design_request(name, method_named(name).reference_options)
            begin = time.process_time()
            request.build(PlantInputs(plant=plant))
            used = time.process_time() - begin
            print(f"{plant.A.shape[0]} states, {name:8s} {used:7.3f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--records", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=40)
    parser.add_argument("--times", action="store_true")
    parser.add_argument("--designs", action="store_true")
    given = parser.parse_args()
    if given.times:
        measure_times(given.seconds, given.records)
        return
    if given.designs:
        measure_designs()
        return
    near = []
    print(f"{'record':14s}", *(f"{name:>8}" for name in record_methods()), "  chosen")
    for seed in range(given.records):
        record = f"{seed:02d}-{CHANGES[seed % len(CHANGES)]}"
        try:
            choice, left = residuals_of_last_quarter(simulate_record(seed, given.seconds))
        except LbtSynthError as error:
            print(f"{record:14s} refused: {error}", flush=True)
            continue
        above = {name: 100 * (value / min(left.values()) - 1) for name, value in left.items()}
        near.append(above[choice] <= 1)
        cells = (f"{value:8.2f}" for value in above.values())
        print(f"{record:14s}", *cells, f"  {choice}", flush=True)
    print(f"the choice is within 1 % of the best method on {sum(near)} of {len(near)} records")


if __name__ == "__main__":
    main()
