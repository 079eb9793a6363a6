"""Columns of a file: what each is by its name, of which axis, in which unit."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.models import nm_per_mas
from lbt_synth.storage.display_unit import UNITS as SHOWN
from lbt_synth.validation import FloatArray

UNITS = {
    "loop": "nm, um, m of wavefront, or mas, arcsec, urad, rad of tilt",
    "spectrum": "nm^2/Hz, or mas^2/Hz of tilt; nm/sqrt(Hz) of an amplitude",
    "s": "s, ms, us, ns",
    "Hz": "Hz, kHz, mHz, MHz",
}
VOLTS = {
    "in_python": "Multiply volts or counts by the nm of one, and say nm.",
    "at_terminal": "For volts or counts say nm, and give the nm of one by --command-scale.",
}
_BRACKETS = re.compile(r"(?P<name>[^\[(]*?)\s*[\[(](?P<unit>.*)[\])]")
_LENGTH = r"(?:[num]?m|mas|arcsec|u?rad)"
_TAIL = re.compile(  # of a name, after an underscore: a unit of a series, a spectrum or a clock
    rf"(?P<name>.+?)_(?P<unit>{_LENGTH}(?:(?:\^|\*\*)?[2²]?[_/](?:rt)?hz)?|[num]?s|k?hz)",
    re.IGNORECASE,
)
_PER_HERTZ = re.compile(r"\s*(?:/|_|\bper\b)\s*(rt|√|sqrt\()?hz\)?$", re.IGNORECASE)
_HERTZ = re.compile(r"(?<!m)hz$", re.IGNORECASE)  # capitals matter where mHz and MHz exist
_BASES = [("s", 0), ("Hz", 0), *((base, power) for power in range(3) for base in ("nm", "mas"))]


class Unit(NamedTuple):
    """What a text means as a unit."""

    base: str  # nm, mas, s or Hz
    power: int  # of the base over the root of Hz in a density; 0 of a series
    factor: float  # of the base in one unit


def parse_unit(text: str) -> Unit | None:
    """Return the unit of a series, a spectrum, times or frequencies; None of another text."""
    from astropy import units

    for word in (text.strip(), text.strip().lower(), text.strip().lower().removesuffix("s")):
        word = _PER_HERTZ.sub(lambda match: "/sqrt(Hz)" if match[1] else "/Hz", word)
        try:
            unit = units.Unit(_HERTZ.sub("Hz", word))
        except (ValueError, TypeError):
            continue
        for base, power in _BASES:
            plain = (units.Unit(base) / units.Hz**0.5) ** power if power else units.Unit(base)
            if unit.is_equivalent(plain):  # astropy rounds to 15 digits
                return Unit(base, power, float(f"{unit.to(plain):.14g}"))
    return None


def same_unit(one: str, other: str) -> bool:
    """Return whether two texts are the same unit."""
    return len({parse_unit(word) or word.lower() for word in (one, other)}) == 1


def nm_unit(
    text: str, *, diameter_m: float | None = None, name: str = "unit", kind: str = "loop"
) -> Unit:
    """Return the unit of a series, or of a spectrum, in nm of wavefront, rms over the pupil."""
    unit = parse_unit(text) if isinstance(text, str) else None
    if unit is None or unit.base not in ("nm", "mas") or (unit.power > 0) != (kind == "spectrum"):
        advice = VOLTS if name == "command_unit" else {}
        raise ProblemError(f"{name} must be one of {UNITS[kind]}; got {text!r}.", **advice)
    if unit.base == "nm":
        return unit
    if diameter_m is None:
        raise ProblemError(
            f"angles of tilt ({text}) become nm of wavefront by the telescope's diameter; give "
            "diameter_m."
        )
    factor = unit.factor * nm_per_mas(diameter_m) ** max(unit.power, 1)
    return unit._replace(base="nm", factor=factor)


def unit_to_show(text: str) -> str:
    """Return the unit in which people see what is measured in a unit, or in its powers."""
    word, unit = text.strip().lower(), parse_unit(text)
    return word if word in SHOWN or unit is None else unit.base


def clock_factor(text: str | None, base: str) -> float:
    """Return the s or the Hz in a unit, 1 if none is given."""
    unit = parse_unit(text or base)
    if unit is None or unit.base != base:
        what = "times" if base == "s" else "frequencies"
        raise ProblemError(f"{what} must be in one of {UNITS[base]}; got {text!r}.")
    return unit.factor


# Names by which columns and numbers are recognised, separated by blanks.
ROLES = {
    "measurements": (
        "y meas measure measured measurement measurements residual residuals res slope "
        "slopes error errors tip_tilt tiptilt tt"
    ),
    "open_loop": "pol pseudo_open_loop pseudoopenloop open_loop openloop disturbance disturbances",
    "commands": "u cmd cmds command commands comm comms ittm_positions",
    "times": "t time times timestamp timestamps time_stamp seconds",
    "frame_numbers": (
        "frame frames frame_number frame_numbers framenumber frame_no frameno frame_counter "
        "framecounter frame_id counter count index"
    ),
    "frequency": "f freq freqs frequency frequencies",
    "density": (
        "psd psds density power power_density spectrum spectra asd amplitude_density "
        "amplitude_spectrum"
    ),
}
FACTS = {
    "frame_rate_hz": (
        "frame_rate_hz frame_rate framerate framrate framerat rate_hz fps loop_rate "
        "looprate loop_freq loopfreq sampling_hz sampling_rate sampling_frequency fs "
        "eso_aos_loop_rate"
    ),
    "delay_frames": "delay_frames delayfrm delay_fr loop_delay_frames",
    "diameter_m": "diameter_m diameter telescope_diameter teldiam tel_diam",
    "obstruction": "obstruction obstruct",
    "averages": "averages navg n_averages",
    "unit": "unit units bunit",
}
OF_AXES = ("measurements", "open_loop", "commands", "density")
_AXES = {"0": 0, "1": 1, "2": 2, "tip": 0, "tilt": 1, "x": 0, "y": 1}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Column:
    """One series of a file."""

    name: str  # as the file has it
    values: FloatArray  # (frames,)
    role: str | None = None  # what it is by its name, a key of ROLES
    axis: int | None = None  # as the name counts axes
    unit: str | None = None


def _list_names() -> dict[str, tuple[str, int | None]]:
    """List each name of a column with its role and axis: y, y_tip, ytip and tip_y."""
    names: dict[str, tuple[str, int | None]] = {
        name: (role, None) for role, words in ROLES.items() for name in words.split()
    }
    for name, (role, _) in list(names.items()):
        for word, axis in _AXES.items() if role in OF_AXES else ():
            for form in (f"{name}_{word}", f"{name}{word}", f"{word}_{name}"):
                names.setdefault(form, (role, axis))
    return names | {word: ("measurements", _AXES[word]) for word in ("tip", "tilt", "x")}


_COLUMN_NAMES = _list_names()
_FACT_NAMES = {name: fact for fact, names in FACTS.items() for name in names.split()}


def parse_column(name: str, values: FloatArray, *, unit: str | None = None) -> Column:
    """Make a column; its name tells its role, its axis, and its unit (in brackets or after _)."""
    match = _BRACKETS.fullmatch(name.strip()) or _TAIL.fullmatch(name.strip())
    plain, named_unit = (match["name"], match["unit"].strip()) if match else (name, "")
    stated = (unit or "").strip()
    if stated and named_unit and not same_unit(stated, named_unit):
        raise TelemetryError(f"{name} has the unit {stated!r} in the header: which is right?")
    role, axis = _COLUMN_NAMES.get(_normalise(plain), (None, None))
    return Column(name=name, values=values, role=role, axis=axis, unit=stated or named_unit or None)


def recognise_fact(key: str) -> str | None:
    """Return the fact that a header's keyword or a number's name stands for."""
    return _FACT_NAMES.get(_normalise(key))


def _normalise(name: str) -> str:
    return re.sub(r"[\s\-.]+", "_", name.strip().lower()).strip("_")
