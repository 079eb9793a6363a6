"""The fit of turbulence, vibrations, noise and sensor gain to a record."""
