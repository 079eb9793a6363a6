"""Export of a controller as a MATLAB file."""
