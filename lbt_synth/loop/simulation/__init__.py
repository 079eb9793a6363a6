"""The closed loop in the time domain."""
