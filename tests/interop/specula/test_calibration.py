"""Calibrations and their cache."""

from dataclasses import replace

import numpy as np
import pytest
from support.small_telescope import BRIGHT, needs_specula

import lbt_synth as lbt
from lbt_synth.errors import OutputError


def test_the_cache_must_be_a_directory(tmp_path):
    from lbt_synth.interop.specula.calibration import cache_directory

    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot make the directory"):
        cache_directory(tmp_path / "file" / "cache")


@needs_specula
def test_a_calibration_is_kept_by_its_content(cache, calibration):
    again = lbt.interop.calibrate(BRIGHT, cache=cache)
    assert again.cached
    assert again.key == calibration.key
    assert np.array_equal(again.reconstructor.matrix, calibration.reconstructor.matrix)
    assert np.array_equal(again.modes.shapes, calibration.modes.shapes)
    # the flux plays no part, the modulation does
    assert lbt.interop.calibrate(replace(BRIGHT, photons=10.0), cache=cache).cached
    other = lbt.interop.calibrate(replace(BRIGHT, modulation_lambda_over_d=3.0), cache=cache)
    assert not other.cached
    assert other.key != calibration.key


@needs_specula
def test_a_damaged_calibration_is_measured_again(tmp_path, calibration):
    first = lbt.interop.calibrate(BRIGHT, cache=tmp_path)
    (file,) = tmp_path.glob("calibration-*.npz")
    whole = file.read_bytes()
    for damage in (whole[: len(whole) // 2], b"", whole[:-2000] + b"x" * 2000):
        file.write_bytes(damage)
        found = lbt.interop.calibrate(BRIGHT, cache=tmp_path)
        assert not found.cached
        assert np.array_equal(found.reconstructor.matrix, first.reconstructor.matrix)
        assert lbt.interop.calibrate(BRIGHT, cache=tmp_path).cached
