from .gain_file.store import load_gain as load_gain
from .gain_file.store import save_gain as save_gain
from .telemetry.store import load_telemetry as load_telemetry
from .telemetry.store import save_telemetry as save_telemetry
from .telemetry.store import telemetry_from_simulation as telemetry_from_simulation
from .telemetry.telemetry import Telemetry as Telemetry
