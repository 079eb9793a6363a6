"""Vibrations: their processes, their drift, and what is no vibration."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import hilbert
from support.drifting import drifting

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.loop.disturbances import draw_disturbance
from lbt_synth.models.vibration import checked_direction

PATH = lbt.LoopHardware(frame_rate_hz=800, modes=1)


def test_a_vibration_is_the_papers_and_holds_what_it_is_told_when_retuned():
    model = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=1.0).ar_model(800)
    assert model.coefficients == pytest.approx([1.972279, -0.996863], abs=5e-7)
    assert model.driving_rms_nm == pytest.approx(0.012381, abs=5e-7)
    line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=100)
    driving = line.ar_model(800).driving_rms_nm
    held = line.retuned(17, frame_rate_hz=800, hold="driving")
    assert held.ar_model(800).driving_rms_nm == pytest.approx(driving, rel=1e-12)
    assert line.retuned(17, frame_rate_hz=800).rms_nm == 100


@pytest.mark.parametrize("sections", [1, 2, 4])
def test_a_bump_is_its_resonances_in_series(sections):
    """The spectrum of the process is the power of that of one, at the rms that was asked for."""
    bump = lbt.Vibration(frequency_hz=40, damping=0.2, rms_nm=100, sections=sections)
    one = replace(bump, sections=1).ar_model(1000)
    process, f = bump.ar_model(1000), np.array([5.0, 30.0, 40.0, 60.0, 300.0])
    assert process.order == 2 * sections
    assert process.rms_nm == pytest.approx(100, rel=1e-6)
    ratio = process.psd(f) / one.psd(f) ** sections
    assert ratio == pytest.approx(np.full(5, ratio[0]), rel=1e-6)


def drawn(line, *, frames, cases=1, zero_frame=0, seed=0):
    truth = lbt.Truth(turbulence=None, vibrations=(line,))
    options = {"frames": frames, "cases": cases, "seed": seed, "zero_frame": zero_frame}
    return draw_disturbance(truth, PATH, frame_means=True, **options).phase_nm[..., 0]


def test_the_sinusoid_has_the_frequency_at_each_time():
    line = drifting()
    assert line.turns_at(0.0) == 0
    (series,) = drawn(line, frames=14 * 800, zero_frame=1600)
    time_s = (np.arange(series.size) - 1600) / 800
    phase = np.unwrap(np.angle(hilbert(series)))
    found = np.gradient(phase, time_s) / (2 * np.pi)
    inside = slice(400, -400)  # the ends of a Hilbert transform are wrong
    assert np.max(np.abs(found - line.frequency_hz_at(time_s))[inside]) < 0.06
    assert np.abs(np.mean((found - line.frequency_hz_at(time_s))[inside])) < 1e-3
    assert np.max(np.abs(series)) == pytest.approx(100 * np.sqrt(2), rel=1e-3)


def test_without_a_drift_it_is_the_sinusoid():
    still = drifting(frequency_hz=20, end_hz=20)
    (series,) = drawn(still, frames=4000, zero_frame=321)
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


def test_wrong_vibrations_are_refused():
    def line(**changes):
        return lbt.Vibration(**({"frequency_hz": 20, "damping": 0.1, "rms_nm": 1} | changes))

    beyond = "below the Nyquist frequency 400 Hz; got 500 Hz"
    for call, words in (
        *((lambda v=v: line(damping=v), "damping must be") for v in (0.0, -1.0)),
        *((lambda v=v: line(sections=v), "sections must be") for v in (0, 5, 1.5)),
        (lambda: line(frequency_hz=500).ar_model(800), beyond),
        (lambda: line(damping=0.5).at_frequency(8), "frequency above that"),
        (lambda: checked_direction(drifting(end_hz=500), PATH), beyond),
        (lambda: drifting(frequency_hz=0), "frequency_hz must be above 0"),
        (lambda: drifting(end_hz=None), "needs end_hz and duration_s"),
        (lambda: drifting(direction=(0,)), "direction must be a vector"),
        (lambda: drifting().frequency_hz_at(np.nan), "time_s must be finite"),
    ):
        with pytest.raises(ProblemError, match=words):
            call()
    with pytest.raises(DimensionError, match="must have 1 components"):
        checked_direction(drifting(direction=(1, 0)), PATH)
