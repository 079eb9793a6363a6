"""Samples of a configuration as an ensemble of loops: which numbers may differ."""

from functools import partial

import numpy as np
from support.configs import write_config
from support.plants import LBT_YAML
from support.refusals import refused

import lbt_synth as lbt
from lbt_synth.config.samples import array_keys, build_ensemble, parse_path, with_values
from lbt_synth.errors import ProblemError

COUNT = 4


def ensemble_of(values, **errors):
    numbers = {"delay_error_frames": np.zeros(COUNT), "noise_factor": np.ones(COUNT)} | errors
    return build_ensemble(lbt.load_config(LBT_YAML), values, **numbers)


def paths(names):
    return set(map(parse_path, names.split()))


def test_which_numbers_are_taken_as_arrays(config, tmp_path):
    keys = set(array_keys(config.settings))
    assert keys >= paths(
        "truth.sensor_gain atmosphere.seeing_arcsec truth.vibrations[0].rms_mas "
        "sensor.pyramid.photons model.vibrations[0].rms_mas model.sensor_gain loop.delay_frames"
    )
    read = "telescope.diameter_m loop.frame_rate_hz imaging.wavelength_um design.gamma_ratio"
    assert keys.isdisjoint(paths(read))  # no builder reads the last one
    values = np.array([1.0, 2.0, 3.0, 4.0])
    changed = with_values(config.settings, {parse_path("model.vibrations[0].rms_mas"): values})
    assert changed.model.vibrations[0].rms_mas is values
    assert config.settings.model.vibrations[0].rms_mas == 80  # which stays
    assert changed.truth is config.settings.truth
    # what the real turbulence is computed from, where it is the model's
    for kind, noise in (("ar1", True), ("ar2", False)):
        text = LBT_YAML.read_text().replace("kind: ar1", f"kind: {kind}")
        file = write_config(tmp_path, text.replace("turbulence: frozen_flow", "turbulence: model"))
        keys = array_keys(lbt.load_config(file).settings)
        assert parse_path("atmosphere.seeing_arcsec") not in keys
        assert (parse_path("sensor.pyramid.photons") in keys) == noise


def test_what_designs_assume_does_not_change_the_loops():
    expected = ensemble_of({})
    for path in ("model.vibrations[0].rms_mas", "model.sensor_gain"):
        ensemble = ensemble_of({parse_path(path): np.linspace(1.0, 2.0, COUNT)})
        sizes = [[line.rms_nm for line in each.vibrations] for each in (ensemble, expected)]
        assert (sizes[0], ensemble.sensor_gain) == (sizes[1], expected.sensor_gain)


def test_real_delays_and_noises_that_no_loop_has():
    for name, value in (
        ("delay_error_frames", -1.5),
        ("delay_error_frames", 99.0),
        ("noise_factor", -0.1),
    ):
        series = {name: np.array([0.0, value, 0.0, 0.5])}
        refused(partial(ensemble_of, {}, **series), ProblemError, None)
