"""Monte Carlo studies: samples of a configuration, run in parallel, and their statistics."""
