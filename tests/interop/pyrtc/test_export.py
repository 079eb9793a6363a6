"""The folder that pyRTC starts from."""

import json
from dataclasses import replace

import numpy as np
import pytest
from ruamel.yaml import YAML
from support.exports import bare_design, lbt_designs
from support.gain_files import odd_plant
from support.recorded_runs import recorded_run

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.interop.pyrtc.export import InnerLoop, pol_filter

NAMES = ["config.yaml", "config.yaml.certificate.json", "gain.fits", "interaction_matrix.npz"]


def read(folder):
    return YAML(typ="safe").load(folder / "config.yaml")


def test_the_folder_holds_all_that_it_refers_to(tmp_path):
    design = lbt_designs()["kalman"]
    written = lbt.interop.export(tmp_path / "k", design, "pyrtc", gain_digest="a" * 64)
    assert sorted(path.name for path in (tmp_path / "k").iterdir()) == NAMES
    assert sorted(path.name for path in written.files) == NAMES
    assert 0 < written.error < 1e-6
    conf = read(tmp_path / "k")
    assert {"wfs", "slopes", "wfc", "loop"} <= set(conf)
    predictor = conf["loop"]["predictor"]
    assert (predictor["gain_file"], predictor["delay_frames"]) == ("gain.fits", 2)
    assert conf["loop"]["gain"] == 1.0
    assert conf["wfc"]["num_modes"] == conf["slopes"]["signal_size"] == 2
    again = lbt.load_gain(tmp_path / "k" / "gain.fits")
    assert np.array_equal(again.controller.A, design.controller.A)
    held = np.load(tmp_path / "k" / conf["loop"]["im_file"])
    assert np.array_equal(held["data"], np.eye(2))
    assert json.loads(str(held["pyrtc_calibration"]))["kind"] == "interaction_matrix"


def test_a_loop_of_more_modes_and_other_matrices(tmp_path):
    plant = odd_plant()
    lbt.interop.export(tmp_path, lbt.kalman(plant), "pyrtc", modes=4)
    assert read(tmp_path)["wfc"]["num_actuators"] == 4
    expected = np.eye(4)
    expected[:2, :2] = plant.hardware.sensor @ plant.hardware.influence
    assert np.array_equal(np.load(tmp_path / "interaction_matrix.npz")["data"], expected)


PATH = lbt.LoopHardware(frame_rate_hz=800, modes=1)


def slow_mirror():
    """A design for a mirror that moves for many frames."""
    shell = lbt.models.PositionLoop.from_bandwidth(
        natural_frequency_hz=50, damping=0.5, bandwidth_hz=150
    )
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        modes=1,
        turbulence=lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10, frame_rate_hz=800),
        noise_nm=5.0,
        mirror=shell,
    )
    return lbt.lqg(plant)


DESIGNS = {
    "kalman": lambda: lbt_designs()["kalman"],
    "hinf": lambda: lbt_designs()["hinf"],
    "integrator": lambda: lbt_designs()["integrator"],
    "quick": lambda: lbt.integrator(replace(PATH, delay_frames=1.0), gain=0.4),
    "odd": lambda: lbt.kalman(odd_plant()),
    "slow": slow_mirror,
}


@pytest.mark.parametrize("name", DESIGNS)
def test_what_pyrtc_computes_is_the_controller(name):
    design = DESIGNS[name]()
    found = pol_filter(design)
    assert np.any(found.tap_error) == (name in ("odd", "slow"))
    assert found.system.spectral_radius < 1
    frequencies = np.array([0.5, 10.0, 20.0, 60.0, 399.0])
    expected, written = (
        c.to_statespace().frequency_response(frequencies)
        for c in (design.controller, found.as_computed().controllers[frozenset()])
    )
    # matrices that are not the identity are inverted in single precision
    tolerance = 1e-6 if name == "odd" else 1e-12
    assert np.max(np.abs(written - expected)) < tolerance * np.max(np.abs(expected))


def test_a_controller_that_is_unstable_alone_becomes_a_stable_filter():
    design = lbt_designs()["kalman"]
    assert np.max(np.abs(np.linalg.eigvals(design.controller.A))) > 1.03
    assert pol_filter(design).system.spectral_radius < 0.97


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
    (whole,) = rounding.controllers.values()
    entry = rounding.entry.to_statespace().frequency_response([30.0])[0, 0]
    z = np.exp(2j * np.pi * 30.0 / 800)
    own = 0.4 / (1 - 1 / z)
    assert whole.to_statespace().frequency_response([30.0])[0, 0, 0] == pytest.approx(own)
    # a command that is off by e is known to be: u = own (y + z^-2 e) + e
    assert entry == pytest.approx([1 + own / z**2, own])
    ulp = 2.0**-24 / np.sqrt(3)
    assert np.sqrt(rounding.variance(1.0, np.array([3.0]), np.array([4.0]))) == pytest.approx(
        [ulp * 4, ulp * np.sqrt(3 * 9 + 49)]
    )


def test_a_loop_that_pyrtc_cannot_hold_is_refused():
    with pytest.raises(ProblemError, match="needs the design of a loop"):
        pol_filter(bare_design(lbt_designs()["kalman"].controller))
    for sensor, words in (
        ([[1.0], [0.5]], "got 2 measurements of 1 commands"),
        ([[1.0, 0.0], [0.0, 1e-5]], r"a condition number of 1e\+05 \(limit 10000\)"),
    ):
        path = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=sensor)
        with pytest.raises(ProblemError, match=words):
            pol_filter(lbt.integrator(path, gain=0.3))


def series(design, frames, seed=0):
    rng = np.random.default_rng(seed)
    total = np.cumsum(5 * rng.standard_normal((1, frames, design.hardware.modes)), axis=1)
    return total, 10 * rng.standard_normal((1, frames, design.hardware.modes))


def test_a_clipped_command_winds_nothing_up():
    design = lbt_designs()["kalman"]
    total, noise = series(design, 3000)
    total[:, 500:1000] += 1e5  # far beyond the stroke
    free, held = (
        recorded_run(InnerLoop(pol_filter(design), limit), design.hardware, total, noise)[0, :, :2]
        for limit in (np.inf, 500.0)
    )
    assert np.max(np.abs(held[600:1000])) > 9e4
    assert np.max(np.abs(held - free)[1600:]) < 1.0
    alone = design.controller.start()
    for y in held[500:1000]:
        alone.step(y)
    assert np.max(np.abs(alone.state)) > 1e8


def test_reset_forgets():
    loop = InnerLoop(pol_filter(lbt.integrator(PATH, gain=0.5)))
    assert [loop.step([2.0])[0] for _ in range(2)] == [1.0, 2.0]
    loop.reset()
    assert loop.step([2.0])[0] == 1.0
