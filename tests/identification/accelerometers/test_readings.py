"""Readings of accelerometers from files: units, rates, clocks, and what is missing."""

from functools import partial

import numpy as np
from support.refusals import refused

from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.identification.accelerometers.readings import load_readings, read_channels, resample

RATE = 1000.0
FRAMES = 4000


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
        laid = resample(shaking(rate_hz, int(FRAMES * rate_hz / RATE) + 1), rate_hz, RATE)
        assert len(laid) == FRAMES
        np.testing.assert_allclose(laid[10:-10], shaking(RATE, FRAMES)[10:-10], atol=1e-3)
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
    truth = shaking(RATE, FRAMES) + 0.01 * np.random.default_rng(1).standard_normal((FRAMES, 2))
    given = truth.copy()
    given[1000:1300] = 0.0
    given[2000, 0], given[3000, 1] = np.nan, 50.0
    read = read_channels(given)
    frame = np.arange(FRAMES)
    assert np.array_equal(read.good, (frame < 1000) | (frame >= 1300))
    np.testing.assert_allclose(read.values[1300:], truth[1300:], atol=0.2)


def test_a_channel_that_stops_spoils_no_frame_of_the_others():
    given = np.random.default_rng(1).standard_normal((FRAMES, 2))
    given[1000:, 1] = given[1000, 1]
    read = read_channels(given)
    assert (read.names, read.dead) == (("channel1",), ("channel2",))
    assert read.good.all()
    np.testing.assert_array_equal(read.values[:, 0], given[:, 0])
