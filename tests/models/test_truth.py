"""A truth, its vibrations and spectra: their processes, their drift, and impossible values."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.signal import hilbert
from support.drifting import drifting
from support.refusals import require_refusals
from support.uneven_axes import SLOW

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.loop.disturbances import draw_disturbance
from lbt_synth.models import ARModel, SinusoidalVibration, SumSpectrum, TabulatedSpectrum
from lbt_synth.models.vibration import checked_direction

PATH = lbt.LoopHardware(frame_rate_hz=800, modes=1)


def test_a_frequency_error_moves_each_vibration_by_its_share():
    lines = tuple(SinusoidalVibration(frequency_hz=f, rms_nm=9) for f in (0.3, 20.0, 40.0))
    truth = lbt.Truth(turbulence=None, vibrations=lines)
    stated, still = (
        replace(truth, frequency_errors_hz=errors) for errors in ((0.0, 2.0, 1.0), (0, 0, 0))
    )
    for shaken, error_hz, moved_hz in (
        (truth, 4.0, [0.33, 22.0, 44.0]),
        (stated, -2.0, [0.3, 18.0, 39.0]),
        (still, 5.0, [0.3, 20.0, 40.0]),
    ):
        moved = shaken.with_frequency_error(error_hz).vibrations
        assert [line.frequency_hz for line in moved] == pytest.approx(moved_hz)
    with pytest.raises(ProblemError, match="moves the one at 20 Hz to -5 Hz"):
        stated.with_frequency_error(-25.0)
    assert lbt.Truth(turbulence=None).frequency_shift_hz(30.0, 2.0) == 2.0


def test_a_vibration_has_the_papers_drive_and_holds_what_it_is_told_when_retuned():
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=1.0)
    model = line.ar_model(800)
    assert model.driving_rms_nm == pytest.approx(0.012381, abs=5e-7)
    held = line.retuned(17, frame_rate_hz=800, hold="driving").ar_model(800)
    assert held.driving_rms_nm == pytest.approx(model.driving_rms_nm, rel=1e-12)
    assert line.retuned(17, frame_rate_hz=800).rms_nm == 1


@pytest.mark.parametrize("sections", [1, 2, 4])
def test_a_bump_is_its_resonances_in_series(sections):
    """The spectrum of the process is the power of that of one, at the rms that was asked for."""
    bump = lbt.Vibration(frequency_hz=40, damping=0.2, rms_nm=100, sections=sections)
    one, process = replace(bump, sections=1).ar_model(1000), bump.ar_model(1000)
    assert process.order == 2 * sections
    assert process.rms_nm == pytest.approx(100, rel=1e-6)
    f = np.array([5.0, 30.0, 40.0, 60.0, 300.0])
    ratio = process.psd(f) / one.psd(f) ** sections
    assert ratio == pytest.approx(np.full(5, ratio[0]), rel=1e-6)


def drawn(line, frames, zero_frame):
    truth = lbt.Truth(turbulence=None, vibrations=(line,))
    options = {"frames": frames, "cases": 1, "seed": 0, "zero_frame": zero_frame}
    return draw_disturbance(truth, PATH, frame_means=True, **options).phase_nm[0, :, 0]


def test_the_sinusoid_has_the_frequency_at_each_time():
    line = drifting()
    assert line.turns_at(0.0) == 0
    series = drawn(line, 14 * 800, 1600)
    time_s = (np.arange(series.size) - 1600) / 800
    frequency_hz = np.gradient(np.unwrap(np.angle(hilbert(series))), time_s) / (2 * np.pi)
    # the ends of a Hilbert transform are wrong
    error_hz = (frequency_hz - line.frequency_hz_at(time_s))[400:-400]
    assert np.max(np.abs(error_hz)) < 0.06
    assert np.abs(np.mean(error_hz)) < 1e-3
    assert np.max(np.abs(series)) == pytest.approx(100 * np.sqrt(2), rel=1e-3)


def test_without_a_drift_it_is_the_sinusoid():
    series = drawn(drifting(frequency_hz=20, end_hz=20), 4000, 321)
    wave = np.exp(2j * np.pi * np.arange(4000) / 40)
    phasor = 2 * np.mean(series * wave.conj())  # over whole turns
    np.testing.assert_allclose(series, np.real(phasor * wave), atol=1e-8)
    assert np.std(series) == pytest.approx(100, rel=1e-3)


def test_a_direction_is_scaled_once():
    """Else a gain file would move the lines that it holds by a last digit."""
    for vector in np.random.default_rng(0).standard_normal((10, 3)):
        line = drifting(direction=vector)
        assert np.linalg.norm(line.direction) == pytest.approx(1, rel=1e-15)
        assert replace(line, rms_nm=2).direction == line.direction
    assert drifting(direction=(3, 4)).direction == pytest.approx((0.6, 0.8))


def test_impossible_values_are_refused():
    process = partial(ARModel, coefficients=[0.5], frame_rate_hz=1)
    for make, key in (
        (lambda v: lbt.Vibration(frequency_hz=v, damping=0.1, rms_nm=1), "frequency_hz"),
        (lambda v: SinusoidalVibration(frequency_hz=1, rms_nm=v), "rms_nm"),
        (lambda v: process(driving_rms_nm=v), "driving_rms_nm"),
        (lambda v: lbt.Truth(turbulence=None, noise_nm=v), "noise_nm"),
        (lambda v: lbt.Imaging(diameter_m=v), "diameter_m"),
        (lambda v: lbt.LoopHardware(frame_rate_hz=1, delay_frames=v), "delay_frames"),
        (lambda v: lbt.models.nm_per_mas(v), "diameter_m"),
        (lambda v: TabulatedSpectrum(frequency_hz=[0, v], density_nm2_hz=[1, 1]), "frequency_hz"),
    ):
        require_refusals((partial(make, v), ProblemError, key) for v in (np.nan, np.inf, -2.0))


def test_refusals():
    truth, still = lbt.Truth, partial(lbt.Truth, turbulence=None)
    line = partial(lbt.Vibration, frequency_hz=20, damping=0.1, rms_nm=1)
    table = partial(TabulatedSpectrum, density_nm2_hz=[1, 1])
    sensor = partial(lbt.models.pyramid_modal_noise_nm, modes=3)
    process = partial(ARModel, driving_rms_nm=1, frame_rate_hz=500)
    lines = {"vibrations": (SinusoidalVibration(frequency_hz=20, rms_nm=100),)}
    beyond = "below the Nyquist frequency 400 Hz; got 500 Hz"
    rows = [
        (lambda: truth(turbulence=[SLOW, 3.0]), "one per mode; got float"),
        (lambda: truth(turbulence=3.0), "psd"),
        (lambda: truth(turbulence="slow"), "one per mode; got str"),
        (lambda: still(vibrations=("abc",)), "vibrations must be"),
        (lambda: still(noise_nm=[1.0, -1.0]), "noise_nm"),
        (lambda: still(**lines, frequency_errors_hz=[-1.0]), "at least 0"),
        *((partial(line, damping=v), "damping must be") for v in (0.0, -1.0)),
        *((partial(line, sections=v), "sections must be") for v in (0, 5, 1.5)),
        (lambda: line(frequency_hz=500).ar_model(800), beyond),
        (lambda: line(damping=0.5).at_frequency(8), "frequency above that"),
        (lambda: checked_direction(drifting(end_hz=500), PATH), beyond),
        (lambda: drifting(frequency_hz=0), "frequency_hz must be above 0"),
        (lambda: drifting(end_hz=None), "needs end_hz and duration_s"),
        (lambda: drifting(direction=(0,)), "direction must be a vector"),
        (lambda: drifting().frequency_hz_at(np.nan), "time_s must be finite"),
        (lambda: sensor(0, modulation_lambda_over_d=4), "tilt_noise_nm"),
        (lambda: sensor(1, modulation_lambda_over_d=0), "modulation"),
        (lambda: SumSpectrum(parts=[]), "at least one"),
        (lambda: SumSpectrum(parts=[3.0]), "psd"),
        (lambda: SumSpectrum(parts=3.0), "must be a list"),
        (lambda: table(frequency_hz=[1, 2, 3]), "same length"),
        (lambda: table(frequency_hz=[2, 1]), "increase"),
        (lambda: table(frequency_hz=[1, 2], density_nm2_hz=[1, -1]), "at least 0"),
        # erratum 1 of the paper: + A2
        (lambda: process(coefficients=[1.972279, 0.996863]), "Check the signs"),
        # rounding leaves its poles inside the unit circle
        (lambda: process(coefficients=[1.9, -1.0]), "no finite variance"),
    ]
    sizes = [
        (lambda: truth(turbulence=[]), "got an empty sequence"),
        (lambda: still(noise_nm=[[1.0]]), r"got shape \(1, 1\)"),
        (lambda: still(noise_nm=[]), r"got shape \(0,\)"),
        (lambda: still(frequency_errors_hz=[1.0]), "one per vibration"),
        (lambda: checked_direction(drifting(direction=(1, 0)), PATH), "must have 1 components"),
    ]
    require_refusals((call, ProblemError, words) for call, words in rows)
    require_refusals((call, DimensionError, words) for call, words in sizes)
