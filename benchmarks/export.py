"""What exports lose: run with ``python benchmarks/export.py`` from the repository."""

import sys
import tempfile
from pathlib import Path

import numpy as np
from speed_export import frame

import lbt_synth as lbt
from lbt_synth.interop.c.terms import SourceTerms

sys.path.insert(0, "tests")
from support.exports import bare_design

CONFIG = lbt.load_config("examples/lbt.yaml")


def source(folder: Path) -> None:
    """Operations, and what single precision changes."""
    prior = lbt.models.spread_plant(CONFIG.plant, half_width_hz=3.5, lines=15)
    for name, design in (
        ("kalman", lbt.kalman(CONFIG.plant)),
        ("hinf", lbt.hinf(CONFIG.plant, gamma_ratio=1.2)),
        ("integrator", lbt.design.optimal_integrator(CONFIG.hardware, CONFIG.truth)),
        ("15 lines an axis", lbt.kalman(prior)),
    ):
        cost = lbt.interop.frame_cost(design)
        written = lbt.interop.export(folder / "c.c", design, "c", precision="single")
        print(
            f"{name}: {cost.states} states, {cost.multiplications} multiplications "
            f"a frame, single precision {written.error:.1e}"
        )


def forms() -> None:
    """Nanoseconds a frame of both forms of the source, whichever would be chosen."""
    designs = {
        "kalman": lbt.kalman(CONFIG.plant),
        "15 lines an axis": lbt.kalman(
            lbt.models.spread_plant(CONFIG.plant, half_width_hz=3.5, lines=15)
        ),
    }
    rng = np.random.default_rng(0)
    for n in (10, 24, 44, 80):
        A = rng.standard_normal((n, n))
        A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
        full = lbt.Controller(
            A=A,
            B=rng.standard_normal((n, 2)),
            C=rng.standard_normal((2, n)),
            D=rng.standard_normal((2, 2)),
        )
        # the loop of the design is not what is timed
        designs[f"no zeros, {n} states"] = bare_design(full)
    chosen = SourceTerms.dense
    for name, design in designs.items():
        times = []
        for written in (True, False):
            SourceTerms.dense = not written
            times.append(1e9 * frame(design, single=False)["ours_s"])
        SourceTerms.dense = chosen
        print(f"{name}: written out {times[0]:.0f} ns, loops {times[1]:.0f} ns")


if __name__ == "__main__":
    forms()
    with tempfile.TemporaryDirectory() as place:
        source(Path(place))
