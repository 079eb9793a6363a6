"""Records of a loop from files, telemetry and arrays."""
