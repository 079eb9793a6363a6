"""Filters that follow vibrations, and filters exchanged in a running loop."""
