"""Columns of a file: what each is by its name, of which axis, in which unit."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.models import nm_per_mas
from lbt_synth.validation import FloatArray, choice

_NM = {"nm": 1.0, "um": 1e3, "m": 1e9}
_MAS = {
    "mas": 1.0,
    "arcsec": 1e3,
    "urad": math.degrees(1e-6) * 3600e3,
    "rad": math.degrees(1.0) * 3600e3,
}
UNITS = (*_NM, *_MAS)
_ALIASES = {
    **dict.fromkeys(("nanometer", "nanometre"), "nm"),
    **dict.fromkeys(("micron", "micrometer", "micrometre", "µm", "μm"), "um"),
    **dict.fromkeys(("meter", "metre"), "m"),
    **dict.fromkeys(("µrad", "μrad", "microrad"), "urad"),
    **dict.fromkeys(("arcsecond", "asec", '"'), "arcsec"),
    **dict.fromkeys(("milliarcsec", "milliarcsecond"), "mas"),
    "radian": "rad",
}
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_HERTZ = {"hz": 1.0, "khz": 1e3, "mHz": 1e-3, "MHz": 1e6}  # capitals matter where both exist
_CLOCK_UNITS = {*_SECONDS, *(word.lower() for word in _HERTZ)}
_BRACKETS = re.compile(r"(?P<name>[^\[(]*?)\s*[\[(](?P<unit>.*)[\])]")
_SQUARED = re.compile(r"^(?P<unit>.+?)(?:\^2|\*\*2|²|2)\s*(?:/|_|\s|per)\s*hz$", re.IGNORECASE)
_ROOT = re.compile(
    r"^(?P<unit>.+?)\s*(?:/|_|per)\s*(?:sqrt\(?hz\)?|rthz|√hz|hz\^?(?:0\.5|\(1/2\)))$",
    re.IGNORECASE,
)


def unit_name(text: str) -> str | None:
    """Return the name that this package has for a unit, None for an unknown one."""
    lower = text.strip().lower()
    unit = _ALIASES.get(lower) or _ALIASES.get(lower.removesuffix("s")) or lower
    return unit if unit in UNITS else None


def is_angle(text: str) -> bool:
    """Whether a text is a unit of tilt, which becomes a wavefront by the telescope."""
    return unit_name(text) in _MAS


def density_unit(text: str) -> tuple[str, int] | None:
    """Split the unit of a spectrum into a unit and its power, 1 or 2; None for others."""
    word = text.strip()
    for pattern, power in ((_ROOT, 1), (_SQUARED, 2)):
        if match := pattern.match(word):
            unit = unit_name(match["unit"])
            return None if unit is None else (unit, power)
    return None


def is_unit(text: str) -> bool:
    """Whether a text is a unit of a series, a spectrum, times or frequencies."""
    return bool(unit_name(text) or density_unit(text)) or text.lower() in _CLOCK_UNITS


def same_unit(one: str, other: str) -> bool:
    """Whether two texts are the same unit."""
    return len({unit_name(u) or density_unit(u) or u.lower() for u in map(str, (one, other))}) == 1


VOLTS = {
    "in_python": "For volts or counts say nm, and give repair_commands the nm of one as the scale.",
    "at_terminal": "For volts or counts say nm, and give the nm of one by --command-scale.",
}


def nm_per(unit: str, *, diameter_m: float | None = None, name: str = "unit") -> float:
    """Return the nanometres of wavefront, rms over the pupil, of one unit."""
    advice = VOLTS if name == "command_unit" else {}
    word = (unit_name(unit) if isinstance(unit, str) else None) or unit
    word = choice(word, name, UNITS, **advice)
    if word in _NM:
        return _NM[word]
    if diameter_m is None:
        raise ProblemError(
            f"angles of tilt ({word}) become nm of wavefront by the telescope's diameter; give "
            "diameter_m."
        )
    return _MAS[word] * nm_per_mas(diameter_m)


def seconds_per(unit: str | None) -> float:
    """Return the seconds of a unit of time, 1 if no unit is given."""
    factor = _SECONDS.get((unit or "s").strip().lower())
    if factor is None:
        raise ProblemError(f"times must be in one of {', '.join(_SECONDS)}; got {unit!r}.")
    return factor


def hz_per(unit: str | None) -> float:
    """Return the hertz of a unit of frequency, 1 if no unit is given."""
    word = (unit or "Hz").strip()
    factor = _HERTZ.get(word) or _HERTZ.get(word.lower())
    if factor is None:
        raise ProblemError(f"frequencies must be in one of Hz, kHz, mHz, MHz; got {unit!r}.")
    return factor


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
    "density": (
        "psd psds density power power_density spectrum spectra asd amplitude_density "
        "amplitude_spectrum"
    ),
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
    plain, named_unit = _split_unit(name.strip())
    given = (unit or "").strip()
    if given and named_unit and not same_unit(given, named_unit):
        raise TelemetryError(f"{name} has the unit {given!r} in the header: which is right?")
    role, axis = _COLUMN_NAMES.get(_normalise(plain), (None, None))
    return Column(name=name, values=values, role=role, axis=axis, unit=given or named_unit)


def recognise_fact(key: str) -> str | None:
    """Return the fact that a header's keyword or a number's name stands for."""
    return _FACT_NAMES.get(_normalise(key))


def _normalise(name: str) -> str:
    return re.sub(r"[\s\-.]+", "_", name.strip().lower()).strip("_")


def _split_unit(name: str) -> tuple[str, str | None]:
    """Split a name and its unit, in brackets or after an underscore."""
    if match := _BRACKETS.fullmatch(name):
        return match["name"], match["unit"].strip() or None
    ends = (at for at, sign in enumerate(name) if sign == "_" and at)
    end = next((at for at in ends if is_unit(name[at + 1 :])), None)
    return (name, None) if end is None else (name[:end], name[end + 1 :])
