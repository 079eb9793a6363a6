"""Loops of one mode and specifications to shape them."""

import functools

import numpy as np

import lbt_synth as lbt
from lbt_synth.design.shaping.channel import Channel, laguerre_basis

RATE = 800.0
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=RATE)
AIR = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
ONE = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
NOISE = 20.0
BASIC = lbt.design.shaping.ResidualVariance(turbulence=SLOW, noise_nm=NOISE)


def channel(size=12, pole=0.6, delay=2.0):
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1)
    return Channel(hardware=path, basis=laguerre_basis(size, pole, dt_s=1 / RATE))


def margin(at_least):
    return lbt.design.shaping.Bound(response="rejection", at_most=1 / at_least)


def attenuation(low_hz, high_hz, at_most, sensor_gain=1.0):
    ends = {"low_hz": low_hz, "high_hz": high_hz, "sensor_gain": sensor_gain}
    return lbt.design.shaping.Bound(response="rejection", at_most=at_most, **ends)


def spec(*demands, terms=(BASIC,)):
    return lbt.design.shaping.Specification(terms=terms, demands=demands)


def shaped(*demands, terms=(BASIC,), path=ONE, functions=20, states=None, **options):
    specification = spec(*demands, terms=terms)
    return lbt.design.shape(path, specification, functions=functions, states=states, **options)


def random_coefficients(size, seed=0):
    return np.random.default_rng(seed).normal(size=size) * 0.3


@functools.cache
def shaped_design():
    shaping = lbt.design.shaping
    table = lbt.models.TabulatedSpectrum(frequency_hz=[1, 10, 100], density_nm2_hz=[500, 20, 0.1])
    terms = (
        shaping.ResidualVariance(turbulence=table, noise_nm=NOISE),
        shaping.VibrationBand(low_hz=9, high_hz=11, rms_nm=50),
    )
    rate = shaping.CommandRms(at_most_nm=200, turbulence=SLOW, noise_nm=NOISE, rate=True)
    return shaped(margin(0.5), rate, terms=terms, functions=16, states=10)
