from .load import Config as Config
from .load import load_config as load_config
from .load import telescope_template as telescope_template
from .write import identified_config as identified_config
from .write import save_config as save_config
