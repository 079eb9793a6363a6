"""
Sigma plots: where a controller rejects, and what it costs
==========================================================

The largest singular value of each closed-loop transfer, over frequency. The filter that knows a
line digs a notch into the rejection, and every notch is paid for elsewhere.
"""

import matplotlib.pyplot as plt
import numpy as np

import lbt_synth as lbt

slow = lbt.models.ARModel(coefficients=[1.9975, -0.99755], driving_rms_nm=2.0, frame_rate_hz=800)
lines = [lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=60, direction=(1,)) for f in (20, 47)]
plant = lbt.tip_tilt_plant(
    frame_rate_hz=800, turbulence=slow, vibrations=lines, noise_nm=12, modes=1
)
designs = {
    "integrator": lbt.integrator(plant.hardware, gain=0.4),
    "Kalman": lbt.kalman(plant),
    "H-infinity": lbt.hinf(plant, gamma_ratio=1.1),
}
figure = lbt.report.figures.loop_figure(designs, "sigma")

# %%
# The numbers behind the picture are those of any linear system. Here the rejection of the Kalman
# loop, on your own axes, while the sensor gain falls.

frequency_hz = np.geomspace(0.5, 399, 500)
figure, axes = plt.subplots(layout="constrained")
for gain in (1.0, 0.7, 0.4):
    loop = lbt.close_loop(plant.hardware, designs["Kalman"], sensor_gain=gain)
    sigma = np.linalg.norm(
        loop.path("phase", "residual").frequency_response(frequency_hz), 2, axis=(1, 2)
    )
    axes.loglog(frequency_hz, sigma, label=f"sensor gain {gain}")
axes.axhline(1, color="0.6", linewidth=0.8)
axes.set(xlabel="frequency [Hz]", ylabel="rejection", title="A Kalman filter at other sensor gains")
axes.legend()

# %%
# The margins of the same loops:

for name, design in designs.items():
    margins = lbt.loop_margins(lbt.close_loop(plant.hardware, design))
    print(f"{name:10}  modulus {margins.modulus:.2f}, phase {margins.phase_deg:.0f} deg")
