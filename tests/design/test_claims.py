"""Each claim and each array of a gain file, times 1.001: a named check fails."""

import numpy as np
import pytest
from support.gain_files import ORIGINALS, original

import lbt_synth as lbt
from lbt_synth.design.record import DesignRecord, rebuild_design, record_design
from lbt_synth.files.gain_file.store import require_agreement

FACTOR = 1.001


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
