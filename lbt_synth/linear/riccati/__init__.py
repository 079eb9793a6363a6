"""Discrete algebraic Riccati equations, including those of Kalman and H-infinity filters."""
