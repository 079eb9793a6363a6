"""A predictor that reads three accelerometers beside the sensor of its loop."""

from dataclasses import replace

import numpy as np

import lbt_synth as lbt
from lbt_synth.design.predictor import predictor_design, regression_filter
from lbt_synth.models import Accelerometer, SensorSuite

PATH = lbt.LoopHardware(frame_rate_hz=500, delay_frames=2.3, sensor_matrix=[[0.7, 0.1], [0, 0.9]])
BASE = lbt.integrator(PATH, gain=0.3).controller
SENSOR = Accelerometer(
    name="acc", rate_hz=500, delay_frames=2.3, channels=("a", "b", "c"), noise_m_s2=1e-3
)
HEARING = replace(PATH, suite=SensorSuite(sensors=(SENSOR,)))


def coefficients(signals, taps=6):
    return 0.1 * np.random.default_rng(3).standard_normal((taps, 2, signals))


def readings(channels=3, frames=4000):
    return np.random.default_rng(4).standard_normal((frames, 2 + channels))


def made(**claims):
    filters = [regression_filter(PATH, BASE, coefficients(n)) for n in (7, 4)]
    return predictor_design(
        HEARING, filters, readings(), 100.0, groups=[[0, 1]], what="test", **claims
    )
