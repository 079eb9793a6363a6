from .load import Config as Config
from .load import load_config as load_config
from .load import telescope_template as telescope_template
