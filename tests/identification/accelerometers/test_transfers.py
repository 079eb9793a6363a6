"""Readings of accelerometers: units and clocks, how they move with lines, what is left out."""

import tracemalloc
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from scipy.signal import lfilter
from support.oscillators import KickedOscillator
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.identification import loop_record
from lbt_synth.identification.accelerometers.readings import load_readings, read_channels, resample
from lbt_synth.identification.accelerometers.transfers import accelerometer_transfers
from lbt_synth.loop.disturbances import draw_others, draw_phase
from lbt_synth.models import Accelerometer, Motion, SensorSuite

RATE = 1000.0
FRAMES = 20_000
MARGIN = 300
READ = 4000  # frames of readings
# frequency [Hz], damping, rms [nm], axis
LINES = ((14.0, 0.02, 60.0, 0), (31.0, 0.01, 50.0, 1), (56.0, 0.01, 40.0, 0))


@cache
def night():
    """An open loop, the mean accelerations [m/s^2] of its lines, a frame earlier, and its model."""
    rng = np.random.default_rng(3)
    accelerations, seen = [], np.zeros((FRAMES, 2))
    for frequency, damping, rms, axis in LINES:
        w = 2 * np.pi * frequency
        oscillator = KickedOscillator(w / RATE, damping, rms, steps=8)
        position, acceleration = oscillator.draw(FRAMES + 2 * MARGIN, rng)
        accelerations.append(1e-9 * w**2 * acceleration)
        seen[:, axis] += position[MARGIN - 1 : MARGIN - 1 + FRAMES]
    seen += 8 * rng.standard_normal(seen.shape)
    record = loop_record(seen, frame_rate_hz=RATE, unit="nm")
    return record, np.array(accelerations), lbt.identify(record)


