"""Configuration files: YAML with units in the keys, checked against a schema."""

from lbt_synth.config.load import Config, load_config
from lbt_synth.config.robust import robust_design

__all__ = ["Config", "load_config", "robust_design"]
