"""A truth, and all its parts, refuse impossible values."""

from functools import partial

import numpy as np
import pytest
from support.refusals import require_refusals
from support.uneven_axes import SLOW

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError

LINE = lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100)


@pytest.mark.parametrize(
    "make",
    [
        lambda v: lbt.Vibration(frequency_hz=v, damping=0.1, rms_nm=1),
        lambda v: lbt.models.SinusoidalVibration(frequency_hz=1, rms_nm=v),
        lambda v: lbt.models.ARModel(coefficients=[0.5], driving_rms_nm=v, frame_rate_hz=1),
        lambda v: lbt.Truth(turbulence=None, noise_nm=v),
        lambda v: lbt.Imaging(diameter_m=v),
        lambda v: lbt.LoopHardware(frame_rate_hz=1, delay_frames=v),
        lambda v: lbt.models.nm_per_mas(v),
        lambda v: lbt.models.TabulatedSpectrum(frequency_hz=[0, v], density_nm2_hz=[1, 1]),
    ],
)
def test_impossible_values_are_refused(make):
    for value in (np.nan, np.inf, -2.0):
        with pytest.raises(ProblemError):
            make(value)


def test_wrong_truths_are_refused():
    still = partial(lbt.Truth, turbulence=None)
    rows = [
        (partial(lbt.Truth, turbulence=[]), DimensionError, "got an empty sequence"),
        (partial(lbt.Truth, turbulence=[SLOW, 3.0]), ProblemError, "one per mode; got float"),
        (partial(lbt.Truth, turbulence=3.0), ProblemError, "psd"),
        (partial(lbt.Truth, turbulence="slow"), ProblemError, "one per mode; got str"),
        (partial(still, vibrations=("abc",)), ProblemError, "vibrations must be"),
        (partial(still, noise_nm=[[1.0]]), DimensionError, r"got shape \(1, 1\)"),
        (partial(still, noise_nm=[]), DimensionError, r"got shape \(0,\)"),
        (partial(still, noise_nm=[1.0, -1.0]), ProblemError, "noise_nm"),
        (partial(still, frequency_errors_hz=[1.0]), DimensionError, "one per vibration"),
        (
            partial(still, vibrations=(LINE,), frequency_errors_hz=[-1.0]),
            ProblemError,
            "at least 0",
        ),
    ]
    require_refusals(rows)


def test_a_frequency_error_moves_each_vibration_by_its_share():
    lines = [lbt.models.SinusoidalVibration(frequency_hz=f, rms_nm=9) for f in (0.3, 20.0, 40.0)]
    truth = lbt.Truth(turbulence=None, vibrations=tuple(lines))

    def moved(given, error_hz):
        return [line.frequency_hz for line in given.with_frequency_error(error_hz).vibrations]

    assert moved(truth, 4.0) == pytest.approx([0.33, 22.0, 44.0])
    stated = lbt.Truth(
        turbulence=None, vibrations=tuple(lines), frequency_errors_hz=(0.0, 2.0, 1.0)
    )
    assert moved(stated, -2.0) == pytest.approx([0.3, 18.0, 39.0])
    known = lbt.Truth(turbulence=None, vibrations=tuple(lines), frequency_errors_hz=(0, 0, 0))
    assert moved(known, 5.0) == [0.3, 20.0, 40.0]
    with pytest.raises(ProblemError, match="moves the one at 20 Hz to -5 Hz"):
        stated.with_frequency_error(-25.0)
    assert lbt.Truth(turbulence=None).frequency_shift_hz(30.0, 2.0) == 2.0
