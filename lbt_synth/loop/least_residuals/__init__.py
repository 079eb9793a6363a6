"""The least residual of any linear controller, by spectral factorisation.

It uses no design, no Riccati equation and no closed loop, and so is an independent check of them.
"""
