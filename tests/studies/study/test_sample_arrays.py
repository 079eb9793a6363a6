"""Parameters that change numbers of an ensemble only."""

from support.studies import LBT_TEXT, study_file

import lbt_synth as lbt
from lbt_synth.studies.study.sample_arrays import changes_assumptions_only, changes_numbers_only

FIXED = "{slow: {design: integrator, gain: 0.3}, kalman: {design: kalman}}"


def test_which_parameters_only_change_numbers(tmp_path):
    study = lbt.studies.load_study(
        study_file(
            tmp_path, base=LBT_TEXT, controllers=FIXED, parameters="{truth.sensor_gain: 1.0}"
        )
    )
    numbers = [
        ("truth", "sensor_gain"),
        ("atmosphere", "seeing_arcsec"),
        ("truth", "vibrations", 0, "rms_mas"),
        ("sensor", "pyramid", "photons"),
    ]
    assert all(changes_numbers_only(study, keys) for keys in numbers)
    others = [
        ("telescope", "diameter_m"),
        ("model", "turbulence"),
        ("loop", "frame_rate_hz"),
        ("model", "vibrations", 0, "rms_mas"),
        ("imaging", "wavelength_um"),
        ("atmosphere", "seeing_wavelength_um"),
    ]
    assert not any(changes_numbers_only(study, keys) for keys in others)
    assert changes_assumptions_only(study, ("model", "vibrations", 0, "rms_mas"))
    assert changes_assumptions_only(study, ("model", "sensor_gain"))
    assert not changes_assumptions_only(study, ("model", "turbulence", "driving_rms_nm"))
