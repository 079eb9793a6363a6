"""The folder that pyRTC starts from."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from ruamel.yaml import YAML
from support.exports import lbt_designs
from support.gain_files import odd_plant
from support.lqg import shell, slow_plant
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.interop.pyrtc.export import InnerLoop, pol_filter

NAMES = ["config.yaml", "config.yaml.certificate.json", "gain.fits", "interaction_matrix.npz"]


def test_the_folder_holds_all_that_it_refers_to(tmp_path):
    """For more modes than the design has, and a loop of other matrices."""
    plant, expected, folder = odd_plant(), np.eye(4), tmp_path / "k"
    design, options = lbt.kalman(plant), {"modes": 4, "gain_digest": "a" * 64}
    written = lbt.interop.export(folder, design, "pyrtc", **options)
    assert sorted(path.name for path in folder.iterdir()) == NAMES
    assert sorted(path.name for path in written.files) == NAMES
    assert 0 < written.error < 1e-6
    conf = YAML(typ="safe").load(folder / "config.yaml")
    assert {"wfs", "slopes", "wfc", "loop"} <= set(conf)
    predictor, mirror = conf["loop"]["predictor"], conf["wfc"]
    assert (predictor["gain_file"], predictor["delay_frames"]) == ("gain.fits", 3)
    assert conf["loop"]["gain"] == 1.0
    assert mirror["num_modes"] == mirror["num_actuators"] == conf["slopes"]["signal_size"] == 4
    again = lbt.load_gain(folder / predictor["gain_file"])
    assert np.array_equal(again.controller.A, design.controller.A)
    matrix = np.load(folder / conf["loop"]["im_file"])
    expected[:2, :2] = plant.hardware.sensor @ plant.hardware.influence
    assert np.array_equal(matrix["data"], expected)
    assert json.loads(str(matrix["pyrtc_calibration"]))["kind"] == "interaction_matrix"


PATH = lbt.LoopHardware(frame_rate_hz=800, modes=1)


DESIGNS = {
    **{name: lambda name=name: lbt_designs()[name] for name in ("kalman", "hinf", "integrator")},
    "quick": lambda: lbt.integrator(replace(PATH, delay_frames=1.0), gain=0.4),
    "odd": lambda: lbt.kalman(odd_plant()),
    "slow": lambda: lbt.lqg(slow_plant(mirror=shell(150, natural_frequency_hz=50))),
}


@pytest.mark.parametrize("name", DESIGNS)
def test_what_pyrtc_computes_is_the_controller(name):
    design = DESIGNS[name]()
    found = pol_filter(design)
    assert np.any(found.tap_error) == (name in ("odd", "slow"))
    assert found.system.spectral_radius < (0.97 if name == "kalman" else 1)  # 1.03 alone
    frequencies = np.array([0.5, 10.0, 20.0, 60.0, 399.0])
    expected, written = (
        c.to_statespace().frequency_response(frequencies)
        for c in (design.controller, found.as_computed().controllers[frozenset()])
    )
    # matrices that are not the identity are inverted in single precision
    tolerance = 1e-6 if name == "odd" else 1e-12
    assert np.max(np.abs(written - expected)) < tolerance * np.max(np.abs(expected))


def test_the_filter_of_an_integrator_in_closed_form():
    """With u+ = u + g y and pol = y + u two frames ago: u(k) = u(k-1) + g (pol(k) - u(k-2))."""
    running, u = InnerLoop(pol_filter(lbt.integrator(PATH, gain=0.4))), [0.0, 0.0]
    for pol in np.random.default_rng(0).standard_normal(50):
        u.append(u[-1] + 0.4 * (pol - u[-2]))
        assert running.step_pol(np.array([pol]))[0] == pytest.approx(u[-1], rel=1e-6)


def test_the_noise_of_the_arithmetic_in_closed_form():
    """Rounding enters the residual, and the command where it is sent."""
    design = lbt.integrator(PATH, gain=0.4)
    rounding = pol_filter(design).as_computed()
    entry = rounding.entry.to_statespace().frequency_response([30.0])[0, 0]
    z = np.exp(2j * np.pi * 30.0 / 800)
    law = 0.4 / (1 - 1 / z)
    # a command that is off by e is known to be: u = law (y + z^-2 e) + e
    assert entry == pytest.approx([1 + law / z**2, law])
    ulp = 2.0**-24 / np.sqrt(3)
    sizes = np.sqrt(rounding.variance(1.0, np.array([3.0]), np.array([4.0])))
    assert sizes == pytest.approx([ulp * 4, ulp * np.sqrt(3 * 9 + 49)])


def test_a_loop_that_pyrtc_cannot_hold_is_refused():
    single, skew = (
        lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=sensor), gain=0.3)
        for sensor in ([[1.0], [0.5]], [[1.0, 0.0], [0.0, 1e-5]])
    )
    rows = [
        (partial(pol_filter, single), ProblemError, "got 2 measurements of 1 commands"),
        (partial(pol_filter, skew), ProblemError, r"a condition number of 1e\+05 \(limit 10000\)"),
    ]
    require_refusals(rows)
