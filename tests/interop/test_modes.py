"""Matrices of all modes: a design with integrators, filters for each mode."""

import json

import numpy as np
import pytest
from astropy.io import fits
from support.compiled import Compiled
from support.exports import relative
from support.recorded_runs import recorded_run

import lbt_synth as lbt
from lbt_synth.design.modal import MixedController, modal_filters

pytestmark = pytest.mark.usefixtures("short_rehearsal")
AIR = lbt.models.ARModel(coefficients=[0.98], driving_rms_nm=20.0, frame_rate_hz=800)


def response(column, z):
    order = len(column) // 2
    powers = z[:, None] ** -np.arange(order + 1)
    return (powers @ column[: order + 1]) / (1 - powers[:, 1:] @ column[order + 1 :])


def steps(control, columns, frames=40):
    """Commands of a controller and of the matrix, run beside each other on white measurements."""
    rng = np.random.default_rng(0)
    twin = lbt.interop.dao.export.InnerLoop(columns)
    series = rng.standard_normal((frames, columns.shape[1]))
    return np.array([control.step(y) for y in series]), np.array([twin.step(y) for y in series])


def test_a_design_and_integrators_make_one_matrix(tmp_path, designs):
    gains = [0.0, 0.0, 0.5, 0.3, 0.0, 0.5]
    control = MixedController(filter=designs["integrator"], gains=gains, leak=0.99)
    written = lbt.interop.export(tmp_path / "k.npy", control, "dao", order=4)
    matrix = np.load(written.files[0])
    assert matrix.shape == (9, 6)
    own, found = steps(control, matrix)
    assert relative(found, own) < 1e-5
    assert not matrix[:, 4].any()  # no gain, no command
    names = [check.name for check in written.checks]
    assert any("spectral radius" in name and name.endswith("(modes 2 and 5)") for name in names)
    beside = json.loads((tmp_path / "k.npy.certificate.json").read_text())
    assert [check["name"] for check in beside["checks"]] == names


def test_filters_of_all_modes_make_one_matrix(tmp_path):
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=50, direction=(1.0,))
    models = {"noise_nm": [5.0, 6.0, 7.0], "vibrations": {1: [line]}, "sensor_gain": 0.8}
    filters = modal_filters([AIR] * 3, hardware=lbt.LoopHardware(frame_rate_hz=800), **models)
    matrix = np.load(lbt.interop.export(tmp_path / "k.npy", filters, "dao").files[0])
    z = np.exp(2j * np.pi * np.linspace(0.01, 0.49, 20))
    for mode in range(3):
        system = filters.design(mode).controller.to_statespace()
        expected = system.frequency_response(np.angle(z) / (2 * np.pi) * 800)[:, 0, 0]
        assert relative(response(matrix[:, mode].astype(float), z), expected) < 1e-4
    mixed = MixedController(filter=filters, gains=[0.4] * 5, filtered=[1, 2, 4])
    both = np.load(lbt.interop.export(tmp_path / "both.npy", mixed, "dao").files[0])
    assert np.array_equal(both[:, [1, 2, 4]], matrix)
    assert both[[0, 21]][:, [0, 3]].tolist() == np.float32([[0.4, 0.4], [1, 1]]).tolist()


def test_an_integrator_for_each_further_mode(tmp_path, designs):
    target = tmp_path / "k.npy"
    lbt.interop.export(target, designs["kalman"], "dao", modes=4, other_gain=0.25)
    matrix = np.load(target)
    plain = np.load(lbt.interop.export(target, designs["kalman"], "dao", modes=2).files[0])
    assert np.array_equal(matrix[:, :2], plain)
    assert matrix[:, 2].tolist() == [0.25, *[0.0] * 20, 1.0, *[0.0] * 19]


GAINS = [0.0, 0.0, 0.5, 0.3, 0.0, 0.5]


def loop_commands(run, hardware, seed=4, frames=600):
    """Commands of six modes in a loop, on noise and a slow phase."""
    rng = np.random.default_rng(seed)
    path = lbt.LoopHardware(frame_rate_hz=hardware.frame_rate_hz, modes=6)
    total = np.cumsum(rng.standard_normal((1, frames, 6)), axis=1)
    noise = 0.1 * rng.standard_normal((1, frames, 6))
    return recorded_run(run, path, total, noise)[0, :, 6:12]


