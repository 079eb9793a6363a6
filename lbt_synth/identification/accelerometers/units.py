"""Units of accelerations."""

M_S2 = {"m/s2": 1.0, "mm/s2": 1e-3, "um/s2": 1e-6, "g": 9.80665, "mg": 9.80665e-3}
