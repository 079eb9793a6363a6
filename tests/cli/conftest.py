"""Files that the tests of several commands read."""

import pytest
from support.night import GAIN, simulated_night

import lbt_synth as lbt


@pytest.fixture(scope="session")
def gains(lbt_designs, tmp_path_factory):
    """Gain files of three designs for the LBT, by their names."""
    folder = tmp_path_factory.mktemp("gains")
    return {name: lbt.save_gain(folder / f"{name}.fits", d) for name, d in lbt_designs.items()}


@pytest.fixture(scope="session")
def recorded_night(tmp_path_factory):
    simulation, path, _ = simulated_night()
    seen = lbt.files.telemetry_from_simulation(simulation, path, sensor_gain=GAIN)
    return lbt.files.save_telemetry(tmp_path_factory.mktemp("night") / "night.fits", seen)