def reading(*factors: float, age: int = 1, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Return a channel that moves with the lines by real factors, as old as ``age``."""
    total = np.asarray(factors) @ night()[1][: len(factors)]
    noisy = noise * np.random.default_rng(seed).standard_normal(FRAMES)
    return np.asarray(total[MARGIN - age : MARGIN - age + FRAMES] + noisy)


def find(*channels: np.ndarray, model=None, **options):
    record, _, fitted = night()
    return accelerometer_transfers(model or fitted, record, np.column_stack(channels), **options)


def line_index(row) -> int:
    return int(np.argmin([abs(f - row.frequency_hz) for f, *_ in LINES]))


def phase_error(row, phase_deg: float) -> float:
    return abs((row.phase_deg - phase_deg + 180) % 360 - 180)


def test_factors_shift_and_noise_are_those_of_the_channels():
    noise, truth = 2e-3, {"channel1": (2.0, -0.7, 1.3), "channel2": (0.0, 1.1, 0.4)}
    found = find(*(reading(*row, noise=noise, seed=k) for k, row in enumerate(truth.values())))
    assert found.age_frames == 1
    assert abs(found.shift_frames) < 4 * found.shift_error_frames < 1
    for row in found.transfers:
        factor = truth[row.channel][line_index(row)]
        assert row.useful == (factor != 0)
        if factor:
            assert abs(row.motion_nm_per_nm - abs(factor)) < 4 * row.motion_error_nm_per_nm
            assert row.motion_error_nm_per_nm < 0.05 * abs(factor)
            assert phase_error(row, 180 * (factor < 0)) < 4 * row.phase_error_deg < 15
            assert row.coherence > 0.5
    for row in found.channels:
        assert row.noise_m_s2 == pytest.approx(noise, rel=0.2)
    assert [row.verdict for row in found.channels] == ["used", "used"]


def test_errors_count_that_of_the_sensor_gain():
    """Of an open loop the gain scales the wavefront: motions are as uncertain as it, phases not."""
    channel, (*_, model) = reading(2.0, -0.7, 1.3, noise=2e-3), night()
    axes = tuple(replace(axis, sensor_gain_error=0.05) for axis in model.axes)
    exact, found = find(channel), find(channel, model=replace(model, axes=axes))
    for known, row in zip(exact.transfers, found.transfers, strict=True):
        assert row.motion_nm_per_nm == known.motion_nm_per_nm
        # a gain of 1.05 instead of 1 makes the wavefront smaller by 1 - 1 / 1.05
        scale = row.motion_nm_per_nm * (1 - 1 / 1.05)
        expected = np.hypot(known.motion_error_nm_per_nm, scale)
        assert row.motion_error_nm_per_nm == pytest.approx(expected, rel=0.02)
        assert row.phase_error_deg == pytest.approx(known.phase_error_deg, rel=0.02)
    assert found.shift_error_frames == pytest.approx(exact.shift_error_frames, rel=0.02)


@pytest.mark.parametrize("age", [6, -4321, 1.3])
def test_readings_of_any_age_are_laid_beside_the_wavefront(age):
    """The phases hold for the age that is found, which the slope within the lines tells."""
    frames = max(int(age), 0)
    late, later = (reading(2.0, -0.7, 1.3, age=frames + k, noise=1e-3) for k in (0, 1))
    found = find(((1 - age % 1) * late + age % 1 * later)[max(-int(age), 0) :])
    assert abs(found.shift_frames - (age - 1)) < 4 * found.shift_error_frames < 2
    assert found.age_frames == 1 + round(found.shift_frames)
    assert "by the slope of the phase" in found.shift_text
    for row in found.transfers:
        j = line_index(row)
        phase = 360 * LINES[j][0] / RATE * (found.age_frames - age) + 180 * (j == 1)
        assert row.useful
        assert phase_error(row, phase) < 5 * row.phase_error_deg


def test_channels_see_wide_resonances_too():
    """A channel that moves twice as far, whose second differences are 1 % below accelerations."""
    model = lbt.Vibration(frequency_hz=60, damping=0.2, rms_nm=100).ar_model(1000)
    rng = np.random.default_rng(1)
    drive = model.driving_rms_nm * rng.standard_normal(FRAMES + 2)
    v = lfilter([1], [1, *-model.coefficients], drive)
    air = lfilter([10], [1, -0.999], rng.standard_normal(FRAMES))
    a = 2e-9 * 1e6 * np.diff(v, 2) + 1e-3 * rng.standard_normal(FRAMES)
    z = v[1:-1] + air + 5 * rng.standard_normal(FRAMES)
    record = loop_record(z, frame_rate_hz=1000, unit="nm")
    (row,) = accelerometer_transfers(lbt.identify(record), record, a).transfers
    assert row.useful
    assert row.motion_nm_per_nm == pytest.approx(1.98, abs=4 * row.motion_error_nm_per_nm)
    assert abs(row.phase_deg) < 4 * row.phase_error_deg


def test_a_run_gives_the_motions_back():
    """Second differences of samples are smaller than accelerations: by 2 % at 60, 11 % at 150 Hz."""
    rate_hz, delay_frames, unit = 800.0, 1.4, {"frame_rate_hz": 800.0, "unit": "nm"}
    lines = tuple(
        lbt.Vibration(frequency_hz=f, damping=0.005, rms_nm=60, direction=d)
        for f, d in ((60.0, (1, 0)), (150.0, (0, 1)))
    )
    motions = ({"m1": Motion(size=2.0, phase_deg=30)}, {"m1": Motion(size=0.4, phase_deg=-120)})
    timing = {"rate_hz": rate_hz, "delay_frames": delay_frames, "channels": ("m1",)}
    suite = SensorSuite(sensors=(Accelerometer(name="mirror", noise_m_s2=1e-3, **timing),))
    path = lbt.LoopHardware(frame_rate_hz=rate_hz, delay_frames=2, modes=2, suite=suite)
    truth = lbt.Truth(turbulence=None, vibrations=lines, motions=motions)
    size, rng = {"frames": 16_000, "cases": 1, "zero_frame": 0}, np.random.default_rng(1)
    _, drawn = draw_phase(truth, path, rng=rng, oscillators=True, **size)
    read = draw_others(truth, path, drawn, rng, **size)[0, 1:]
    # the wavefront sensor measures in frame k the phase of frame k - 1
    seen = np.stack([np.roll(motion[0], 1) for motion, _ in drawn], axis=1)
    seen += 8 * rng.standard_normal(seen.shape)
    record = loop_record(seen[1:], **unit)
    found = accelerometer_transfers(lbt.identify(record), record, read, largest_shift_s=0.01)
    rows = [row for row in found.transfers if row.coherence > 0.9]  # of the lines alone
    for row, line, motion in zip(rows, lines, motions, strict=True):
        late = 360 * line.frequency_hz / rate_hz * (found.age_frames - (delay_frames - 1))
        size_nm, phase_deg = motion["m1"].size, motion["m1"].phase_deg + late
        assert abs(row.motion_nm_per_nm / size_nm - 1) < 0.005
        assert abs(row.motion_nm_per_nm - size_nm) < 4 * row.motion_error_nm_per_nm
        assert phase_error(row, phase_deg) < min(4 * row.phase_error_deg, 0.5)


def test_a_shift_that_is_not_sure_moves_no_readings():
    found = find(reading(0.0, 1.5, age=3, noise=1e-2))
    assert found.age_frames == 1
    assert abs(found.shift_frames - 2) < 3 * found.shift_error_frames
    (row,) = (row for row in found.transfers if row.useful)
    assert phase_error(row, -2 * 360 * LINES[1][0] / RATE) < 5 * row.phase_error_deg


def test_channels_that_fail_are_named_and_left_out():
    rng, good = np.random.default_rng(8), reading(2.0, -0.7, 1.3, noise=1e-3)
    gone = np.where(np.arange(FRAMES) < FRAMES // 4, np.nan, good)
    flicker, noise = 1e-3 * rng.integers(0, 2, FRAMES), 1e-2 * rng.standard_normal(FRAMES)
    found = find(good, np.full(FRAMES, 3.3), flicker, gone, 1e-200 * good, noise)
    verdicts = {int(row.channel[-1]): row.verdict for row in found.channels}
    dead, silent = dict.fromkeys((2, 4, 5), "dead"), dict.fromkeys((3, 6), "adds nothing")
    assert verdicts == {1: "used"} | dead | silent
    assert [row.channel for row in found.used] == ["channel1"]


def test_no_more_channels_are_used_than_a_design_takes():
    noises = (1e-2, 1e-3, 2e-3, 1e-3, 2e-2, 3e-3, 2e-3)
    found = find(*(reading(2.0, -0.7, 1.3, noise=x, seed=k) for k, x in enumerate(noises)))
    assert [row.channel for row in found.used] == [f"channel{k}" for k in (2, 3, 4, 6, 7)]
    for k in (0, 4):
        assert "a design takes 5 channels" in found.channels[k].verdict


def test_motions_at_the_frequency_of_a_line_that_do_not_go_with_it_are_not_used():
    model = lbt.Vibration(frequency_hz=31.0, damping=0.01, rms_nm=50).ar_model(RATE)
    drives, noise = np.random.default_rng(0).standard_normal((2, 12, FRAMES))
    alone = lfilter([model.driving_rms_nm], [1, *-model.coefficients], drives)
    assert find(*(1e-5 * alone + 1e-4 * noise), largest_shift_s=0.1).used == ()


def test_readings_that_are_refused():
    named = {"channels": ["a", "a"]}
    rows = [
        (np.ones((100, 2, 2)), {}, r"must be \(frames, channels\)"),
        (np.ones((FRAMES, 2)), named, "2 different names"),
        (np.random.default_rng(0).standard_normal(100), {}, "usable frames in a row"),
    ]
    record, _, model = night()
    require_refusals(
        (partial(accelerometer_transfers, model, record, series, **options), ProblemError, words)
        for series, options, words in rows
    )


@pytest.mark.study
def test_a_record_of_39_s_and_5_channels_takes_little_memory():
    """Each second took 50 MB where all shifts of a wide band were tried at once."""
    rng = np.random.default_rng(0)
    line = lbt.Vibration(frequency_hz=90, damping=0.02, rms_nm=60).ar_model(1000)
    v = lfilter([line.driving_rms_nm], [1, *-line.coefficients], rng.standard_normal(39_000))
    record = loop_record(v + 5 * rng.standard_normal(v.size), frame_rate_hz=1000, unit="nm")
    a = -1e-9 * (2 * np.pi * 90) ** 2 * v[:, None] + 1e-3 * rng.standard_normal((v.size, 5))
    model = lbt.identify(record)
    tracemalloc.start()
    used = accelerometer_transfers(model, record, a).used
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(used) == 5
    assert peak_bytes < 200e6


def shaking(rate_hz, count):
    """Return the means of two channels over the periods of a clock."""
    time_s, f = (np.arange(count)[:, None] + 0.5) / rate_hz, np.array([31, 77])
    wave = [1, 0.3] * np.sin(2 * np.pi * f * time_s + [0, 1 + np.pi / 2])
    return np.sinc(f / rate_hz) * wave


def write(path, heading, *columns):
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=heading, comments="")
    return path


def test_readings_of_any_rate_lie_on_the_frames(tmp_path):
    for rate_hz in (1000.2, 2500.0):
        laid = resample(shaking(rate_hz, int(READ * rate_hz / RATE) + 1), rate_hz, RATE)
        assert len(laid) == READ
        np.testing.assert_allclose(laid[10:-10], shaking(RATE, READ)[10:-10], atol=1e-3)
    np.save(tmp_path / "a.npy", np.zeros((100, 2)))
    for rate_hz, words in ((1e9, "Is the rate right"), (0, "above 0"), (999, "once a frame")):
        refused(
            partial(load_readings, tmp_path / "a.npy", RATE, rate_hz=rate_hz), ProblemError, words
        )


def test_a_file_of_two_rates_is_asked_for_one(tmp_path):
    file = write(tmp_path / "two.csv", "# fs = 1000\n# loop_rate = 500\na,b", *shaking(RATE, 50).T)
    words = "twice: 1000 by the comment fs, 500 by the comment"
    refused(lambda: load_readings(file, RATE), ProblemError, words)
    assert len(load_readings(file, RATE, rate_hz=RATE)[1]) == 50


def test_faster_readings_are_averaged():
    own = 9.81 + np.random.default_rng(0).standard_normal((3 * 500, 2))
    means = own.reshape(500, 3, 2).mean(axis=1)
    np.testing.assert_allclose(resample(own, 3 * RATE, RATE), means, rtol=1e-12)
    own[:, 0] = 9.81
    np.testing.assert_allclose(resample(own, 1024, RATE)[:, 0], 9.81, rtol=1e-12)


def test_frames_beside_a_missing_reading_are_missing():
    own = shaking(1024, 2000)
    own[700, 1] = np.nan
    gone = np.isnan(resample(own, 1024, RATE))
    assert not gone[:, 0].any()
    assert 1 <= gone[:, 1].sum() <= 2
    assert abs(np.argmax(gone[:, 1]) - 700 / 1.024) < 2


def test_times_give_the_rate_and_the_gaps(tmp_path):
    kept = np.delete(np.arange(4100), slice(2000, 2040))
    jitter = 1e-6 * np.random.default_rng(0).standard_normal(len(kept))  # of a clock
    time_s, series = 1e3 + (kept + 0.5) / 1024 + jitter, shaking(1024, 4100)[kept]
    path = write(tmp_path / "a.csv", "t,m1,m2", time_s, *series.T)
    channels, values, notes = load_readings(path, RATE)
    assert channels == ("m1", "m2")
    assert 38 <= np.isnan(values[:, 0]).sum() <= 42
    good = slice(2200, 3900)
    np.testing.assert_allclose(values[good], shaking(RATE, len(values))[good], atol=1e-3)
    assert any("Hz, from the times" in note for note in notes)


def test_units_of_headings_count(tmp_path):
    series, path = shaking(RATE, 200), tmp_path / "a.csv"
    for unit, factor in (("g", 9.80665), ("m/s^2", 1.0), ("m s-2", 1.0), ("mm/s2", 1e-3)):
        write(path, f"m1 [{unit}],m2 [{unit}]", *series.T)
        np.testing.assert_allclose(load_readings(path, RATE)[1], factor * series, rtol=1e-9)
    refused(lambda: load_readings(path, RATE, unit="g"), TelemetryError, "acceleration_unit says g")
    write(path, "m1,m2", *(series + np.array([9, 0])).T)
    (note,) = (note for note in load_readings(path, RATE)[2] if "offset" in note)
    assert "m1 have an offset" in note
    write(path, "m1 [mV],m2 [mV]", *series.T)
    words = "'mV', and acceleration_unit says None. Scale them"
    refused(lambda: load_readings(path, RATE), TelemetryError, words)
    np.testing.assert_allclose(load_readings(path, RATE, unit="mg")[1], 9.80665e-3 * series)


def test_held_values_and_spikes_are_missing_and_short_gaps_bridged():
    truth = shaking(RATE, READ) + 0.01 * np.random.default_rng(1).standard_normal((READ, 2))
    given = truth.copy()
    given[1000:1300] = 0.0
    given[2000, 0], given[3000, 1] = np.nan, 50.0
    read = read_channels(given)
    frame = np.arange(READ)
    assert np.array_equal(read.good, (frame < 1000) | (frame >= 1300))
    np.testing.assert_allclose(read.values[1300:], truth[1300:], atol=0.2)


def test_a_channel_that_stops_spoils_no_frame_of_the_others():
    given = np.random.default_rng(1).standard_normal((READ, 2))
    given[1000:, 1] = given[1000, 1]
    read = read_channels(given)
    assert (read.names, read.dead) == (("channel1",), ("channel2",))
    assert read.good.all()
    np.testing.assert_array_equal(read.values[:, 0], given[:, 0])
