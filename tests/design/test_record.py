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


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("sensors", 0, "noise_nm"), 10.0),
        (("sensors", 0, "delay_frames"), 3.0),
        (("sensors", 1, "highpass_hz"), 2.0),
        (("sensors", 1, "kind"), "thermometer"),
        (("motions", 0, "m1", "size"), 1.9),
        (("motions", 0), {}),
        (("fallbacks", 0), ["m1"]),
        (("vibrations", 0, "frequency_hz"), 21.0),
        (("frame_rate_hz",), 999.0),
        (("method",), "integrator"),
        (("GAIN_PREDICTOR", 1, 0, 2), 1e-3),  # the slow sensor is not due at phase 1
    ],
)
def test_an_altered_file_is_refused(sensors_design, tmp_path, path, value):
    def change(document):
        reduce(getitem, path[:-1], document["arrays"] | document["meta"])[path[-1]] = value
        document["meta"] |= {path[0]: value} if len(path) == 1 else {}

    words = "GAIN_PREDICTOR is not what" if path[0] == "GAIN_PREDICTOR" else None
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
