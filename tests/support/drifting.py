"""A vibration that drifts, and configurations with one."""

from ruamel.yaml import YAML
from support.configs import change_key, write_config

import lbt_synth as lbt


def drifting(**changes):
    given = {"frequency_hz": 17, "end_hz": 23, "duration_s": 10, "rms_nm": 100, "direction": (1,)}
    return lbt.models.SinusoidalVibration(**(given | changes))


def drift_file(tmp_path, keys="kind: drift\n      end_hz: 23\n      duration_s: 60"):
    """examples/lbt.yaml with another true vibration."""
    other = YAML(typ="safe").load(keys.replace("      ", ""))
    line = {"axis": "tip", "frequency_hz": 17, "rms_nm": 797, **other}
    settings = change_key(("truth", "vibrations"), [line])
    settings["simulation"] = {"frames": 2000, "cases": 1, "settle_frames": 500}
    return write_config(tmp_path, settings)
