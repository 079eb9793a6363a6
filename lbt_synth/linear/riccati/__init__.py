"""Discrete algebraic Riccati equations, those of filtering and of H-infinity included."""
