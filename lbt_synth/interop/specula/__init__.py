"""The end-to-end simulation on optics simulated by SPECULA (an optional extra)."""
