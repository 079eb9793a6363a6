"""Filters of several sensors, and what becomes of their loops when a sensor fails."""
