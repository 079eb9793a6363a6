"""Designs, plants and random conditions for tests of many loops."""

from dataclasses import replace

import numpy as np

import lbt_synth as lbt

RATE = 800
SLOW = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=RATE)
AIR = lbt.Atmosphere(
    seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22, obstruction=0.11
)
LINE = lbt.Vibration(frequency_hz=20, damping=0.005, rms_nm=563.6)


def plant(**changes):
    lines = changes.pop("vibrations", [LINE, replace(LINE, direction=(0, 1))])
    given = {"frame_rate_hz": RATE, "turbulence": SLOW, "noise_nm": 15.5, "vibrations": lines}
    return lbt.tip_tilt_plant(**(given | changes))


def weather(count, seed=0):
    rng = np.random.default_rng(seed)
    conditions = {"gains": rng.uniform(0.3, 1.2, count)}
    conditions["delays"] = rng.choice([1.0, 1.7, 2.0, 2.2, 3.0], count)
    ranges = {"noise": (5, 30), "seeing": (0.5, 1.5), "wind": (8, 30), "scale": (12, 60)}
    ranges |= {"frequency": (18, 22), "rms": (300, 900), "damping": (0.002, 0.02)}
    return conditions | {name: rng.uniform(*ends, count) for name, ends in ranges.items()}
