"""What exports lose: run with ``python docs/measure/exports.py`` from the repository."""

import tempfile
from pathlib import Path

import lbt_synth as lbt

CONFIG = lbt.load_config("examples/lbt.yaml")


def transfer_functions(folder: Path) -> None:
    """Transfer functions over the number of lines that the filter knows."""
    for lines in (1, 2, 3, 4, 5):
        plant = CONFIG.plant
        if lines > 1:
            plant = lbt.spread_plant(plant, half_width_hz=3.5, lines=lines)
        design = lbt.kalman(plant)
        try:
            written = lbt.export_iir(folder / "iir.fits", design)
            said = f"double {written.error:.1e}, single {written.error_single:.1e}"
        except lbt.NumericalError as error:
            said = f"double {error.residual:.1e}: refused"
        print(f"{lines} lines an axis, {design.controller.n_states} states: {said}")


def source(folder: Path) -> None:
    """Operations, and what single precision changes."""
    prior = lbt.spread_plant(CONFIG.plant, half_width_hz=3.5, lines=15)
    for name, design in (
        ("kalman", lbt.kalman(CONFIG.plant)),
        ("hinf", lbt.hinf(CONFIG.plant, gamma_ratio=1.2)),
        ("integrator", lbt.optimal_integrator(CONFIG.hardware, CONFIG.truth)),
        ("15 lines an axis", lbt.kalman(prior)),
    ):
        cost = lbt.frame_cost(design)
        written = lbt.export_c(folder / "c.c", design, precision="single")
        print(
            f"{name}: {cost.states} states, {cost.multiplications} multiplications "
            f"({cost.dense_multiplications} dense), single precision {written.error:.1e}"
        )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        transfer_functions(Path(place))
        source(Path(place))
