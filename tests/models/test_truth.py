"""A truth, its vibrations and sensors: processes, drift, schedules, and impossible values."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.signal import hilbert
from support.drifting import drifting
from support.refusals import require_refusals
from support.sensor_loops import FAST, SLOW

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.loop.disturbances import draw_disturbance
from lbt_synth.models import (
    Accelerometer,
    ARModel,
    LoopHardware,
    Motion,
    SensorSuite,
    SinusoidalVibration,
    SumSpectrum,
    TabulatedSpectrum,
    WavefrontSensor,
)
from lbt_synth.models.sensor_suite import checked_motions, period_frames
from lbt_synth.models.vibration import checked_direction

PATH = LoopHardware(frame_rate_hz=800, modes=1)
LOOP = LoopHardware(frame_rate_hz=1000, delay_frames=2, modes=2)
wavefront = partial(WavefrontSensor, name="truth", rate_hz=250, delay_frames=3, noise_nm=4.0)
readings = {"rate_hz": 1000, "delay_frames": 2, "noise_m_s2": 2e-4}
accelerometer = partial(Accelerometer, name="mirror", channels=("m1", "m2"), **readings)


def suite(*sensors):
    return SensorSuite(sensors=sensors)


def test_a_frequency_error_moves_each_vibration_by_its_share():
    lines = tuple(SinusoidalVibration(frequency_hz=f, rms_nm=9) for f in (0.3, 20.0, 40.0))
    truth = lbt.Truth(turbulence=None, vibrations=lines)
    stated, still = (replace(truth, frequency_errors_hz=e) for e in ((0.0, 2.0, 1.0), (0, 0, 0)))
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


def test_a_direction_is_scaled_once():
    """Else a gain file would move the lines that it holds by a last digit."""
    for vector in np.random.default_rng(0).standard_normal((10, 3)):
        line = drifting(direction=vector)
        assert np.linalg.norm(line.direction) == pytest.approx(1, rel=1e-15)
        assert replace(line, rms_nm=2).direction == line.direction
    assert drifting(direction=(3, 4)).direction == pytest.approx((0.6, 0.8))


@pytest.mark.parametrize(
    ("delay", "sensor", "age"),
    [
        (2, wavefront(), 11),
        (2.5, wavefront(delay_frames=1.5), 4.5),
        (1, wavefront(rate_hz=1000, delay_frames=1), 1),
        (2, accelerometer(), 1),
        (2, accelerometer(delay_frames=1), 0),
        (3, accelerometer(rate_hz=500, delay_frames=1.75), 1.5),
        (3, accelerometer(rate_hz=500, delay_frames=1.5), 1),
        (1.5, accelerometer(delay_frames=1), 0.5),
    ],
)
def test_ages(delay, sensor, age):
    assert sensor.age_frames(replace(LOOP, delay_frames=delay)) == pytest.approx(age)


def test_the_schedule_of_rates_that_do_not_divide_each_other():
    other = wavefront(name="other", rate_hz=100, sensor_matrix=[[1.0, 1.0]])
    sensors = suite(accelerometer(rate_hz=1000 / 3), wavefront(rate_hz=50), other)
    assert sensors.period(LOOP) == 60
    names, ends = ("wavefront", "truth", "other", "m1", "m2"), (0, 2, 4, 5, 6, 7)
    assert sensors.units == tuple(sensors.rows(LOOP)) == names
    assert [(row.start, row.stop) for row in sensors.rows(LOOP).values()] == [*pairwise(ends)]
    read = sensors.read(LOOP)
    assert read.shape == (60, 7)
    for column, period in ((0, 1), (2, 20), (5, 3)):
        assert np.flatnonzero(read[:, column]).tolist() == [*range(0, 60, period)]
    assert sensors.marked(("m2", "truth"), LOOP).tolist() == [0, 0, 1, 1, 0, 0, 1]


def test_the_noise_of_all_sensors():
    factor = suite(FAST, SLOW).noise_factor(np.diag([15.0, 15.0]), 2)
    expected = block_diag(225 * np.eye(2), SLOW.noise_nm, FAST.noise_m_s2)
    np.testing.assert_allclose(factor @ factor.T, expected)


def test_impossible_values_are_refused():
    process = partial(ARModel, coefficients=[0.5], frame_rate_hz=1)
    for make, key in (
        (lambda v: lbt.Vibration(frequency_hz=v, damping=0.1, rms_nm=1), "frequency_hz"),
        (lambda v: SinusoidalVibration(frequency_hz=1, rms_nm=v), "rms_nm"),
        (lambda v: process(driving_rms_nm=v), "driving_rms_nm"),
        (lambda v: lbt.Truth(turbulence=None, noise_nm=v), "noise_nm"),
        (lambda v: lbt.Imaging(diameter_m=v), "diameter_m"),
        (lambda v: LoopHardware(frame_rate_hz=1, delay_frames=v), "delay_frames"),
        (lambda v: lbt.models.nm_per_mas(v), "diameter_m"),
        (lambda v: TabulatedSpectrum(frequency_hz=[0, v], density_nm2_hz=[1, 1]), "frequency_hz"),
    ):
        require_refusals((partial(make, v), ProblemError, key) for v in (np.nan, np.inf, -2.0))


def test_refusals():
    late, moved = accelerometer(rate_hz=500, delay_frames=1.25), ({"m1": Motion(size=1)},)
    odd = (wavefront(rate_hz=1000 / 7), accelerometer(rate_hz=1000 / 211))
    strange = ({"m9": Motion(size=1)},)
    truth, still = lbt.Truth, partial(lbt.Truth, turbulence=None)
    line = partial(lbt.Vibration, frequency_hz=20, damping=0.1, rms_nm=1)
    table = partial(TabulatedSpectrum, density_nm2_hz=[1, 1])
    sensor = partial(lbt.models.pyramid_modal_noise_nm, modes=3)
    process = partial(ARModel, driving_rms_nm=1, frame_rate_hz=500)
    lines = {"vibrations": (SinusoidalVibration(frequency_hz=20, rms_nm=100),)}
    beyond = "below the Nyquist frequency 400 Hz; got 500 Hz"
    rows = [
        (lambda: truth(turbulence=[process(coefficients=[0.9]), 3.0]), "one per mode; got float"),
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
        (lambda: wavefront(delay_frames=0.5), "delay_frames.* at least 1"),
        (lambda: wavefront(noise_nm=0.0).noise_factor(2), "noise_nm.* positive|above 0"),
        (lambda: accelerometer(channels=()), r"channels of mirror .* at least one; got \(\)"),
        (lambda: accelerometer(channels=("m1", "m1")), "channels of mirror must be different"),
        (lambda: wavefront(sensor_matrix=np.eye(3)).response(2), "must have 2 columns"),
        (lambda: wavefront(delay_frames=1).age_frames(LOOP), "at least 1.25 of its frames.*got 1"),
        (lambda: late.age_frames(replace(LOOP, delay_frames=3)), "1.5 of its frames.*got 1.25"),
        (lambda: period_frames(wavefront(rate_hz=300), LOOP), "whole multiple .*got 300 Hz"),
        (lambda: period_frames(wavefront(rate_hz=0.5), LOOP), "up to 1000"),
        (lambda: suite(wavefront(name="wavefront")), "none of them 'wavefront'"),
        (lambda: suite(accelerometer(), wavefront(name="m1")), "different names"),
        (lambda: suite(*odd).period(LOOP), "at most 1000 frames; got 1477"),
        (lambda: suite(wavefront()).marked(("m9",), LOOP), "'m9'; there are wavefront, truth"),
        (lambda: checked_motions(strange, suite(FAST), 1), "'m9'; the channels are m1, m2"),
        (lambda: checked_motions(moved, suite(SLOW), 1), "the channels are none"),
        (lambda: checked_motions(({},), suite(FAST), 2), r"one mapping per vibration \(2\); got 1"),
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
