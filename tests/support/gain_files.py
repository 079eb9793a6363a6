"""A design of every method, to be saved in gain files."""

import json

import numpy as np
from support.plants import lbt_axis_plant
from support.sensor_loops import FAST, SLOW, example_plant

import lbt_synth as lbt
from lbt_synth.storage.array_file import digest, npz_bytes, read_npz


def every_design():
    plant = lbt_axis_plant(modes=2, delay_frames=2.5)
    bare = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0, dt_s=0.1)
    return {
        "kalman": lbt.kalman(plant),
        "hinf": lbt.hinf(plant, gamma_ratio=1.3, route="riccati"),
        "bare": lbt.kalman(bare),
        "sensors": lbt.kalman(example_plant((FAST, SLOW))),
        "sensors_hinf": lbt.hinf(example_plant((SLOW,)), gamma_ratio=1.3),
        "integrator": lbt.integrator(plant.hardware, gain=0.3),
    }


DESIGNS = every_design()


def edited_file(path, design, change, *, digest_again=True):
    """The NPZ gain file of a design after a change of its ``arrays`` (as lists) and ``meta``."""
    arrays, text = read_npz(lbt.save_gain(path, design).read_bytes())
    document = {"arrays": {k: v.tolist() for k, v in arrays.items()}, "meta": json.loads(text)}
    change(document)
    arrays = {k: np.array(v, dtype=float) for k, v in document["arrays"].items()}
    if digest_again:
        document["meta"]["digest"] = digest(arrays, document["meta"])
    path.write_bytes(npz_bytes(arrays, json.dumps(document["meta"])))
    return path
