"""Loops and records that the tests of records share."""

import numpy as np

import lbt_synth as lbt

RATE = 1000.0
SHELL = lbt.models.PositionLoop.from_bandwidth(
    natural_frequency_hz=50, damping=0.5, bandwidth_hz=300, sampling_hz=24_000
)
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=RATE)
LINE = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=300, direction=[0.6, 0.8])


def ran(path, *, noise_nm=0.0, sensor_gain=1.0, frames=300, seed=3, gain=0.1):
    """A loop with an integrator: the simulation, and its noise."""
    truth = lbt.Truth(
        turbulence=SLOW, noise_nm=noise_nm, sensor_gain=sensor_gain, vibrations=(LINE,)
    )
    controller = lbt.integrator(path, gain=gain).controller
    return lbt.simulate(controller, truth, hardware=path, frames=frames, seed=seed)


def record(run, path, **more):
    return lbt.identification.loop_record(
        run.measurements[0],
        run.commands[0],
        frame_rate_hz=path.frame_rate_hz,
        delay_frames=path.delay_frames,
        mirror=path.mirror,
        unit="nm",
        **more,
    )


def kinds(seen):
    return {(f.kind, f.series, f.axis) for f in seen.findings}


def noise(frames, seed=0):
    return np.random.default_rng(seed).standard_normal(frames)


def findings(record):
    """What was found in a record: kind, series, axis, frames, the first of them."""
    return [
        (each.kind, each.series, each.axis, each.count, each.first_frame)
        for each in record.findings
    ]
