"""Many loops at once, exactly."""

from lbt_synth.ensemble.cases import EnsembleVibration, LoopEnsemble
from lbt_synth.ensemble.residuals import ensemble_residuals
from lbt_synth.ensemble.result import EnsembleResiduals

__all__ = ["EnsembleResiduals", "EnsembleVibration", "LoopEnsemble", "ensemble_residuals"]
