"""Export of a controller as C99 source."""
