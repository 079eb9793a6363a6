"""
Export a controller to C
========================

A real-time computer runs a controller as C without a library, in single precision if it has to.
The export rehearses the loop first and says what the rounding costs.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import lbt_synth as lbt

slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=100, direction=(1,))
plant = lbt.tip_tilt_plant(
    frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=20, modes=1
)
design = lbt.kalman(plant)

folder = Path(tempfile.mkdtemp())
exported = lbt.interop.export(folder / "tip.c", design, "c", precision="single")
print(f"the commands differ by at most {exported.error:.1e} of the largest one")

# %%
# The function that the real-time computer calls each frame:

print((folder / "tip.h").read_text())

# %%
# The gain file is what other programs read, and what ``lbt-synth verify`` certifies again.

gain = lbt.save_gain(folder / "tip.fits", design)
again = lbt.load_gain(gain)
print(again.certificate)

# %%
# The controller from the file answers a step of the measurement as the first one does.

figure, axes = plt.subplots(layout="constrained")
for name, one, style in (("designed", design, "-"), ("from the file", again, "--")):
    running = one.controller.start()
    commands = [running.step([100.0])[0] for _ in range(60)]
    axes.plot(np.arange(60) / 0.8, commands, style, label=name)
axes.set(xlabel="time [ms]", ylabel="command [nm]", title="Answer to a step of 100 nm, loop open")
axes.legend()
