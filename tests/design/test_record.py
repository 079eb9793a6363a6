"""Gain files of filters of several sensors: what they hold, and what they refuse."""

import numpy as np
import pytest
from support.gain_files import edited_file

import lbt_synth as lbt
from lbt_synth.errors import GainFileError


def scale_array(name):
    def change(document):
        document["arrays"][name] = (1.01 * np.array(document["arrays"][name])).tolist()

    return change


def set_meta(*keys, value):
    def change(document):
        place = document["meta"]
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    "change",
    [
        scale_array("GAIN_PREDICTOR"),
        scale_array("FALLBACKS"),
        scale_array("A"),
        scale_array("PLANT_A"),
        set_meta("sensors", 0, "noise_nm", value=10.0),
        set_meta("sensors", 0, "delay_frames", value=3.0),
        set_meta("sensors", 1, "highpass_hz", value=2.0),
        set_meta("sensors", 1, "kind", value="thermometer"),
        set_meta("motions", 0, "m1", "size", value=1.9),
        set_meta("motions", 0, value={}),
        set_meta("fallbacks", 0, value=["m1"]),
        set_meta("vibrations", 0, "frequency_hz", value=21.0),
        set_meta("frame_rate_hz", value=999.0),
        scale_array("GAIN_FILTER"),
        scale_array("NOISE"),
        set_meta("method", value="integrator"),
        set_meta("claims", "rms", value=100.0),
    ],
)
def test_an_altered_file_is_refused(sensors_design, tmp_path, change):
    path = edited_file(tmp_path / "sensors.npz", sensors_design, change)
    with pytest.raises(GainFileError):
        lbt.load_gain(path)


def test_gains_of_readings_that_are_not_due_are_refused(sensors_design, tmp_path):
    def change(document):
        document["arrays"]["GAIN_PREDICTOR"][1][0][2] = (
            1e-3  # the slow sensor is not read at phase 1
        )

    path = edited_file(tmp_path / "sensors.npz", sensors_design, change)
    with pytest.raises(GainFileError, match="GAIN_PREDICTOR is not what"):
        lbt.load_gain(path)
