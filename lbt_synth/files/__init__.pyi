from .gain_file.store import load_gain as load_gain
from .gain_file.store import save_gain as save_gain
from .telemetry.from_simulation import telemetry_of as telemetry_of
from .telemetry.record import Telemetry as Telemetry
from .telemetry.store import load_telemetry as load_telemetry
from .telemetry.store import save_telemetry as save_telemetry
