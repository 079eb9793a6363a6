"""Loops of several sensors: closed exactly, their residual, and runs in which sensors fail."""
