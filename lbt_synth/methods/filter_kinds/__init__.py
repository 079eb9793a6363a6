"""Filters of one sensor and of several: how each is described, recorded and rebuilt."""
