"""A controller as C99 source."""
