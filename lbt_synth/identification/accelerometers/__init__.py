"""Accelerometers beside the wavefront sensor: which channel sees which line, how, and when."""
