"""Exact residuals of many loops at once."""
