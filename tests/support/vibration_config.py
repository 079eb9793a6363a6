"""The configuration of the LBT with another vibration."""

import copy

from ruamel.yaml import YAML
from support.plants import LBT_YAML

GOOD = YAML(typ="safe", pure=True).load(LBT_YAML.read_text())


def write_vibration(tmp_path, **vibration):
    """Write the configuration with changed keys of its first vibration; return its path."""
    content = copy.deepcopy(GOOD)
    content["model"]["vibrations"][0] |= vibration
    path = tmp_path / "c.yaml"
    with path.open("w") as stream:
        YAML(typ="safe", pure=True).dump(content, stream)
    return path
