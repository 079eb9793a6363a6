"""Records of designs: each claim and each array counts, and what is altered is refused."""

import numpy as np
import pytest
from support.gain_files import ORIGINALS, edited_file, original

import lbt_synth as lbt
from lbt_synth.design.record import DesignRecord, rebuild_design, record_design
from lbt_synth.errors import GainFileError
from lbt_synth.files.gain_file.store import require_agreement

FACTOR = 1.001


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


def complaint(design, record):
    """What is said of a record that was changed: a contradiction, or the checks that fail."""
    try:
        rebuilt = rebuild_design(type(design), record)
        require_agreement(record, record_design(rebuilt))
    except (ValueError, lbt.errors.LbtSynthError) as error:
        return str(error)
    return ", ".join(check.name for check in rebuilt.recertify().checks if not check.passed)


def times(value):
    """A claim times the factor: a number, or one of each mode."""
    return [FACTOR * part for part in value] if isinstance(value, list) else FACTOR * value


@pytest.mark.parametrize("name", ORIGINALS)
def test_each_claim_and_each_array_counts(name):
    """Times 1.001: a named check fails, or the file contradicts itself."""
    design = original(name)
    record = record_design(design)
    assert complaint(design, record) == ""
    for key, array in record.arrays.items():
        if np.any(array):
            changed = DesignRecord({**record.arrays, key: FACTOR * array}, record.meta)
            assert complaint(design, changed), key
    assert record.meta["claims"]
    for key, value in record.meta["claims"].items():
        claims = {**record.meta["claims"], key: times(value)}
        changed = DesignRecord(record.arrays, {**record.meta, "claims": claims})
        assert complaint(design, changed), key
