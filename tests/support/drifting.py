"""A vibration that drifts, and configurations with one."""

from ruamel.yaml import YAML
from support.plants import LBT_YAML

import lbt_synth as lbt


def drifting(**changes):
    given = {"frequency_hz": 17, "end_hz": 23, "duration_s": 10, "rms_nm": 100, "direction": (1,)}
    return lbt.models.SinusoidalVibration(**(given | changes))


def drift_file(tmp_path, keys="kind: drift\n      end_hz: 23\n      duration_s: 60"):
    """examples/lbt.yaml with another true vibration."""
    yaml = YAML()
    settings = yaml.load(LBT_YAML.read_text())
    entry = f"a:\n    - axis: tip\n      frequency_hz: 17\n      rms_nm: 797\n      {keys}\n"
    settings["truth"]["vibrations"] = yaml.load(entry)["a"]
    settings["simulation"] = {"frames": 2000, "cases": 1, "settle_frames": 500}
    path = tmp_path / "drift.yaml"
    with path.open("w") as file:
        yaml.dump(settings, file)
    return path
