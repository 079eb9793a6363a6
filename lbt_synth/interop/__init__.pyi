from .pipeline import export as export
from .specula.simulation import run_end_to_end as run_end_to_end
