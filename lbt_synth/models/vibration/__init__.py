"""Vibrations: one module for each kind."""
