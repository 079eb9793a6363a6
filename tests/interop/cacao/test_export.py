"""Predictive filters of cacao, read back and run."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

import lbt_synth as lbt
from lbt_synth.interop.cacao.applied_filter import AppliedFilter
from lbt_synth.interop.cacao.export import filter_matrix
from lbt_synth.interop.cacao.truncation import predictive_filter, small_gain_check, written_filter
from lbt_synth.loop.simulation.run import step_loop

STEPS = 28
AIR = lbt.models.ARModel(coefficients=np.array([0.99]), driving_rms_nm=40.0, frame_rate_hz=800)


def make_design(modes=1, **options):
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800, turbulence=AIR, noise_nm=15.0, modes=modes, **options
    )
    return lbt.kalman(plant)


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """A Kalman filter whose two axes are coupled by an oblique line, and its export."""
    line = lbt.Vibration(frequency_hz=60, damping=0.2, rms_nm=200.0, direction=(0.6, 0.8))
    design = make_design(2, vibrations=[line])
    file = tmp_path_factory.mktemp("turned") / "pf.fits"
    return design, lbt.interop.export_cacao(file, design, steps=STEPS, gain_digest="ab" * 32)


@pytest.fixture
def path():
    return lbt.LoopHardware(frame_rate_hz=800, modes=1)


def test_the_matrix_is_the_controller_in_its_loop(turned):
    """Its columns are what the running controller answers to a pulse of pseudo-open-loop."""
    design, written = turned
    with fits.open(written.files[0], checksum=True) as units:
        matrix = units[0].data
    assert (matrix.shape, matrix.dtype) == ((2, 2 * STEPS), ">f4")
    for mode in range(2):
        pulse = np.zeros((1, STEPS, 2))
        pulse[0, 0, mode] = 1.0
        rest = np.zeros((1, STEPS, 2))
        run = step_loop(design.controller.start(), 1.0, design.hardware, rest, pulse)
        assert np.allclose(-matrix[:, mode::2].T, run[0, :, 2:4], rtol=1e-6, atol=1e-7)
    assert abs(matrix[0, 1]) > 1e-3  # the axes are coupled
    assert all(check.passed for check in written.checks)
    assert written.error == written.error_single < 0.02


def test_the_certificate_names_the_file(turned):
    target, beside = turned[1].files
    beside = json.loads(beside.read_text())
    assert beside["file_sha256"] == hashlib.sha256(target.read_bytes()).hexdigest()
    assert (beside["steps"], beside["modes"], beside["latency_frames"]) == (STEPS, 2, 3.0)
    assert all(check["passed"] for check in beside["checks"])


def test_the_loop_runs_in_its_arithmetic(turned):
    design, file = turned[0], turned[1].files[0]
    rng = np.random.default_rng(3)
    total = np.cumsum(rng.standard_normal((1, 1500, 2)), axis=1)
    noise = 0.1 * rng.standard_normal((1, 1500, 2))
    runs = (AppliedFilter(fits.getdata(file)), design.controller.start())
    found, own = (step_loop(run, 0.7, design.hardware, total, noise)[0, :, :2] for run in runs)
    assert np.std(found) == pytest.approx(np.std(own), rel=2e-2)
    assert not np.array_equal(found, own)


@pytest.mark.parametrize("steps", [20, 200])
def test_the_bound_on_the_loss_holds(steps):
    """The exact residual of the cut filter, by its own loop, is below the bound."""
    design = make_design(
        vibrations=[lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=300.0, direction=(1.0,))]
    )
    found = predictive_filter(design)
    written, _ = written_filter(found.taps(steps), design.hardware)
    loops = (lbt.close_loop(design.hardware, c) for c in (design.controller, written))
    before, after = (lbt.loop.model_budget(loop, design.problem).rms_nm for loop in loops)
    assert -1e-9 < after / before - 1 <= found.loss_bound(steps) + 1e-9
    assert (
        found.loss_bound(found.fewest_steps(0.1))
        <= 0.1
        < found.loss_bound(found.fewest_steps(0.1) - 1)
    )


def test_the_small_gain_is_that_of_the_closed_form(path):
    """An integrator g: Q = g z^2 (1 - 1/z) / (z^2 - z + g), and a cut after two steps."""
    design = lbt.integrator(path, gain=0.3)
    found = predictive_filter(design)
    taps = found.taps(2)
    assert np.allclose(taps[:, 0, 0], [0.3, 0.3])
    z = np.exp(1j * np.linspace(1e-4, np.pi, 20001))
    q = 0.3 * z**2 / (z**2 - z + 0.3)
    left_out = np.max(np.abs(q - 0.3 - 0.3 / z))
    low, high = design.hardware and lbt.loop.stable_sensor_gains(path, design.controller)
    expected = 0.0
    for gain in np.geomspace(max(1.01 * low, 0.1), min(high / 1.01, 10.0), 9):
        s = 1 / (1 + gain * 0.3 / (z * (z - 1)))
        expected = max(expected, abs(1 - gain) * np.max(np.abs(s + (1 - s) / gain)) * left_out)
    assert small_gain_check(found, taps).value == pytest.approx(expected, rel=1e-4)


def test_rounding_is_bounded_by_a_loop_in_that_arithmetic(path):
    design = lbt.integrator(path, gain=0.3)
    matrix = filter_matrix(predictive_filter(design).taps(60))
    taps = -matrix.astype(float).reshape(1, 60, 1).swapaxes(0, 1)
    written, rounding = written_filter(taps, path)
    rng = np.random.default_rng(0)
    total = 1e3 + 300 * np.cumsum(rng.standard_normal((1, 3000, 1)), axis=1) / 30
    rest = np.zeros((1, 3000, 1))
    single, double = (
        step_loop(run, 1.0, path, total, rest)[0]
        for run in (AppliedFilter(matrix), written.start())
    )
    rms = np.sqrt(np.mean(double**2, axis=0))
    bound = np.sqrt(np.sum(rounding.variance(1.0, rms[2:], rms[1:2])))
    assert 0 < np.std(single[:, 0] - double[:, 0]) < 3 * bound


def test_what_the_filter_cannot_hold_is_refused_with_the_number(tmp_path, path):
    def refused(kind, match, design, **options):
        with pytest.raises(kind, match=match):
            lbt.interop.export_cacao(tmp_path / "pf.fits", design, **options)
        assert not list(tmp_path.iterdir())

    problem, failed = lbt.errors.ProblemError, lbt.errors.NumericalError
    slow = lbt.integrator(path, gain=0.1)
    refused(failed, "cut after 8 steps; .* is ", slow, steps=8)
    sharp = make_design(
        vibrations=[lbt.Vibration(frequency_hz=20, damping=1e-5, rms_nm=3.0, direction=(1.0,))]
    )
    refused(failed, r"got \d{4,} steps of 1 modes", sharp)
    refused(problem, "steps must be at least 2", slow, steps=1)
    refused(problem, "loss must be", slow, loss=0.02)
    late = replace(path, delay_frames=9.0)
    refused(problem, "delay of at most 8", lbt.integrator(late, gain=0.02))
    turned = lbt.LoopHardware(frame_rate_hz=800, sensor_matrix=[[1, 0.1], [0, 1]])
    refused(problem, "sensor_matrix must be the identity", lbt.integrator(turned, gain=0.3))
    bare = lbt.kalman(lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1))
    refused(problem, "needs the design of a loop", bare)
