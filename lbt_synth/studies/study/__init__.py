"""The command study: samples of a configuration on many processes, and their statistics."""
