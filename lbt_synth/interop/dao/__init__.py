"""Export of a controller as the matrix of Durham's dao real-time computers."""
