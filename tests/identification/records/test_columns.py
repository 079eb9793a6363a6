"""Names of columns are read in linear time, with their units in brackets or after an underscore."""

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.identification.records.columns import parse_column

NAMES = {
    "y_tip [nm]": ("measurements", 0, "nm"),
    "y_tip_nm": ("measurements", 0, "nm"),
    "psd (nm^2/Hz)": ("density", None, "nm^2/Hz"),
    "asd [nm/sqrt(Hz)]": ("amplitude", None, "nm/sqrt(Hz)"),
    "psd_nm^2/Hz": ("density", None, "nm^2/Hz"),
    "y [mas (rms)]": ("measurements", None, "mas (rms)"),
    "y nm]": (None, None, None),
    "y []": ("measurements", None, None),
    "_nm": (None, None, None),
}


@pytest.mark.parametrize("name", NAMES)
def test_role_axis_and_unit(name):
    found = parse_column(name, np.zeros(3))
    assert (found.role, found.axis, found.unit) == NAMES[name]


LONG = 100_000
HEADINGS = [
    "t,y" + "[" * LONG + "a" * LONG,
    "t,y" + "(" * LONG,
    "t,y" + "[]" * LONG,
    "t,y" + "_" * LONG,
    "t,y nm" + " " * LONG + "/ hz",
    "# frame_rate_hz = 1" + " " * LONG + "x\nt,y",
    "# frame_rate_hz" + " " * LONG + "x\nt,y",
    "# " + "a " * LONG + "x\nt,y",
]


@pytest.mark.parametrize("heading", HEADINGS, ids=lambda text: text[:12])
def test_long_headings_are_read_in_linear_time(tmp_path, heading):
    """Half a cubic or quadratic search of this length would take hours."""
    path = tmp_path / "a.csv"
    path.write_text(f"{heading}\n0,1\n1,2\n")
    with pytest.raises(lbt.LbtSynthError) as caught:
        lbt.load_record(path)
    assert len(str(caught.value)) < 2_500
