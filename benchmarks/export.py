"""What exports lose: run with ``python benchmarks/export.py`` from the repository."""

import tempfile
from pathlib import Path

import lbt_synth as lbt

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


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        source(Path(place))
