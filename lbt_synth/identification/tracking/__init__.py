"""Tracking: identification and redesign while the loop runs."""
