"""
Your own H-infinity problem
===========================

The estimators know no telescope. Here they follow a target that moves with almost constant
velocity, from a noisy position.
"""

import matplotlib.pyplot as plt
import numpy as np

import lbt_synth as lbt

# %%
# ``x+ = A x + B w``, ``y = C x + D w``, and the filter estimates ``z = L x``. The states are the
# position and the velocity, and ``z`` is the velocity.

dt_s = 0.1
problem = lbt.EstimationProblem(
    A=[[1, dt_s], [0, 0.99]],
    B=[[0, 0], [0.2, 0]],
    C=[[1, 0]],
    D=[[0, 0.5]],
    L=[[0, 1]],
    dt_s=dt_s,
)
problem

# %%
# The Kalman filter has the least rms error if ``w`` is white. The H-infinity filter bounds the
# error for every ``w`` of finite energy. Nothing below the least norm is possible, and a
# disturbance that no measurement shows proves it.

kalman, hinf = lbt.kalman(problem), lbt.hinf(problem, gamma_ratio=1.02)
print(f"Kalman      rms {kalman.rms:.4f}, norm {kalman.gamma:.4f}")
print(f"H-infinity  rms {hinf.rms:.4f}, norm {hinf.gamma:.4f}")
print(f"the least norm lies between {hinf.gamma_infeasible:.6f} and {hinf.gamma_least:.6f}")
print(hinf.certificate)

# %%
# Everything in between: the least rms at each norm.

points = list(lbt.studies.tradeoff(problem, points=7))
figure, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for family in ("mixed", "central"):
    own = [point for point in points if point.family == family]
    axes[0].plot([point.gamma for point in own], [point.rms for point in own], "o-", label=family)
axes[0].set(xlabel="H-infinity norm", ylabel="rms error", title="rms against norm")
axes[0].legend()

frequency_hz = np.geomspace(0.01, 4.99, 300)
for name, design in {"Kalman": kalman, "H-infinity": hinf}.items():
    sigma = np.linalg.norm(design.error_system().frequency_response(frequency_hz), 2, axis=(1, 2))
    axes[1].loglog(frequency_hz, sigma, label=name)
axes[1].set(xlabel="frequency [Hz]", ylabel="largest singular value", title="disturbance to error")
axes[1].legend()
