"""
The LBT paper in thirty lines
=============================

Agapito et al. (2008) ask what a tip/tilt loop of the Large Binocular Telescope gains from a filter
that knows a 20 Hz vibration, and what it loses when it knows the wrong frequency.
"""

import numpy as np
from matplotlib.figure import Figure

import lbt_synth as lbt

# %%
# The loop runs at 800 Hz with two frames of delay. A pyramid sensor sees a faint star, and the
# telescope shakes by 80 mas.

air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
rms_nm = 80 * lbt.models.nm_per_mas(8.22)
lines = [
    lbt.Vibration(frequency_hz=20, damping=0.0051, rms_nm=rms_nm, direction=axis)
    for axis in ((1, 0), (0, 1))
]
plant = lbt.tip_tilt_plant(
    frame_rate_hz=800,
    delay_frames=2,
    turbulence=lbt.models.ar1_turbulence(air, frame_rate_hz=800),
    vibrations=lines,
    noise_nm=15.6,
)
plant

# %%
# The truth is not the model: frozen flow instead of an AR process, and a pure sinusoid.

shake = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=rms_nm)
truth = lbt.Truth(turbulence=air, vibrations=(shake,), noise_nm=15.6)
camera = lbt.Imaging(diameter_m=8.22, obstruction=0.11, wavelength_um=2.2, other_modes=0.845)

# %%
# Three controllers. Each comes with a certificate, or not at all.

designs = {
    "integrator": lbt.integrator(plant.hardware, gain=0.5),
    "Kalman": lbt.kalman(plant),
    "H-infinity": lbt.hinf(plant, gamma_ratio=1.2),
}
for name, design in designs.items():
    budget = lbt.residual_budget(lbt.close_loop(plant.hardware, design), truth)
    print(f"{name:10}  {budget.rms_nm:6.1f} nm rms, Strehl {lbt.strehl(budget, camera):.1%}")

# %%
# Printed, a design says what it is.

print(designs["H-infinity"])

# %%
# Now the filters believe in a wrong frequency. Within 1 Hz little is lost; further away the
# H-infinity filter is the more tolerant one.

rows = list(lbt.studies.robustness(plant, truth, camera, errors_hz=np.linspace(-3.5, 3.5, 15)))
figure = Figure(layout="constrained")
axes = figure.subplots()
axes.set(xlabel="true frequency less that of the model [Hz]", ylabel="Strehl ratio")
for method in ("kalman", "hinf"):
    points = [(row.error_hz, row.strehl) for row in rows if row.method == method]
    axes.plot(*np.transpose(points), "o-", label=method)
axes.legend()
