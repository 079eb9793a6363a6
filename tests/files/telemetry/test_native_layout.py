"""What stands in a telemetry file."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from support.telemetry import full

import lbt_synth as lbt
from lbt_synth.files.telemetry import native_layout
from lbt_synth.files.telemetry.conventions import CONVENTION
from lbt_synth.files.telemetry.fields import LAYERS


def test_the_fits_file_explains_itself(tmp_path):
    """Read with astropy alone: names, units, axes, timing."""
    seen = full()
    with fits.open(lbt.files.save_telemetry(tmp_path / "t.fits", seen)) as units:
        header = units[0].header
        assert units[0].data is None
        assert header["LBTTELEM"] == 1
        assert (header["RATE_HZ"], header["DELAY"], header["SENSGAIN"]) == (800, 2.25, 0.358)
        assert (header["DIAMETER"], header["STREHL"], header["WAVELEN"]) == (8.22, 0.83, 2.2)
        assert header["TIMING"] == seen.convention
        assert np.array_equal(units["MIRROR_TAPS"].data, seen.mirror_taps)
        assert np.array_equal(units["COMMANDS"].data, seen.commands)
        assert np.array_equal(units["CTRL_A"].data, seen.controller.A)
        assert units["COMMANDS"].header["BUNIT"] == "nm"
        assert units["SLOPES"].header["BUNIT"] == "pixel"
        axes = units["SLOPES"].header
        assert (axes["CTYPE2"], axes["NAXIS2"]) == ("FRAME", 6)
        assert (axes["CTYPE1"], axes["NAXIS1"]) == ("SLOPE", 8)
        names = [unit.name for unit in units[1:]]
        assert set(LAYERS) <= set(names)
        assert names[-1] == "META"


def test_the_taps_stand_in_the_file(tmp_path):
    """For who reads it without this package: an array of FITS or NumPy, and the words."""
    seen = full()
    with fits.open(lbt.files.save_telemetry(tmp_path / "t.fits", seen)) as units:
        assert np.array_equal(units["MIRROR_TAPS"].data, seen.hardware.mirror_taps)
        assert "with the mirror taps c" in units[0].header["TIMING"]
    with np.load(lbt.files.save_telemetry(tmp_path / "t.npz", seen)) as arrays:
        assert np.array_equal(arrays["MIRROR_TAPS"], seen.hardware.mirror_taps)


def test_a_settled_mirror_leaves_the_file_as_it_was(tmp_path):
    seen = full(mirror=None)
    assert seen.convention == CONVENTION
    assert seen.mirror_taps is None
    arrays, meta = native_layout.pack(seen, "float64")
    assert "MIRROR_TAPS" not in arrays
    assert "mirror" not in meta  # what 0.1 wrote, and reads
    assert native_layout.unpack(arrays, meta).mirror is None


@pytest.mark.parametrize(
    ("edit", "text"),
    [
        (lambda a, m: a.pop("MIRROR_TAPS"), "go together"),
        (lambda a, m: m.pop("mirror"), "go together"),
        (lambda a, m: a.update(MIRROR_TAPS=a["MIRROR_TAPS"][::-1]), "not those of its mirror"),
        (lambda a, m: m["mirror"].update(ramp_samples=2), "not those of its mirror"),
    ],
)
def test_taps_and_mirror_must_agree(edit, text):
    arrays, meta = native_layout.pack(full(), "float64")
    edit(arrays, meta)
    with pytest.raises(ValueError, match=text):
        native_layout.unpack(arrays, meta)
