from .identified_system import identified_config as identified_config
from .load import Config as Config
from .load import load_config as load_config
from .write import save_config as save_config
