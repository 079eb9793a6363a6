"""An H-infinity controller of a generalised plant, from measurements.

The data are those of the example in the documentation of SLICOT's SB10DD, whose level is 111.294.

Run: python examples/output_feedback.py
"""

from __future__ import annotations

import numpy as np

import lbt_synth as lbt

A = np.array(
    [
        [-0.7, 0.0, 0.3, 0.0, -0.5, -0.1],
        [-0.6, 0.2, -0.4, -0.3, 0.0, 0.0],
        [-0.5, 0.7, -0.1, 0.0, 0.0, -0.8],
        [-0.7, 0.0, 0.0, -0.5, -1.0, 0.0],
        [0.0, 0.3, 0.6, -0.9, 0.1, -0.4],
        [0.5, -0.8, 0.0, 0.0, 0.2, -0.9],
    ]
)
B = np.array(
    [
        [-1.0, -2.0, -2.0, 1.0, 0.0],
        [1.0, 0.0, 1.0, -2.0, 1.0],
        [-3.0, -4.0, 0.0, 2.0, -2.0],
        [1.0, -2.0, 1.0, 0.0, -1.0],
        [0.0, 1.0, -2.0, 0.0, 3.0],
        [1.0, 0.0, 3.0, -1.0, -2.0],
    ]
)
C = np.array(
    [
        [1.0, -1.0, 2.0, -2.0, 0.0, -3.0],
        [-3.0, 0.0, 1.0, -1.0, 1.0, 0.0],
        [0.0, 2.0, 0.0, -4.0, 0.0, -2.0],
        [1.0, -3.0, 0.0, 0.0, 3.0, 1.0],
        [0.0, 1.0, -2.0, 1.0, 0.0, -2.0],
    ]
)
D = np.array(
    [
        [1.0, -1.0, -2.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 1.0, 0.0],
        [2.0, -1.0, -3.0, 0.0, 1.0],
        [0.0, 1.0, 0.0, 1.0, -1.0],
        [0.0, 0.0, 1.0, 2.0, 1.0],
    ]
)
CONTROLS, MEASUREMENTS, GAMMA = 2, 2, 111.294


def main() -> None:
    """Print the controller of SLICOT's level, and where the least level lies."""
    plant = lbt.linear.GeneralizedPlant.of(
        (A, B, C, D), measurements=MEASUREMENTS, controls=CONTROLS
    )
    design = lbt.hinf_controller(plant, gamma=GAMMA)
    print(design)
    with np.printoptions(precision=4, suppress=True, linewidth=100):
        print(f"D =\n{design.controller.D}")


if __name__ == "__main__":
    main()
