"""Prediction against data: what controllers would have left of a recorded disturbance."""