def test_cacao_holds_all_modes_in_one_matrix(tmp_path, designs):
    control = MixedController(filter=designs["hinf"], gains=GAINS)
    written = lbt.interop.export(tmp_path / "pf.fits", control, "cacao")
    matrix = fits.getdata(written.files[0])
    steps = matrix.shape[1] // 6
    assert matrix.shape == (6, 6 * steps)
    cube = matrix.reshape(6, steps, 6)
    assert not cube[4].any()  # no gain, no command
    assert np.array_equal(cube[2, :, 2], cube[5, :, 5])
    for i, j in ((0, 2), (2, 0), (2, 3), (5, 2)):
        assert not cube[i, :, j].any()
    alone = lbt.interop.export(tmp_path / "own.fits", designs["hinf"], "cacao", steps=steps)
    assert np.array_equal(fits.getdata(alone.files[0]).reshape(2, steps, 2), cube[:2, :, :2])
    own = loop_commands(control, designs["hinf"].hardware)
    assert relative(loop_commands(written.start(np.inf), designs["hinf"].hardware), own) < 1e-3
    names = [check.name for check in written.checks]
    assert sum("small gain" in name and "(modes 2 and 5)" in name for name in names) == 1
    assert sum("residual at sensor gain 1," in name for name in names) == 3


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("form", ["plain", "estimator"])
def test_c_source_holds_all_modes(tmp_path, designs, form, precision):
    """Compiled, in a loop; in estimator form the commands that it gave were applied."""
    control = MixedController(filter=designs["kalman"], gains=GAINS, leak=0.99)
    options = {"form": form, "precision": precision, "modes": 6}
    written = lbt.interop.export(tmp_path / "ctl.c", control, "c", **options)
    theirs = Compiled(written.files[0], single=precision == "single")
    hardware = designs["kalman"].hardware
    own = loop_commands(control, hardware)
    limit = {"double": 1e-12, "single": 1e-4}[precision]
    if form == "plain":
        assert relative(loop_commands(theirs, hardware), own) < limit
    assert relative(loop_commands(written.start(np.inf), hardware), own) < limit
    last = np.zeros(6)
    theirs.reset()
    twin = written.start(np.inf)
    for y in np.random.default_rng(5).standard_normal((50, 6)):
        last = theirs.step(y, last) if form == "estimator" else theirs.step(y)
        assert np.array_equal(last, twin.step(y))
    assert not last[4]
    names = [check.name for check in written.checks]
    assert sum("spectral radius at" in name for name in names) == 3


def test_the_source_of_many_modes_proves_equal_ones_once(tmp_path, designs):
    options = {"modes": 120, "other_gain": 0.4, "form": "estimator"}
    written = lbt.interop.export(tmp_path / "ctl.c", designs["kalman"], "c", **options)
    names = [check.name for check in written.checks if "spectral radius at" in check.name]
    assert len(names) == 2
    theirs = Compiled(written.files[0], single=False)
    assert np.allclose(theirs.step(np.ones(120), np.ones(120))[2:], 1.4)


def test_pyrtc_gets_the_gain_of_all_others_and_its_proof(tmp_path, designs):
    options = {"modes": 5, "other_gain": 0.4}
    written = lbt.interop.export(tmp_path / "k", designs["hinf"], "pyrtc", **options)
    text = written.files[0].read_text()
    assert "other_gain: 0.4 " in text
    assert "num_modes: 5" in text
    names = [check.name for check in written.checks]
    assert any("spectral radius" in name and name.endswith("(modes 2, 3 and 4)") for name in names)
    with pytest.raises(lbt.errors.LbtSynthError, match="closed loop|stable"):
        lbt.interop.export(tmp_path / "no", designs["hinf"], "pyrtc", modes=9, other_gain=1.4)
    control = MixedController(filter=designs["hinf"], gains=GAINS)
    with pytest.raises(lbt.errors.ProblemError, match="one design, for the first modes"):
        lbt.interop.export(tmp_path / "no", control, "pyrtc")
    assert not (tmp_path / "no").exists()


def test_what_makes_no_matrix_is_refused(tmp_path, designs):
    def refused(control, match, **options):
        with pytest.raises(lbt.errors.LbtSynthError, match=match):
            lbt.interop.export(tmp_path / "k.npy", control, "dao", **options)

    refused(MixedController(gains=[0.5, 0.3]), "got NoneType")
    wild = MixedController(filter=designs["kalman"], gains=[0.0, 0.0, 1.5])
    refused(wild, "gain|stable")
    bare = MixedController(filter=designs["kalman"].controller, gains=[0.0, 0.0, 0.5])
    refused(bare, "must be a certified design")
    refused(designs["kalman"], "other_gain needs modes, the number", other_gain=0.3)
    refused(designs["kalman"], "above 0", other_gain=-0.3, modes=3)
    refused(MixedController(gains=[0.5]), "other_gain goes with a design", other_gain=0.3)
    assert not list(tmp_path.iterdir())
