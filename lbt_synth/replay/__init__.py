"""Prediction against data: what controllers would have left of a recorded disturbance."""

from lbt_synth.replay.estimate import ResidualEstimate
from lbt_synth.replay.predictor import LeastSquaresPredictor, least_squares_predictor
from lbt_synth.replay.residual import replayed_residual
from lbt_synth.replay.rows import PredictionRow, PredictionTable
from lbt_synth.replay.stretches import split_halves
from lbt_synth.replay.table import prediction_against_data

__all__ = [
    "LeastSquaresPredictor",
    "PredictionRow",
    "PredictionTable",
    "ResidualEstimate",
    "least_squares_predictor",
    "prediction_against_data",
    "replayed_residual",
    "split_halves",
]
