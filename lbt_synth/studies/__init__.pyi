from .nights import design_from_nights as design_from_nights
from .robustness import robustness as robustness
from .robustness import robustness_map as robustness_map
from .robustness import tradeoff as tradeoff
from .study.run import run_study as run_study
from .study.study import load_study as load_study
