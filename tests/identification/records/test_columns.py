"""Names of columns, with their units in brackets or after an underscore."""

import numpy as np
import pytest

from lbt_synth.identification.records.columns import parse_column

NAMES = {
    "y_tip [nm]": ("measurements", 0, "nm"),
    "y_tip_nm": ("measurements", 0, "nm"),
    "psd (nm^2/Hz)": ("density", None, "nm^2/Hz"),
    "asd [nm/sqrt(Hz)]": ("density", None, "nm/sqrt(Hz)"),
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
