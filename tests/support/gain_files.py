"""A design of every method, with what is not the simplest, and their gain files, changed by hand."""

import functools
import json

import numpy as np
from support.lqg import shell, slow_plant
from support.plants import lbt_axis_plant
from support.shaping import shaped_design

import lbt_synth as lbt
from lbt_synth.models.sensor_suite import Accelerometer, Motion, SensorSuite, WavefrontSensor
from lbt_synth.storage.array_file import digest, npz_bytes, read_npz


@functools.cache
def odd_plant():
    """A plant whose sensor, mirror, noise and delay are not the simplest."""
    matrices = {"sensor_matrix": [[1.1, 0.1], [-0.1, 0.9]]}
    matrices["influence_matrix"] = [[0.9, 0.0], [0.1, 1.2]]
    return slow_plant(2.5, modes=2, noise_nm=[15.5, 20.0], **matrices)


def bare_problem():
    A, B, D = [[1.9, -0.99], [1.0, 0.0]], [[1.0, 0.0], [0.0, 0.0]], [[0.0, 3.0]]
    return lbt.EstimationProblem(A=A, B=B, C=[[0.0, 1.0]], D=D, L=[[1.0, 0.0]], dt_s=0.002)


def sensors_original(*, bounded):
    """A filter of a slow sensor and an accelerometer beside the loop's own sensor."""
    slow = WavefrontSensor(name="slow", rate_hz=400, delay_frames=2, noise_nm=9.0)
    facts = {"channels": ("m1",), "noise_m_s2": 2e-3, "highpass_hz": 1.0}
    shaken = Accelerometer(name="mirror", rate_hz=800, delay_frames=1.5, **facts)
    own = odd_plant()
    motions = ({"m1": Motion(size=2.0, phase_deg=20.0)},) * len(own.vibrations)
    plant = own.with_sensors(SensorSuite(sensors=(slow, shaken)), motions)
    return lbt.hinf(plant, gamma_ratio=1.2) if bounded else lbt.kalman(plant)


ORIGINALS = {
    "kalman": lambda: lbt.kalman(odd_plant()),
    "bare": lambda: lbt.kalman(bare_problem()),
    "hinf": lambda: lbt.hinf(odd_plant(), gamma_ratio=1.2, route="riccati"),
    "least": lambda: lbt.hinf(lbt_axis_plant(modes=2), gamma_ratio=1, route="riccati"),
    "mixed": lambda: lbt.mixed(lbt_axis_plant(modes=1), gamma_ratio=1.1, taps=4),
    "lqg": lambda: lbt.lqg(slow_plant(2.0, shell(), modes=2), command_weight=0.01),
    "shaped": shaped_design,
    "sensors": lambda: sensors_original(bounded=False),
    "sensors_hinf": lambda: sensors_original(bounded=True),
    "integrator": lambda: lbt.integrator(odd_plant().hardware, gain=0.3),
    "mirror": lambda: lbt.integrator(slow_plant(2.0, shell(), modes=2).hardware, gain=0.1),
}


@functools.cache
def original(name):
    return ORIGINALS[name]()


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
