"""The whole adaptive-optics system, on optics simulated by SPECULA (an optional extra)."""
