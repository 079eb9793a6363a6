"""What telemetry takes, and what it refuses."""

import dataclasses

import numpy as np
import pytest
from support.refusals import refused
from support.telemetry import full

from lbt_synth.errors import ProblemError


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"mirror": 3}, "expected a PositionLoop; got int"),
        ({"delay_frames": None}, "needs delay_frames"),
        ({"delay_frames": 0.5}, "delay_frames must be at least 1"),
        ({"frame_rate_hz": 790.0}, "whole number of samples per frame"),
        ({"frame_rate_hz": 0}, "frame_rate_hz must be above 0"),
        ({"delay_frames": -1}, "delay_frames must be at least 0"),
        ({"sensor_gain": 0}, "sensor_gain must be above 0"),
        ({"obstruction": 1}, "obstruction must be below 1"),
        ({"diameter_m": float("nan")}, "diameter_m must be finite"),
        ({"imaging_wavelength_um": -1}, "imaging_wavelength_um must be above 0"),
        ({"commands": [1.0, 2.0]}, r"must be 2-D \(frame, command\) and not empty; got .*\(2,\)"),
        ({"measurements": None}, "measurements must be an array of numbers"),
        ({"measurements": np.zeros((5, 3))}, "measurements must have 6 frames to match commands"),
        ({"measurements": np.zeros((6, 0))}, r"measurements must be 2-D .* not empty; got"),
        ({"residual_nm": np.full((6, 2), np.nan)}, "residual_nm must be finite; got nan at index"),
        ({"total_nm": np.zeros((6, 2), dtype=complex)}, "total_nm must be real"),
        ({"times_s": np.zeros(6)}, "times_s must rise"),
        ({"times_s": np.zeros(5)}, "times_s must have 6 frames to match commands"),
        ({"interaction_matrix": np.ones((7, 2))}, "must have 3 measurements to match measurements"),
        ({"influence_matrix": np.ones((2, 3))}, "must have 2 commands to match commands"),
        ({"influence_matrix": np.ones((3, 2))}, "must have 2 modes to match residual_nm"),
        ({"measurement_unit": "µm"}, "measurement_unit must be a word"),
        ({"command_unit": "x" * 30}, "command_unit must be a word"),
        ({"measurement_unit": "'/"}, "measurement_unit must be a word of at most 24 ASCII signs"),
        ({"command_unit": ""}, "command_unit must not be empty"),
        ({"measurement_unit": "m"}, "measurement_unit must be nm for lengths; got 'm'"),
        ({"measurement_unit": 3}, "measurement_unit must be a word"),
        ({"metadata": [1]}, "metadata must be a mapping; got list"),
        ({"metadata": {1: 2}}, "keys of metadata must be words; got 1"),
        ({"metadata": {"a": [1]}}, "metadata must hold texts, numbers and truth values; got list"),
        ({"metadata": {"a": float("inf")}}, "metadata must be finite; got inf for 'a'"),
        ({"delay_frames": None, "mirror": None}, "does not tell the delay"),
        ({"commands": np.ones((6, 3)), "influence_matrix": None}, "3 commands of 2 modes, and no"),
    ],
)
def test_what_does_not_fit_is_refused(changes, text):
    refused(lambda: full(**changes).hardware, ProblemError, text)


def test_telemetry_cannot_be_changed():
    series, metadata = np.ones((6, 2)), {"a": np.int64(3)}
    seen = full(commands=series, metadata=metadata)
    series[0, 0], metadata["b"] = 5, 1
    assert (seen.commands[0, 0], dict(seen.metadata)) == (1, {"a": 3})
    assert type(seen.metadata["a"]) is int
    assert repr(seen).startswith("<Telemetry: 6 frames of commands, measurements, ")
    assert len(repr(seen).splitlines()) == 2
    for change, error in (
        (lambda: seen.commands.fill(2), ValueError),
        (lambda: seen.metadata.update(a=4), AttributeError),  # of a read-only view
        (lambda: setattr(seen, "sensor_gain", 3), dataclasses.FrozenInstanceError),
    ):
        refused(change, error, None)
