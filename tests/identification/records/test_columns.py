"""Names of columns, with their units in brackets or after an underscore."""

import numpy as np
import pytest

from lbt_synth.errors import ProblemError
from lbt_synth.identification.records.columns import clock_factor, nm_unit, parse_column

NAMES = {
    "y_tip [nm]": ("measurements", 0, "nm"),
    "Residual (nm)": ("measurements", None, "nm"),
    "tilt_nm": ("measurements", 1, "nm"),
    "measurement 2 [nm]": ("measurements", 2, "nm"),
    "tip_command_um": ("commands", 0, "um"),
    "pol_tip_nm": ("open_loop", 0, "nm"),
    "disturbance_x [nm]": ("open_loop", 0, "nm"),
    "psd (nm^2/Hz)": ("density", None, "nm^2/Hz"),
    "asd [nm/sqrt(Hz)]": ("density", None, "nm/sqrt(Hz)"),
    "psd_nm2_hz": ("density", None, "nm2_hz"),
    "asd_mas_rthz": ("density", None, "mas_rthz"),
    "timestamp_ms": ("times", None, "ms"),
    "y [mas (rms)]": ("measurements", None, "mas (rms)"),
    "y nm]": (None, None, None),
    "y []": ("measurements", None, None),
    "y_a": (None, None, None),  # a is a year, and the name of an axis
    "f_mhz": (None, None, None),  # of mHz or of MHz
}


def test_role_axis_and_unit():
    columns = {name: parse_column(name, np.zeros(3)) for name in NAMES}
    assert {name: (c.role, c.axis, c.unit) for name, c in columns.items()} == NAMES


@pytest.mark.parametrize(
    ("unit", "kind", "power", "factor"),
    [
        ("nm", "loop", 0, 1.0),
        ("nanometers", "loop", 0, 1.0),
        ("µm", "loop", 0, 1e3),
        ("m", "loop", 0, 1e9),
        ("mas", "loop", 0, 9.96292),
        ("urad", "loop", 0, 2055.0),  # D/4 = 2.055 m a radian
        ("rad", "loop", 0, 2.055e9),
        ("um^2/Hz", "spectrum", 2, 1e6),
        ("mas2/hz", "spectrum", 2, 9.96292**2),
        ("mas_rthz", "spectrum", 1, 9.96292),
        ("um / √Hz", "spectrum", 1, 1e3),
    ],
)
def test_units_of_wavefront(unit, kind, power, factor):
    parsed = nm_unit(unit, diameter_m=8.22, kind=kind)
    assert (parsed.power, parsed.factor) == (power, pytest.approx(factor, rel=1e-5))
    if "m" not in unit.lower().replace("mas", ""):
        with pytest.raises(ProblemError, match="give diameter_m"):
            nm_unit(unit, kind=kind)


def test_what_is_no_unit_of_a_series():
    for unit in ("volt", "s", "nm2", "nm^2/Hz", "", 5):
        with pytest.raises(ProblemError, match="unit must be one of nm, um, m of wavefront, or m"):
            nm_unit(unit, diameter_m=8.22)


def test_units_of_clocks():
    for unit, factor in ((None, 1.0), ("ms", 1e-3), ("us", 1e-6), ("d", 86_400.0)):
        assert clock_factor(unit, "s") == factor
    for unit, factor in ((None, 1.0), ("mHz", 1e-3), ("MHz", 1e6), ("khz", 1e3), ("HZ", 1.0)):
        assert clock_factor(unit, "Hz") == factor
    for unit, base in (("mhz", "Hz"), ("Hz", "s"), ("nm", "s")):
        with pytest.raises(ProblemError, match=f"must be in one of .*; got '{unit}'"):
            clock_factor(unit, base)
