"""A controller as a MATLAB file."""
