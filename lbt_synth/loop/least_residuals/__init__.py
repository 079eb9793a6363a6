"""The least residual of any linear controller, by spectral factorisation.

Nothing here knows of designs, Riccati equations or loops: it is a second opinion on them.
"""
