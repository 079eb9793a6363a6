"""Plants: turbulence, vibrations and mirror as estimation problems for filter design."""
