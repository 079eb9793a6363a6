"""
A tip/tilt mirror with its resonance
====================================

The loop of a mirror that rings, as a problem of mixed sensitivity: how fast can it be?
"""

import warnings

import control
import matplotlib.pyplot as plt
import numpy as np
import scipy.signal

import lbt_synth as lbt

warnings.filterwarnings("ignore", "connect", FutureWarning)  # python-control's own, in augw

# %%
# The mirror resonates at 180 Hz with a damping of 2 %. Commands are held for a frame of 1 ms, and
# the measurement comes one frame later.

dt_s, omega, damping = 1e-3, 2 * np.pi * 180.0, 0.02
ringing = scipy.signal.tf2ss([omega**2], [1, 2 * damping * omega, omega**2])
A, B, C, D, _ = scipy.signal.cont2discrete(ringing, dt_s)
mirror = lbt.linear.StateSpace(
    A=np.block([[A, np.zeros((2, 1))], [C, np.zeros((1, 1))]]),
    B=np.vstack([B, D]),
    C=[[0.0, 0.0, 1.0]],
    D=[[0.0]],
    dt_s=dt_s,
)

# %%
# The sensitivity should be small at low frequencies and nowhere above 2; commands should stay
# moderate. ``W1`` and a constant ``W2`` say so. The larger the corner of ``W1``, the faster the
# loop, until the least gamma exceeds one. Then no controller meets the weights: that is proved.


def weight(corner_hz):
    """Return ``(s / 2 + w) / (s + 0.001 w)`` by the bilinear map, which keeps its norm."""
    w = 2 * np.pi * corner_hz
    continuous = scipy.signal.tf2ss([0.5, w], [1.0, 1e-3 * w])
    A, B, C, D, _ = scipy.signal.cont2discrete(continuous, dt_s, method="bilinear")
    return control.ss(A, B, C, D, dt_s)


def weighted_plant(corner_hz):
    """Return the plant from disturbance and command to weighted error, weighted command, error."""
    static = control.ss([], [], [], 0.3, dt_s)
    system = control.augw(mirror.to_control(), weight(corner_hz), static)
    return lbt.linear.GeneralizedPlant.of(system, measurements=1, controls=1)


for corner_hz in (10, 20, 40, 80):
    design = lbt.hinf_controller(weighted_plant(corner_hz))
    print(f"{corner_hz:3d} Hz: gamma {design.gamma:.3f}, none below {design.gamma_infeasible:.3f}")

# %%
# The controller for 20 Hz has a notch at the resonance. At low frequencies it is as strong as an
# integrator of gain 0.2; on this mirror one of gain 0.1 is unstable already, and 0.05 is drawn.

design = lbt.hinf_controller(weighted_plant(20), gamma_ratio=1.05)
frequency_hz = np.geomspace(1, 499, 600)
G = mirror.frequency_response(frequency_hz)[:, 0, 0]
K = design.controller.frequency_response(frequency_hz)[:, 0, 0]
slow = lbt.linear.StateSpace(A=1.0, B=0.05, C=1.0, D=0.05, dt_s=dt_s)
integrator = slow.frequency_response(frequency_hz)[:, 0, 0]

figure, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
axes[0].loglog(frequency_hz, np.abs(K), label="H-infinity")
axes[0].loglog(frequency_hz, np.abs(integrator), "k:", label="integrator, gain 0.05")
axes[0].loglog(frequency_hz, np.abs(G), color="0.7", label="mirror and delay")
axes[0].set(xlabel="frequency [Hz]", ylabel="modulus", title="controllers")
axes[0].legend()
axes[1].loglog(frequency_hz, np.abs(1 / (1 + G * K)))
axes[1].loglog(frequency_hz, np.abs(1 / (1 + G * integrator)), "k:")
axes[1].set(xlabel="frequency [Hz]", title="sensitivity")
