"""Matrices of dao real-time computers, read back and run."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from support.exports import relative

import lbt_synth as lbt
from lbt_synth.interop.dao.direct_form import InnerLoop
from lbt_synth.loop.simulation.disturbances import draw_disturbance, draw_noise
from lbt_synth.loop.simulation.run import step_loop


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator"])
def test_the_matrix_holds_the_controller(tmp_path, designs, name):
    design = designs[name]
    written = lbt.interop.export_dao(tmp_path / "K_mat.npy", design, modes=5)
    matrix = np.load(written.files[0])
    assert (matrix.dtype, matrix.shape) == (np.float32, (41, 5))
    assert matrix.flags.c_contiguous
    assert not matrix[:, 2:].any()
    frequency = np.linspace(1, 399, 100)
    z = np.exp(2j * np.pi * frequency * design.controller.dt_s)
    powers = z[:, None] ** -np.arange(21)
    expected = design.controller.to_statespace().frequency_response(frequency)
    rounding = np.finfo(np.float32).eps / 2
    for mode in range(2):
        exact = expected[:, mode, mode]
        bottom = 1 - powers[:, 1:] @ matrix[21:, mode].astype(float)
        found = (powers @ matrix[:21, mode].astype(float)) / bottom
        sums = [np.sum(np.abs(part)) for part in (matrix[:21, mode], matrix[21:, mode])]
        allowed = rounding * (sums[0] + np.abs(exact) * sums[1]) / np.abs(bottom)
        assert np.all(np.abs(found - exact) <= 1.001 * allowed + 1e-12 * np.abs(exact))
        assert relative(found, exact) < 1e-3  # so little of the whole
    assert written.error == written.error_single < 1e-4


def test_fits_and_npy_are_alike_and_the_certificate_names_the_file(tmp_path, designs):
    digest = "ab" * 32
    for ending in ("npy", "fits"):
        target = tmp_path / f"{ending}.{ending}"
        written = lbt.interop.export_dao(target, designs["kalman"], order=6, gain_digest=digest)
        beside = json.loads((tmp_path / f"{ending}.{ending}.certificate.json").read_text())
        assert beside["file_sha256"] == hashlib.sha256(target.read_bytes()).hexdigest()
        assert (beside["order"], beside["modes"], beside["gain_sha256"]) == (6, 2, digest)
        assert [c["name"] for c in beside["checks"]] == [c.name for c in written.checks]
        assert all(check["passed"] for check in beside["checks"])
    with fits.open(tmp_path / "fits.fits", checksum=True) as units:
        assert units["K_MAT"].data.dtype == ">f4"
        assert np.array_equal(units["K_MAT"].data, np.load(tmp_path / "npy.npy"))


def test_the_loop_runs_in_its_arithmetic(tmp_path, designs):
    """The twin of the RTC leaves what the design leaves, on the same disturbance."""
    design = designs["kalman"]
    file = lbt.interop.export_dao(tmp_path / "k.npy", design).files[0]
    rng = np.random.default_rng(3)
    total = np.cumsum(rng.standard_normal((1, 1500, 2)), axis=1)
    noise = 0.1 * rng.standard_normal((1, 1500, 2))
    runs = (InnerLoop(np.load(file)), design.controller.start())
    found, own = (step_loop(run, 0.7, design.hardware, total, noise)[0, :, :2] for run in runs)
    assert np.std(found) == pytest.approx(np.std(own), rel=1e-4)
    assert not np.array_equal(found, own)


def test_a_design_that_single_precision_breaks_is_refused_with_the_number(tmp_path, loaded):
    lines = lbt.models.spread_plant(loaded.plant, half_width_hz=1.0, lines=3)
    with pytest.raises(lbt.errors.NumericalError, match="spectral radius at sensor gains") as seen:
        lbt.interop.export_dao(tmp_path / "k.npy", lbt.kalman(lines))
    assert seen.value.residual > 1
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def shaped_run(shaped):
    """Disturbance, noise, and what the shaped design leaves of them."""
    air, line, *_ = shaped.specifications[0].objective.terms
    vibration = lbt.models.SinusoidalVibration(
        frequency_hz=20.0, rms_nm=line.rms_nm, direction=(1.0,)
    )
    truth = lbt.Truth(turbulence=air.turbulence, noise_nm=air.noise_nm, vibrations=[vibration])
    rng, size = np.random.default_rng(1), {"frames": 6000, "cases": 1}
    total = draw_disturbance(truth, shaped.hardware, rng=rng, **size)
    noise = draw_noise(truth, shaped.hardware, rng=rng, **size)
    own = step_loop(shaped.controller.start(), 1.0, shaped.hardware, total, noise)
    return total, noise, own[0, 1000:, 0]


@pytest.mark.parametrize("order", [20, 15])
def test_a_shaped_design_that_single_precision_breaks_is_made_again(
    tmp_path, shaped, shaped_run, order
):
    """In the arithmetic of the computer the loop leaves what the design leaves in double."""
    written = lbt.interop.export_dao(tmp_path / "k.npy", shaped, order=order)
    matrix = np.load(written.files[0])
    assert matrix.shape == (2 * order + 1, 1)
    assert max(written_radius(matrix, gain) for gain in np.geomspace(0.5, 1.2, 40)) < 1
    beside = json.loads((tmp_path / "k.npy.certificate.json").read_text())
    assert beside["coefficients"].startswith("made again for single precision")
    assert written.made_again
    total, noise, own = shaped_run
    found = step_loop(InnerLoop(matrix), 1.0, shaped.hardware, total, noise)[0, 1000:, 0]
    assert np.std(found) == pytest.approx(np.std(own), rel=0.03)
    assert np.std(found) < 0.3 * np.std(total)


def test_coefficients_of_the_gain_file_are_kept_where_they_pass(tmp_path, designs):
    written = lbt.interop.export_dao(tmp_path / "k.npy", designs["kalman"])
    beside = json.loads((tmp_path / "k.npy.certificate.json").read_text())
    assert beside["coefficients"] == "of the gain file, rounded"
    assert not written.made_again


@pytest.mark.study
def test_the_robust_example_runs_in_single_precision(tmp_path):
    """Twelve states per axis, whose own coefficients reach a spectral radius of 1.133."""
    design = lbt.load_config("examples/lbt_robust.yaml").design("robust")
    written = lbt.interop.export_dao(tmp_path / "k.npy", design)
    losses = [check.value for check in written.checks if "residual" in check.name]
    assert len(losses) == 4
    assert max(losses) < 0.01
    matrix = np.load(written.files[0])
    assert max(written_radius(matrix, gain) for gain in np.geomspace(0.25, 1.3, 400)) < 1


def test_what_the_matrix_cannot_hold_is_refused(tmp_path, designs, loaded):
    def refused(design, match, **options):
        with pytest.raises(lbt.errors.ProblemError, match=match):
            lbt.interop.export_dao(tmp_path / "k.npy", design, **options)

    refused(designs["kalman"], "order must be at least 4", order=3)
    refused(designs["kalman"], "modes must be at least 2", modes=1)
    turned = replace(loaded.hardware, sensor_matrix=[[1, 0.1], [0, 1]])
    refused(lbt.integrator(turned, gain=0.3), "sensor_matrix must be the identity")
    bare = lbt.kalman(lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1))
    refused(bare, "needs the design of a loop")


def written_radius(matrix, gain):
    """Spectral radius of the loop of two frames, from the polynomial of the written numbers."""
    order = len(matrix) // 2
    own = np.concatenate([[1.0], -matrix[order + 1 :, 0].astype(float), [0.0, 0.0]])
    own[2:] += gain * matrix[: order + 1, 0]
    return np.max(np.abs(np.roots(own)))
