"""Gain files and transfer-function files in SPECULA's own filters: same commands."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from support.exports import relative
from support.plants import LBT_YAML, ROOT
from support.specula_filters import noise_series, simulate_commands

import lbt_synth as lbt

pytestmark = pytest.mark.e2e


DOUBLE, SINGLE = 0, 1


SCRIPT = ROOT / "tests" / "support" / "specula_filters.py"


@pytest.fixture(scope="module")
def designs():
    loaded = lbt.load_config(LBT_YAML)
    return {
        "kalman": lbt.kalman(loaded.plant),
        "hinf": lbt.hinf(loaded.plant, gamma_ratio=1.2),
        "integrator": lbt.design.optimal_integrator(loaded.hardware, loaded.truth),
    }


@pytest.fixture(scope="module")
def files(designs, tmp_path_factory):
    """The gain file as it is, and the exported transfer functions."""
    folder = tmp_path_factory.mktemp("specula")
    made = {}
    for name, design in designs.items():
        made[name, "ssr"] = lbt.save_gain(folder / f"{name}.fits", design)
        made[name, "iir"] = lbt.interop.export_iir(folder / f"{name}_iir.fits", design).files[0]
    return made


@pytest.fixture(scope="module", params=[DOUBLE, SINGLE], ids=["double", "single"])
def run(request, files, tmp_path_factory):
    """Commands of each file in SPECULA, in the closed loop and on given measurements."""
    output = tmp_path_factory.mktemp("run") / "commands.npz"
    named = [f"{kind}:{file}" for (_, kind), file in files.items()]
    done = subprocess.run(
        [sys.executable, SCRIPT, str(request.param), output, LBT_YAML, *named],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    with np.load(output) as data:
        series = {key: (data[f"loop{i}"], data[f"noise{i}"]) for i, key in enumerate(files)}
    return request.param, series


# what the loop of each file is held to, in double and in single precision; the state-space
# file has the controller's own numbers. The LMI leaves couplings of 1e-11 between the axes,
# which one transfer function an axis cannot have.
LIMITS = {
    ("kalman", "ssr"): (1e-12, 1e-5),
    ("hinf", "ssr"): (1e-12, 1e-5),
    ("integrator", "ssr"): (1e-12, 1e-5),
    ("kalman", "iir"): (1e-12, 1e-5),
    ("hinf", "iir"): (1e-10, 1e-5),
    ("integrator", "iir"): (1e-12, 1e-5),
}


@pytest.mark.parametrize("key", LIMITS, ids="-".join)
def test_the_closed_loop_is_that_of_our_simulator(designs, run, key):
    """Same disturbance and noise: SPECULA's filter in the loop, and our simulator."""
    precision, series = run
    expected = simulate_commands(designs[key[0]].controller, LBT_YAML)
    assert np.max(np.abs(expected)) > 100  # nm: there is something to correct
    assert relative(series[key][0], expected) < LIMITS[key][precision]


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_the_same_measurements_give_the_same_commands(designs, run, name):
    """The gain file untouched, against the stepped controller, on measurements of no loop."""
    precision, series = run
    ours = designs[name].controller.start()
    expected = np.array([ours.step(y) for y in noise_series(2)])
    assert relative(series[name, "ssr"][1], expected) < (1e-12, 1e-5)[precision]


def test_the_stated_error_of_a_transfer_function_is_what_specula_finds(designs, run, tmp_path):
    """Within a factor of ten: the disturbances of the two runs are not the same."""
    precision, series = run
    loop = series["kalman", "iir"][0]
    stated = lbt.interop.export_iir(tmp_path / "again.fits", designs["kalman"])
    own = series["kalman", "ssr"][0]
    found = relative(loop, own)
    claimed = (stated.error, stated.error_single)[precision]
    assert claimed / 10 < found < 10 * claimed
