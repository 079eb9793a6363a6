"""Configurations that tests change, and write to files."""

import copy
import re
from functools import reduce
from operator import getitem

from ruamel.yaml import YAML
from support.plants import LBT_YAML

GOOD = YAML(typ="safe", pure=True).load(LBT_YAML.read_text())


def write_config(tmp_path, content):
    path = tmp_path / "c.yaml"
    if isinstance(content, str):
        path.write_text(content)
    else:
        with path.open("w") as stream:
            YAML(typ="safe", pure=True).dump(content, stream)
    return path


def with_errors(text, *errors_hz):
    return re.sub(r"errors_hz: .*", f"errors_hz: {list(errors_hz)}", text)


def change_key(path, value):
    """A copy of the good file with one key set (or taken away, with ``...``)."""
    out, (*steps, last) = copy.deepcopy(GOOD), path
    section = reduce(getitem, steps, out)
    section[last] = value
    if value is ...:
        del section[last]
    return out


def numbers_of(section, path=""):
    """Yield the path and the value of each number of a section."""
    if isinstance(section, dict):
        for key, value in section.items():
            yield from numbers_of(value, f"{path}.{key}" if path else key)
    elif isinstance(section, list):
        for i, value in enumerate(section):
            yield from numbers_of(value, f"{path}[{i}]")
    elif isinstance(section, int | float):
        yield path, section


AR = {"kind": "ar", "coefficients": [0.99], "driving_rms_nm": 40.0}
OTHER = {"kind": "ar", "coefficients": [1.6, -0.65], "driving_rms_nm": 25.0}
SMALL = {
    "version": 1,
    "sensor": {"noise_nm": 15.5},
    "loop": {"frame_rate_hz": 800.0},
    "model": {
        "turbulence": AR,
        "vibrations": [{"axis": "tip", "frequency_hz": 20.0, "damping": 0.01, "rms_nm": 300.0}],
    },
}


def minimal_config(**sections):
    """The smallest configuration, some of its sections with other keys."""
    out = copy.deepcopy(SMALL)
    for name, keys in sections.items():
        out[name] = {**out.get(name, {}), **keys}
    return out
