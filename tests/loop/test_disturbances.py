"""Random series against the spectra that they are drawn from."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid

import lbt_synth as lbt
from lbt_synth.loop.disturbances import draw_disturbance, draw_others, draw_phase
from lbt_synth.models import SinusoidalVibration
from lbt_synth.models.plant.seen_vibration import seen_vibration

PATH = lbt.LoopHardware(frame_rate_hz=800, modes=1)
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=60.0, frame_rate_hz=800)
QUICK = lbt.models.ARModel(coefficients=[1.6, -0.65], driving_rms_nm=25.0, frame_rate_hz=800)
TABLE = lbt.models.TabulatedSpectrum(frequency_hz=[1, 20, 120], density_nm2_hz=[900, 400, 3])


def test_drawn_series_have_their_spectrum(air):
    size = {"frames": 8192, "cases": 100, "frame_means": True}
    series = draw_disturbance(lbt.Truth(turbulence=air), PATH, **size).phase_nm[..., 0]
    variance = np.mean(series**2, axis=1)
    error = variance.std(ddof=1) / np.sqrt(len(variance))
    assert abs(variance.mean() - air.tilt_rms_nm**2) < 4 * error
    # increments see the high frequencies
    step = np.mean((series[:, 8:] - series[:, :-8]) ** 2, axis=1)
    f = np.geomspace(1e-5, 400, 50_001)
    expected = trapezoid(2 * air.psd(f) * (1 - np.cos(2 * np.pi * f * 8 / 800)), f)
    assert abs(step.mean() - expected) < 5 * step.std(ddof=1) / np.sqrt(len(step))


def test_power_is_drawn_whole_however_short_the_series(air):
    """A line between two bins, and a spectrum that rises towards zero, keep their variance."""
    steep = replace(air, outer_scale_m=None)
    density = [0, 100 / 0.03, 0]
    line = lbt.models.TabulatedSpectrum(frequency_hz=[37.2, 37.23, 37.26], density_nm2_hz=density)
    size = {"frames": 100, "cases": 3000, "seed": 2, "frame_means": True}
    for spectrum, rms in ((steep, steep.tilt_rms_nm), (line, 10.0)):
        series = draw_disturbance(lbt.Truth(turbulence=spectrum), PATH, **size).phase_nm
        assert np.sqrt(np.mean(series**2)) == pytest.approx(rms, rel=0.05)


def test_every_controller_and_mode_meets_the_weather_of_its_seed():
    both = lbt.LoopHardware(frame_rate_hz=800)

    def run(other, gain=0.4, seed=1):
        law, truth = lbt.integrator(both, gain=gain), lbt.Truth(turbulence=[SLOW, other])
        size = {"frames": 50, "cases": 2, "seed": seed, "settle_frames": 100}
        return lbt.simulate(law, truth, hardware=both, **size)

    first, table, calm = (run(other) for other in (QUICK, TABLE, None))
    for changed in (table, calm):
        np.testing.assert_array_equal(changed.residual_nm[..., 0], first.residual_nm[..., 0])
        assert not np.array_equal(changed.residual_nm[..., 1], first.residual_nm[..., 1])
    assert not np.any(calm.residual_nm[..., 1])
    lively, later = run(QUICK, gain=0.6), run(QUICK, seed=2)
    np.testing.assert_array_equal(lively.total_nm, first.total_nm)
    assert not np.array_equal(lively.residual_nm, first.residual_nm)
    assert not np.array_equal(later.total_nm, first.total_nm)


def test_drawn_resonances_have_their_rms_and_their_decay_from_the_first_frame():
    still = lbt.Vibration(frequency_hz=20, damping=0.005, rms_nm=100, direction=(1,))
    truth, (a1, a2) = (
        lbt.Truth(turbulence=None, vibrations=(still,)),
        still.ar_model(800).coefficients,
    )
    size = {"frames": 40, "cases": 4000, "seed": 1, "zero_frame": 0, "frame_means": True}
    series = draw_disturbance(truth, PATH, **size).phase_nm[..., 0]
    assert series[:, [0, 20, 39]].std(axis=0) == pytest.approx(np.full(3, 100), rel=0.05)
    correlation = np.mean(series[:, 0] * series[:, 1]) / 100**2
    assert correlation == pytest.approx(a1 / (1 - a2), abs=0.05)


def accelerated(line, motion, rate_hz, delay_frames):
    """Return a loop at 800 Hz, its accelerometer, and the truth of a line that it reads."""
    facts = {"name": "mirror", "channels": ("m1",), "noise_m_s2": 1e-12}
    sensor = lbt.models.Accelerometer(rate_hz=rate_hz, delay_frames=delay_frames, **facts)
    suite = lbt.models.SensorSuite(sensors=(sensor,))
    truth = lbt.Truth(turbulence=None, vibrations=(line,), motions=({"m1": motion},))
    return replace(PATH, suite=suite), sensor, truth


@pytest.mark.parametrize(("period", "delay_frames"), [(1, 1.3), (2, 1.6)])
def test_readings_and_phase_of_a_run_are_those_of_one_oscillator(period, delay_frames):
    """Where exposures end within a frame; the positions are drawn without knowing of it."""
    line = lbt.Vibration(frequency_hz=60, damping=0.1, rms_nm=100, direction=(1,))
    motion = lbt.models.Motion(size=1, phase_deg=50)
    path, sensor, truth = accelerated(line, motion, 800 / period, delay_frames)
    size, rng = {"frames": 20_000, "cases": 4}, np.random.default_rng(4)
    same, drawn = draw_phase(truth, path, rng=rng, oscillators=True, **size)
    readings = draw_others(truth, path, drawn, rng, zero_frame=0, **size)[:, 100::period, 0]
    both = np.stack([drawn[0][0][:, 100::period].ravel(), readings.ravel()])
    expected = seen_vibration(line, {"m1": motion}, (sensor,), path).output_covariances()[0]
    sizes = np.outer(*2 * [np.sqrt(np.diag(expected))])
    np.testing.assert_allclose(np.cov(both) / sizes, expected / sizes, atol=0.03)
    np.testing.assert_array_equal(same[:, :, 0], drawn[0][0])


def test_a_line_that_drifts_is_read_at_its_frequency_of_the_moment():
    facts = {"frequency_hz": 40, "end_hz": 80, "duration_s": 10, "rms_nm": 100, "direction": (1,)}
    line, motion = SinusoidalVibration(**facts), lbt.models.Motion(size=2, phase_deg=70)
    path, _, truth = accelerated(line, motion, 800, 2.5)
    size = {"frames": 8000, "cases": 1, "zero_frame": 0}
    _, drawn = draw_phase(truth, path, rng=np.random.default_rng(4), frame_means=True, **size)
    readings = draw_others(truth, path, drawn, np.random.default_rng(5), **size)[0, :, 0]
    time_s = np.arange(8000) / 800
    wave = np.exp(2j * np.pi * line.turns_at(time_s - 1.5 / 800))
    start = np.random.default_rng(4).spawn(2)[1].uniform(0, 2 * np.pi)
    size_m_s2 = 1e-9 * (2 * np.pi * line.frequency_hz_at(time_s)) ** 2 * line.amplitude_nm
    expected = np.real(-size_m_s2 * motion.factor * wave * np.exp(1j * start))
    assert np.abs(readings - expected)[5:].max() < 2e-3 * np.abs(expected).max()
