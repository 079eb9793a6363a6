"""
Hundreds of modes
=================

Every mode of an adaptive mirror may have its own filter. Here 672 have one, equal modes the same.
"""

import numpy as np
from matplotlib.figure import Figure

import lbt_synth as lbt

air = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
modes = lbt.models.modal_turbulence(air, modes=672, frame_rate_hz=800)
noise_nm = lbt.models.pyramid_modal_noise_nm(15.5, modes=672, modulation_lambda_over_d=4)

# %%
# The best integrator of each mode, and a Kalman filter of each mode.

path = lbt.LoopHardware(frame_rate_hz=800)
integrators = lbt.design.modal.modal_gains(modes, hardware=path, noise_nm=noise_nm)
filters = lbt.design.modal.modal_filters(modes, hardware=path, noise_nm=noise_nm)
print(f"{filters.n_modes} filters, {len(filters.designs)} different and certified")

# %%
# What they leave, mode by mode:

figure = Figure(layout="constrained")
axes = figure.subplots()
axes.set(xlabel="mode", ylabel="residual [nm rms]", xscale="log", yscale="log")
for name, rms_nm in {"integrators": integrators.rms_nm, "filters": filters.rms_nm}.items():
    axes.plot(np.arange(1, 673), rms_nm, label=f"{name}: {np.linalg.norm(rms_nm):.1f} nm rms")
axes.legend()
