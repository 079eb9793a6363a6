"""Records of designs: each claim and each array counts, and what is altered is refused."""

from functools import reduce
from operator import getitem

import numpy as np
import pytest
from support.gain_files import ORIGINALS, edited_file, original

import lbt_synth as lbt
from lbt_synth.design.record import DesignRecord, rebuild_design, record_design
from lbt_synth.errors import GainFileError
from lbt_synth.files.gain_file.store import require_agreement

FACTOR = 1.001


def set_meta(*keys, value):
    def change(document):
        reduce(getitem, keys[:-1], document["meta"])[keys[-1]] = value

    return change


def read_too_early(document):
    document["arrays"]["GAIN_PREDICTOR"][1][0][2] = 1e-3  # the slow sensor is not due at phase 1


@pytest.mark.parametrize(
    "change",
    [
        set_meta("sensors", 0, "noise_nm", value=10.0),
        set_meta("sensors", 0, "delay_frames", value=3.0),
        set_meta("sensors", 1, "highpass_hz", value=2.0),
        set_meta("sensors", 1, "kind", value="thermometer"),
        set_meta("motions", 0, "m1", "size", value=1.9),
        set_meta("motions", 0, value={}),
        set_meta("fallbacks", 0, value=["m1"]),
        set_meta("vibrations", 0, "frequency_hz", value=21.0),
        set_meta("frame_rate_hz", value=999.0),
        set_meta("method", value="integrator"),
        read_too_early,
    ],
)
def test_an_altered_file_is_refused(sensors_design, tmp_path, change):
    words = "GAIN_PREDICTOR is not what" if change is read_too_early else None
    with pytest.raises(GainFileError, match=words):
        lbt.load_gain(edited_file(tmp_path / "sensors.npz", sensors_design, change))


def complaint(design, record):
    """Say what is wrong with a record that was changed: a contradiction, or the checks that fail."""
    try:
        rebuilt = rebuild_design(type(design), record)
        require_agreement(record, record_design(rebuilt))
    except (ValueError, lbt.errors.LbtSynthError) as error:
        return str(error)
    return ", ".join(check.name for check in rebuilt.recertify().checks if not check.passed)


@pytest.mark.parametrize("name", ORIGINALS)
def test_each_claim_and_each_array_counts(name):
    """Times 1.001, a named check fails, or the file contradicts itself."""
    design = original(name)
    record = record_design(design)
    arrays, meta, claims = record.arrays, record.meta, record.meta["claims"]
    assert complaint(design, record) == ""
    for key, array in arrays.items():
        if np.any(array):
            changed = DesignRecord({**arrays, key: FACTOR * array}, meta)
            assert complaint(design, changed), key
    assert claims
    for key, value in claims.items():
        more = [FACTOR * part for part in value] if isinstance(value, list) else FACTOR * value
        changed = DesignRecord(arrays, {**meta, "claims": {**claims, key: more}})
        assert complaint(design, changed), key
