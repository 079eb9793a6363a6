"""Configuration files: YAML with units in the keys, checked against a schema."""

from lbt_synth.config.identified import identified_config
from lbt_synth.config.load import Config, load_config
from lbt_synth.config.robust import robust_design
from lbt_synth.config.write import save_config

__all__ = ["Config", "identified_config", "load_config", "robust_design", "save_config"]
