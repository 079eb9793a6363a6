"""From a record to a model of turbulence, vibrations, noise and sensor."""
