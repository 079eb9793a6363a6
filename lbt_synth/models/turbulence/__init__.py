"""Turbulence: its spectra, and auto-regressive models of it."""
