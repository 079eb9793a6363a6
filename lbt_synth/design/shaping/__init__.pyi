from .demands import Bound as Bound
from .demands import CommandRms as CommandRms
from .demands import LoopErrors as LoopErrors
from .specification import Specification as Specification
from .terms import ResidualVariance as ResidualVariance
from .terms import VibrationBand as VibrationBand
