"""A design of every method, to be saved in gain files."""

from __future__ import annotations

from support.plants import lbt_axis_plant

import lbt_synth as lbt

ENDINGS = ("fits", "npz", "json")


def every_design():
    plant = lbt_axis_plant(modes=2, delay_frames=2.5)
    bare = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0, dt_s=0.1)
    return {
        "kalman": lbt.kalman(plant),
        "hinf": lbt.hinf(plant, gamma_ratio=1.3, route="riccati"),
        "full": lbt.kalman(plant.full()),
        "bare": lbt.kalman(bare),
        "integrator": lbt.integrator(plant.hardware, gain=0.3),
    }


DESIGNS = every_design()
