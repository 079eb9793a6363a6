"""Ensembles that are refused."""

import numpy as np
import pytest
from support.ensembles import AIR, LINE

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.loop import EnsembleVibration, LoopEnsemble, ensemble_residuals

WRONG = [
    ({"sensor_gain": 0.0}, ProblemError, "sensor_gain must be above 0"),
    ({"sensor_gain": [np.nan, 1]}, ProblemError, "finite"),
    ({"noise_nm": -1.0}, ProblemError, "noise_nm must be at least 0"),
    ({"delay_frames": [0.5, 2]}, ProblemError, "delay_frames must be at least 1"),
    ({"delay_frames": [2, 20.5]}, ProblemError, "at least 1 and at most 20"),
    ({"sensor_gain": [1, 1], "noise_nm": [1, 1, 1]}, DimensionError, "one entry per loop"),
    ({"sensor_gain": []}, DimensionError, "at least one loop"),
    ({"turbulence": "von Karman"}, ProblemError, "turbulence must be"),
    ({"vibrations": [LINE]}, ProblemError, "EnsembleVibration"),
    ({"turbulence": (AIR, AIR, AIR)}, DimensionError, "one entry per mode"),
    ({"noise_nm": np.ones((2, 3))}, DimensionError, "one column per measurement"),
    (
        {"turbulence": lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=1, frame_rate_hz=500)},
        ProblemError,
        "sampled at the loop's 800 Hz; got 500 Hz",
    ),
    (
        {"vibrations": [EnsembleVibration(frequency_hz=[20, 400], rms_nm=1)]},
        ProblemError,
        "Nyquist frequency 400 Hz; got 400 Hz",
    ),
    (
        {"vibrations": [EnsembleVibration(frequency_hz=20, rms_nm=1, direction=[1, 0, 0])]},
        DimensionError,
        "must have 2 components",
    ),
]


@pytest.mark.parametrize(("given", "kind", "message"), WRONG)
def test_what_loops_cannot_meet(kalman, given, kind, message):
    with pytest.raises(kind, match=message):
        ensemble_residuals(kalman.controller, kalman.hardware, LoopEnsemble(**given))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"frequency_hz": 0.0}, "frequency_hz must be above 0"),
        ({"rms_nm": [1.0, -1.0]}, "rms_nm must be above 0"),
        ({"damping": 0.0}, "damping must be above 0"),
        ({"direction": [0.0, 0.0]}, "direction must be a vector"),
        ({"direction": 1.0}, "direction must be a vector"),
    ],
)
def test_what_is_no_vibration(given, message):
    with pytest.raises(ProblemError, match=message):
        EnsembleVibration(**({"frequency_hz": 20.0, "rms_nm": 1.0} | given))
