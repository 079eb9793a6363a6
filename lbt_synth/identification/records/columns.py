"""Columns of a file: what each is by its name, of which axis, in which unit."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.errors import TelemetryError
from lbt_synth.identification.records.units import FREQUENCIES, TIMES, density_unit, unit_name
from lbt_synth.validation import FloatArray

# Names by which columns and numbers are recognised, separated by blanks.
ROLES = {
    "measurements": (
        "y meas measure measured measurement measurements residual residuals res slope "
        "slopes error errors tip_tilt tiptilt tt"
    ),
    "open_loop": "pol pseudo_open_loop pseudoopenloop open_loop openloop disturbance disturbances",
    "commands": "u cmd cmds command commands comm comms",
    "times": "t time times timestamp timestamps time_stamp seconds",
    "frame_numbers": (
        "frame frames frame_number frame_numbers framenumber frame_no frameno frame_counter "
        "framecounter frame_id counter count index"
    ),
    "frequency": "f freq freqs frequency frequencies",
    "density": "psd psds density power power_density spectrum spectra",
    "amplitude": "asd amplitude_density amplitude_spectrum",
}
FACTS = {
    "frame_rate_hz": (
        "frame_rate_hz frame_rate framerate framrate framerat rate_hz fps loop_rate "
        "looprate loop_freq loopfreq sampling_hz sampling_rate sampling_frequency fs"
    ),
    "delay_frames": "delay_frames delayfrm delay_fr loop_delay_frames",
    "diameter_m": "diameter_m diameter telescope_diameter teldiam tel_diam",
    "obstruction": "obstruction obstruct",
    "averages": "averages navg n_averages",
    "unit": "unit units bunit",
}
_BASES = {name: role for role, names in ROLES.items() for name in names.split()}
_OF_AXES = ("measurements", "open_loop", "commands", "density", "amplitude")
_CLOCK_ROWS = 8  # rows of noise all rise with a chance of 1 in 40 000
_AXES = {"0": 0, "1": 1, "2": 2, "tip": 0, "tilt": 1, "x": 0, "y": 1}
_WITH_AXIS = re.compile(r"^(?P<base>.*?)_?(?P<axis>0|1|2|tip|tilt|x|y)$")
_BRACKETS = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*(?:\([^)]*\))?[^\])]*)[\])]\s*$")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Column:
    """One series of a file."""

    name: str  # as the file has it
    values: FloatArray  # (frames,)
    role: str | None = None  # what it is by its name, a key of ROLES
    axis: int | None = None  # as the name counts axes
    unit: str | None = None


def parse_column(
    name: str, values: FloatArray, *, unit: str | None = None, axis: int | None = None
) -> Column:
    """Make a column; its name tells its role, its axis, and its unit (in brackets or after _)."""
    plain, named_unit = _split_unit(name.strip())
    given = (unit or "").strip()
    if given and named_unit and _unit_key(given) != _unit_key(named_unit):
        raise TelemetryError(f"{name} has the unit {given!r} in the header: which is right?")
    role, named_axis = _split_axis(re.sub(r"[\s\-.]+", "_", plain.lower()).strip("_"))
    return Column(
        name=name,
        values=values,
        role=role,
        axis=named_axis if axis is None else axis,
        unit=given or named_unit,
    )


def array_columns(name: str, values: FloatArray, *, unit: str | None = None) -> list[Column]:
    """Return the columns of an array (frames, n) of one name."""
    if values.shape[1] == 1:
        return [parse_column(name, values[:, 0], unit=unit)]
    base = parse_column(name, values[:, 0], unit=unit)
    return [
        replace(base, name=f"{name}[{i}]", values=values[:, i], axis=i)
        for i in range(values.shape[1])
    ]


def pair_x_and_y(columns: list[Column]) -> list[Column]:
    """Take columns x and y for two axes, unless x rises as a clock does."""
    plain = [_split_unit(each.name.strip())[0].lower() for each in columns]
    if plain.count("x") != 1 or plain.count("y") != 1:
        return columns
    x = columns[plain.index("x")].values
    if rises(x):
        return columns
    return [
        replace(each, role="measurements", axis=_AXES[name]) if name in ("x", "y") else each
        for name, each in zip(plain, columns, strict=True)
    ]


def rises(values: FloatArray) -> bool:
    """Whether a series rises from row to row, as clocks and frequencies do."""
    return len(values) >= _CLOCK_ROWS and bool(np.all(np.diff(values) > 0))


def _unit_key(unit: str) -> object:
    return unit_name(unit) or density_unit(unit) or unit.lower()


def _split_unit(name: str) -> tuple[str, str | None]:
    if match := _BRACKETS.match(name):
        return match["name"], match["unit"].strip() or None
    lower = name.lower()
    for at in [i for i, sign in enumerate(lower) if sign == "_"]:
        tail = lower[at + 1 :]
        known = unit_name(tail) or density_unit(tail) or tail in TIMES or tail in FREQUENCIES
        if known and at > 0:
            return name[:at], name[at + 1 :]
    return name, None


def _split_axis(name: str) -> tuple[str | None, int | None]:
    if role := _BASES.get(name):
        return role, None
    if name in ("tip", "tilt"):
        return "measurements", _AXES[name]
    base, axis = "", ""
    if match := _WITH_AXIS.match(name):
        base, axis = match["base"], match["axis"]
    elif name.startswith(("tip_", "tilt_", "x_", "y_")):  # tip_command
        axis, _, base = name.partition("_")
    role = _BASES.get(base)
    return (role, _AXES[axis]) if role in _OF_AXES else (None, None)


def recognise_fact(key: str) -> str | None:
    """Return the fact that a header's keyword or a number's name stands for."""
    word = re.sub(r"[\s\-.]+", "_", key.strip().lower())
    return next((fact for fact, names in FACTS.items() if word in names.split()), None)
