"""Plants: the estimation problems that filters are designed for."""
