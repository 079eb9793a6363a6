"""Drifting vibrations in a configuration file."""

from __future__ import annotations

import pytest
from support.drifting import drift_file

import lbt_synth as lbt


def test_a_configuration_may_have_one(tmp_path):
    (found,) = lbt.load_config(drift_file(tmp_path)).truth.vibrations
    expected = lbt.models.DriftingVibration(start_hz=17, end_hz=23, duration_s=60, rms_nm=797)
    assert found == expected
    damped = "kind: drift\n      end_hz: 16\n      duration_s: 9\n      damping: 0.01"
    (found,) = lbt.load_config(drift_file(tmp_path, damped)).truth.vibrations
    assert (found.damping, found.end_hz, found.duration_s) == (0.01, 16, 9)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("kind: drift", "end_hz and duration_s go with kind: drift"),
        ("kind: drift\n      end_hz: 23", "end_hz and duration_s go with kind: drift"),
        ("kind: sinusoid\n      end_hz: 23", "end_hz and duration_s go with kind: drift"),
        ("kind: sinusoid\n      damping: 0.1", "damping goes with kind: resonance"),
        ("kind: drift\n      end_hz: 500\n      duration_s: 60", r"\[0\].end_hz: must lie below"),
        ("kind: drift\n      end_hz: -3\n      duration_s: 60", "greater than 0"),
        (
            "kind: drift\n      end_hz: 2\n      duration_s: 60\n      damping: 0.5",
            r"truth.vibrations\[0\]: .* frequency above that",
        ),
    ],
)
def test_wrong_keys_are_refused(tmp_path, keys, words):
    with pytest.raises(lbt.errors.ConfigError, match=words):
        lbt.load_config(drift_file(tmp_path, keys))
