"""Loops whose two axes have different turbulence and noise."""

import lbt_synth as lbt

RATE = 800.0
LOOPS = (lbt.LoopHardware(frame_rate_hz=RATE), lbt.LoopHardware(frame_rate_hz=RATE, modes=1))
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=60.0, frame_rate_hz=RATE)
QUICK = lbt.models.ARModel(coefficients=[1.6, -0.65], driving_rms_nm=25.0, frame_rate_hz=RATE)
TABLE = lbt.models.TabulatedSpectrum(frequency_hz=[1, 20, 120], density_nm2_hz=[900, 400, 3])
