"""
Controllers for any plant
=========================

A control engineer who has never seen a telescope: a quarter of a car whose damper can push. Which
comfort is possible at all, and why no more?
"""

import warnings

import control
import matplotlib.pyplot as plt
import numpy as np

import lbt_synth as lbt

warnings.filterwarnings("ignore", "connect", FutureWarning)  # python-control's own, in augw

# %%
# A body of 300 kg on a spring, a wheel of 60 kg on its tyre; the states are their positions and
# velocities, the control a force in kN, the disturbance the height of the road (5 cm). The model is
# in continuous time, and the controller samples it each millisecond. The bilinear map keeps the
# H-infinity norm.

dt_s = 1e-3
body, wheel, damper, spring, tyre = 300.0, 60.0, 1000.0, 16e3, 190e3
A = np.array(
    [
        [0, 1, 0, 0],
        [-spring / body, -damper / body, spring / body, damper / body],
        [0, 0, 0, 1],
        [spring / wheel, damper / wheel, -(spring + tyre) / wheel, -damper / wheel],
    ]
)
road = 0.05 * np.array([0, 0, 0, tyre / wheel])
force = 1e3 * np.array([0, 1 / body, 0, -1 / wheel])
acceleration, travel = A[1], np.array([1.0, 0.0, -1.0, 0.0])


def car(comfort):
    """Return the plant with a weight of the body's acceleration."""
    B = np.column_stack([road, 0 * road, 0 * road, force])
    errors = np.vstack([comfort * acceleration, travel / 0.08, 0 * travel])
    measured = np.vstack([travel, acceleration])
    D = np.zeros((5, 4))
    D[[0, 2], 3] = comfort * force[1], 0.3
    D[3:, 1:3] = np.diag([1e-3, 0.05])  # noise
    D[4, 3] = force[1]
    continuous = control.ss(A, B, np.vstack([errors, measured]), D)
    sampled = control.sample_system(continuous, dt_s, method="bilinear")
    return lbt.linear.GeneralizedPlant.of(sampled, measurements=2, controls=1)


# %%
# The least norm is bracketed from below by a proof, and the proof names its reason. At about
# ``sqrt(tyre / wheel) / 2 pi``, 8.96 Hz, the road moves the body as much whatever the damper
# does: an invariant that textbooks derive by hand.

comfortable = lbt.hinf_controller(car(0.5), gamma_ratio=1.05)
print(comfortable)
print(f"{np.sqrt(tyre / wheel) / (2 * np.pi):.3f} Hz")

# %%
# Everywhere else a large weight of comfort quietens the body, and the wheel hops for it. A small
# weight still removes the resonance of the body near 1 Hz.

designs = {comfort: lbt.hinf_controller(car(comfort), gamma_ratio=1.05) for comfort in (0.5, 0.05)}
frequency_hz = np.geomspace(0.2, 30, 400)
figure, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for index, (axis, name) in enumerate(zip(axes, ("acceleration", "travel"), strict=True)):
    for comfort, design in designs.items():
        size = (comfort, 1 / 0.08)[index]
        response = design.closed_loop.frequency_response(frequency_hz)[:, index, 0] / size
        axis.loglog(frequency_hz, np.abs(response), label=f"comfort {comfort:g}")
    size = (0.5, 1 / 0.08)[index]
    passive = designs[0.5].problem.whole.frequency_response(frequency_hz)[:, index, 0] / size
    axis.loglog(frequency_hz, np.abs(passive), "k:", label="no control")
    axis.set(xlabel="frequency [Hz]", title=f"{name} of the body, road of 5 cm")
axes[0].set_ylabel("m/s$^2$")
axes[1].set_ylabel("m")
axes[0].legend()

# %%
# Mixed sensitivity: a plant of S. Skogestad and I. Postlethwaite ("Multivariable Feedback Control",
# 2005, section 2.6.3), weighted by python-control. The table of the book gives 1.37.

G = control.tf([200.0], np.polymul([10.0, 1.0], np.polymul([0.05, 1], [0.05, 1])))
W1 = control.tf([1 / 1.5, 10.0], [1.0, 10.0 * 1e-4])
G, W1 = (control.sample_system(control.ss(S), 0.01, method="bilinear") for S in (G, W1))
weighted = control.augw(G, W1, control.ss([], [], [], 1.0, 0.01))
mixed = lbt.hinf_controller(lbt.linear.GeneralizedPlant.of(weighted, measurements=1, controls=1))
print(f"gamma {mixed.gamma:.4f}; none reaches {mixed.gamma_infeasible:.4f}: {mixed.witness.reason}")
