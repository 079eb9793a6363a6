"""What telemetry takes, and what it refuses."""

import dataclasses

import numpy as np
import pytest
from support.telemetry import full

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError


def test_hardware_of_slopes_is_seen_through_the_reconstructor():
    seen = full()
    expected = seen.reconstructor @ seen.interaction_matrix
    assert np.allclose(seen.hardware.sensor, expected)
    bare = full(reconstructor=None)
    assert np.array_equal(bare.hardware.sensor, np.eye(2))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"delay_frames": None, "mirror": None}, "does not tell the delay"),
        (
            {
                "influence_matrix": None,
                "commands": np.ones((6, 3)),
                "controller": None,
                "integrator_gains": None,
            },
            "3 commands of 2 modes, and no influence_matrix",
        ),
    ],
)
def test_hardware_that_is_not_known(changes, text):
    with pytest.raises(ProblemError, match=text):
        _ = full(**changes).hardware


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"mirror": 3}, "expected a PositionLoop; got int"),
        ({"delay_frames": None}, "needs delay_frames"),
        ({"delay_frames": 0.5}, "delay_frames must be at least 1"),
        ({"frame_rate_hz": 790.0, "controller": None}, "whole number of samples per frame"),
        ({"frame_rate_hz": 0}, "frame_rate_hz must be above 0"),
        ({"delay_frames": -1}, "delay_frames must be at least 0"),
        ({"strehl": 1.1}, "strehl must be at most 1"),
        ({"sensor_gain": 0}, "sensor_gain must be above 0"),
        ({"obstruction": 1}, "obstruction must be below 1"),
        ({"diameter_m": float("nan")}, "diameter_m must be finite"),
        ({"psf_pixel_mas": 0}, "psf_pixel_mas must be above 0"),
        ({"imaging_wavelength_um": -1}, "imaging_wavelength_um must be above 0"),
        ({"seed": 1.5}, "seed must be an integer"),
        (
            {"commands": [1.0, 2.0]},
            r"commands must be 2-D \(frame, command\) and not empty; got shape \(2,\)",
        ),
        ({"measurements": None}, "measurements must be an array of numbers"),
        ({"measurements": np.zeros((5, 2))}, "measurements must have 6 frames to match commands"),
        ({"measurements": np.zeros((6, 0))}, r"measurements must be 2-D .* not empty; got"),
        ({"residual_nm": np.full((6, 2), np.nan)}, "residual_nm must be finite; got nan at index"),
        ({"slopes": np.zeros((6, 8), dtype=complex)}, "slopes must be real"),
        ({"times_s": np.zeros(6)}, "times_s must rise"),
        ({"times_s": np.zeros(5)}, "times_s must have 6 frames to match commands"),
        ({"subaperture_axes": 3}, "subaperture_axes must divide the 8 values"),
        ({"interaction_matrix": np.ones((7, 2))}, "interaction_matrix must have 8 slopes to"),
        ({"reconstructor": np.ones((2, 7))}, "reconstructor must have 8 slopes to match slopes"),
        ({"influence_matrix": np.ones((2, 3))}, "must have 2 commands to match commands"),
        ({"influence_matrix": np.ones((3, 2))}, "must have 2 modes to match measurements"),
        ({"mode_maps": np.ones((3, 5, 4))}, r"mode_maps must have 2 modes to match .* \(3, 5, 4\)"),
        ({"mode_maps": np.ones((2, 5))}, "mode_maps must be 3-D"),
        ({"psf": np.ones(4)}, "psf must be 2-D"),
        ({"slope_unit": "µm"}, "slope_unit must be a word"),
        ({"command_unit": "x" * 30}, "command_unit must be a word"),
        ({"slope_unit": "'/"}, "slope_unit must be a word of at most 24 ASCII signs"),
        ({"command_unit": ""}, "command_unit must not be empty"),
        ({"measurement_unit": "m"}, "measurement_unit must be nm for lengths; got 'm'"),
        ({"measurement_unit": 3}, "measurement_unit must be a word"),
        ({"name": None}, "name must be a text"),
        ({"controller_name": 3}, "controller_name must be a text"),
        ({"metadata": [1]}, "metadata must be a mapping; got list"),
        ({"metadata": {1: 2}}, "keys of metadata must be words; got 1"),
        ({"metadata": {"a": [1]}}, "metadata must hold texts, numbers and truth values; got list"),
        ({"metadata": {"a": float("inf")}}, "metadata must be finite; got inf for 'a'"),
        ({"integrator_gains": [0.4]}, "integrator_gains must have 2 commands to match commands"),
        ({"controller": 3}, "expected a Controller; got int"),
        (
            {"frame_rate_hz": 801.0, "mirror": None},
            "controller must run at 801 Hz; got one for 800 Hz",
        ),
    ],
)
def test_what_does_not_fit_is_refused(changes, text):
    with pytest.raises(ProblemError, match=text):
        full(**changes)


def test_a_controller_of_other_sizes_is_refused():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    one = lbt.integrator(path, gain=0.4).controller
    with pytest.raises(DimensionError, match="must map 2 measurements to 2 commands; got 1 to 1"):
        full(controller=one)


def test_telemetry_cannot_be_changed():
    series = np.ones((6, 2))
    metadata = {"a": np.int64(3)}
    seen = full(commands=series, metadata=metadata)
    series[0, 0] = 5
    metadata["b"] = 1
    assert seen.commands[0, 0] == 1
    assert dict(seen.metadata) == {"a": 3}
    assert type(seen.metadata["a"]) is int
    with pytest.raises(ValueError):
        seen.commands[0, 0] = 2
    with pytest.raises(TypeError):
        seen.metadata["a"] = 4
    with pytest.raises(dataclasses.FrozenInstanceError):
        seen.seed = 3
