"""Predictions: the residual that controllers would have left of a recorded disturbance."""
