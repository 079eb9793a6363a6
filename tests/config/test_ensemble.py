"""Samples of a configuration as an ensemble of loops: which numbers may differ."""

import numpy as np
import pytest
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.config.ensemble import Samples, accepted_samples, build_ensemble, read_config

COUNT = 4


def samples(values, **errors):
    numbers = {"delay_error_frames": np.zeros(COUNT), "noise_factor": np.ones(COUNT)} | errors
    return Samples(config=lbt.load_config(LBT_YAML), values=values, **numbers)


def test_which_numbers_the_builders_take_as_arrays():
    reads = read_config(lbt.load_config(LBT_YAML))
    numbers = [
        ("truth", "sensor_gain"),
        ("atmosphere", "seeing_arcsec"),
        ("truth", "vibrations", 0, "rms_mas"),
        ("sensor", "pyramid", "photons"),
        ("model", "vibrations", 0, "rms_mas"),
        ("model", "sensor_gain"),
    ]
    assert all(map(reads.take_arrays_at, numbers))
    others = [
        ("telescope", "diameter_m"),
        ("model", "turbulence"),
        ("loop", "frame_rate_hz"),
        ("imaging", "wavelength_um"),
        ("atmosphere", "seeing_wavelength_um"),
        ("model", "turbulence", "driving_rms_nm"),
        ("design", "gamma_ratio"),  # which no builder reads
    ]
    assert not any(map(reads.take_arrays_at, others))


def test_what_designs_assume_does_not_change_the_loops():
    known = build_ensemble(samples({}))
    for keys in (("model", "vibrations", 0, "rms_mas"), ("model", "sensor_gain")):
        found = build_ensemble(samples({keys: np.linspace(1.0, 2.0, COUNT)}))
        assert found.sensor_gain == known.sensor_gain
        assert [line.rms_nm for line in found.vibrations] == [
            line.rms_nm for line in known.vibrations
        ]


def test_a_design_for_each_sample_needs_one_delay():
    config = lbt.load_config(LBT_YAML)
    delay = ("loop", "delay_frames")
    assert read_config(config).take_arrays_at(delay)
    assert not read_config(config, designs=True).take_arrays_at(delay)


@pytest.mark.parametrize(
    ("keys", "values"),
    [
        (("truth", "vibrations", 0, "frequency_hz"), [20.0, 400.0, -1.0, 399.0]),
        (("model", "vibrations", 0, "frequency_hz"), [20.0, 400.0, np.nan, 21.0]),
        (("model", "vibrations", 0, "damping"), [0.01, 1.0, 0.0, 0.5]),
        (("sensor", "pyramid", "read_noise_electrons"), [0.0, -1.0, np.inf, 8.0]),
        (("truth", "sensor_gain"), [1.0, 0.0, -1.0, 0.5]),
        (("loop", "delay_frames"), [1.0, 0.5, 101.0, 2.5]),
    ],
)
def test_samples_that_a_configuration_refuses(keys, values):
    assert accepted_samples(samples({keys: np.array(values)})).tolist() == [0, 3]


def test_real_delays_and_noises_that_no_loop_has():
    delay = samples({}, delay_error_frames=np.array([0.0, -1.5, 99.0, 0.5]))
    assert accepted_samples(delay).tolist() == [0, 3]
    noise = samples({}, noise_factor=np.array([0.0, -0.1, np.nan, 2.0]))
    assert accepted_samples(noise).tolist() == [0, 3]
