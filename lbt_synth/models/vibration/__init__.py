"""Vibrations, with one module for each kind."""
