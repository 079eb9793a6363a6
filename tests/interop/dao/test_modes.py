"""Matrices of all modes: a design with integrators, filters for each mode."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.exports import relative

import lbt_synth as lbt
from lbt_synth.design.modal import MixedController, modal_filters

AIR = lbt.models.ARModel(coefficients=[0.98], driving_rms_nm=20.0, frame_rate_hz=800)


def response(column, z):
    order = len(column) // 2
    powers = z[:, None] ** -np.arange(order + 1)
    return (powers @ column[: order + 1]) / (1 - powers[:, 1:] @ column[order + 1 :])


def steps(control, columns, frames=40):
    """Commands of a controller and of the matrix, run beside each other on white measurements."""
    rng = np.random.default_rng(0)
    twin = lbt.interop.dao.inner_loop.InnerLoop(columns)
    series = rng.standard_normal((frames, columns.shape[1]))
    return np.array([control.step(y) for y in series]), np.array([twin.step(y) for y in series])


def test_a_design_and_integrators_make_one_matrix(tmp_path, designs):
    gains = [0.0, 0.0, 0.5, 0.3, 0.0, 0.5]
    control = MixedController(filter=designs["integrator"], gains=gains, leak=0.99)
    written = lbt.interop.export_dao(tmp_path / "k.npy", control, order=4)
    matrix = np.load(written.files[0])
    assert matrix.shape == (9, 6)
    own, found = steps(control, matrix)
    assert relative(found, own) < 1e-5
    assert not matrix[:, 4].any()  # no gain, no command
    names = [check.name for check in written.checks]
    assert any("spectral radius" in name and name.endswith("(modes 2 and 5)") for name in names)
    beside = json.loads((tmp_path / "k.certificate.json").read_text())
    assert [check["name"] for check in beside["checks"]] == names


def test_filters_of_all_modes_make_one_matrix(tmp_path):
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=50, direction=(1.0,))
    models = {"noise_nm": [5.0, 6.0, 7.0], "vibrations": {1: [line]}, "sensor_gain": 0.8}
    filters = modal_filters([AIR] * 3, **models)
    matrix = np.load(lbt.interop.export_dao(tmp_path / "k.npy", filters).files[0])
    z = np.exp(2j * np.pi * np.linspace(0.01, 0.49, 20))
    for mode in range(3):
        system = filters.controller(mode).to_statespace()
        expected = system.frequency_response(np.angle(z) / (2 * np.pi) * 800)[:, 0, 0]
        assert relative(response(matrix[:, mode].astype(float), z), expected) < 1e-4
    mixed = MixedController(filter=filters, gains=[0.4] * 5, filtered=[1, 2, 4])
    both = np.load(lbt.interop.export_dao(tmp_path / "both.npy", mixed).files[0])
    assert np.array_equal(both[:, [1, 2, 4]], matrix)
    assert both[[0, 21]][:, [0, 3]].tolist() == np.float32([[0.4, 0.4], [1, 1]]).tolist()


def test_an_integrator_for_each_further_mode(tmp_path, designs):
    target = tmp_path / "k.npy"
    lbt.interop.export_dao(target, designs["kalman"], modes=4, other_gain=0.25)
    matrix = np.load(target)
    plain = np.load(lbt.interop.export_dao(target, designs["kalman"], modes=2).files[0])
    assert np.array_equal(matrix[:, :2], plain)
    assert matrix[:, 2].tolist() == [0.25, *[0.0] * 20, 1.0, *[0.0] * 19]


def test_integrators_alone_need_a_loop(tmp_path):
    control = MixedController.integrators([0.5, 0.3])
    with pytest.raises(lbt.errors.ProblemError, match="hardware must be given"):
        lbt.interop.export_dao(tmp_path / "k.npy", control)
    loop = lbt.LoopHardware(frame_rate_hz=500)
    written = lbt.interop.export_dao(tmp_path / "k.npy", control, hardware=loop, order=1)
    assert np.load(written.files[0])[0].tolist() == np.float32([0.5, 0.3]).tolist()


def test_what_makes_no_matrix_is_refused(tmp_path, designs):
    def refused(control, match, **options):
        with pytest.raises(lbt.errors.LbtSynthError, match=match):
            lbt.interop.export_dao(tmp_path / "k.npy", control, **options)

    loop = {"hardware": lbt.LoopHardware(frame_rate_hz=500)}
    refused(MixedController.integrators([0.0, 0.0]), "at least one mode must have a gain", **loop)
    refused(MixedController.integrators([0.5, 1.5]), "gain|stable", **loop)
    bare = MixedController(filter=designs["kalman"].controller, gains=[0.0, 0.0, 0.5])
    refused(bare, "must be a certified design", **loop)
    refused(designs["kalman"], "other_gain needs modes", other_gain=0.3)
    refused(designs["kalman"], "above 0", other_gain=-0.3, modes=3)
    refused(MixedController.integrators([0.5]), "other_gain goes with a design", other_gain=0.3)
    assert not list(tmp_path.iterdir())
