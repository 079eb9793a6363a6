"""Readings of accelerometers from files: units, rates, clocks, and what is missing."""

import numpy as np
import pytest

from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.identification.accelerometers.readings import load_readings, read_channels, resample

RATE = 1000.0
FRAMES = 4000


def shaking(rate_hz, count):
    """Return the means of two channels over the periods of a clock."""
    time_s = (np.arange(count) + 0.5) / rate_hz
    return np.column_stack(
        [
            np.sinc(31 / rate_hz) * np.sin(2 * np.pi * 31 * time_s),
            0.3 * np.sinc(77 / rate_hz) * np.cos(2 * np.pi * 77 * time_s + 1),
        ]
    )


def test_readings_of_any_rate_lie_on_the_frames(tmp_path):
    for rate_hz in (1000.2, 2500.0):
        laid = resample(shaking(rate_hz, int(FRAMES * rate_hz / RATE) + 1), rate_hz, RATE)
        assert len(laid) == FRAMES
        inner = slice(10, -10)
        np.testing.assert_allclose(laid[inner], shaking(RATE, FRAMES)[inner], atol=1e-3)
    np.save(tmp_path / "a.npy", np.zeros((100, 2)))
    for rate_hz, words in ((1e9, "Is the rate right"), (0, "above 0"), (999, "once a frame")):
        with pytest.raises(ProblemError, match=words):
            load_readings(tmp_path / "a.npy", RATE, rate_hz=rate_hz)


def test_a_file_of_two_rates_is_asked_for_one(tmp_path):
    file = write(tmp_path / "two.csv", "# fs = 1000\n# loop_rate = 500\na,b", *shaking(RATE, 50).T)
    with pytest.raises(ProblemError, match="twice: 1000 by the comment fs, 500 by the comment"):
        load_readings(file, RATE)
    assert len(load_readings(file, RATE, rate_hz=RATE)[1]) == 50


def test_faster_readings_are_averaged():
    own = 9.81 + np.random.default_rng(0).standard_normal((3 * 500, 2))
    np.testing.assert_allclose(
        resample(own, 3 * RATE, RATE), own.reshape(500, 3, 2).mean(axis=1), rtol=1e-12
    )
    own[:, 0] = 9.81
    np.testing.assert_allclose(resample(own, 1024, RATE)[:, 0], 9.81, rtol=1e-12)


def test_frames_beside_a_missing_reading_are_missing():
    own = shaking(1024, 2000)
    own[700, 1] = np.nan
    gone = np.flatnonzero(np.isnan(resample(own, 1024, RATE)[:, 1]))
    assert 1 <= len(gone) <= 2
    assert abs(gone[0] - 700 / 1.024) < 2
    assert np.isfinite(resample(own, 1024, RATE)[:, 0]).all()


def write(path, heading, *columns):
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=heading, comments="")
    return path


def test_times_give_the_rate_and_the_gaps(tmp_path):
    time_s, series = (np.arange(4100) + 0.5) / 1024, shaking(1024, 4100)
    time_s, series = (np.delete(x, slice(2000, 2040), axis=0) for x in (time_s, series))
    time_s += 1e-6 * np.random.default_rng(0).standard_normal(len(time_s))  # of a clock
    path = write(tmp_path / "a.csv", "t,m1,m2", 1e3 + time_s, *series.T)
    channels, values, notes = load_readings(path, RATE)
    assert channels == ("m1", "m2")
    missing = np.isnan(values[:, 0])
    assert 38 <= missing.sum() <= 42
    good = slice(2200, 3900)
    expected = shaking(RATE, len(values))
    np.testing.assert_allclose(values[good], expected[good], atol=1e-3)
    assert any("Hz, from the times" in note for note in notes)


def test_units_of_headings_count(tmp_path):
    series = shaking(RATE, 200)
    for unit, factor in (("g", 9.80665), ("m/s^2", 1.0), ("m s-2", 1.0), ("mm/s2", 1e-3)):
        path = write(tmp_path / "a.csv", f"m1 [{unit}],m2 [{unit}]", *series.T)
        np.testing.assert_allclose(load_readings(path, RATE)[1], factor * series, rtol=1e-9)
    write(path, "m1,m2", *(series + np.array([9, 0])).T)
    (note,) = (note for note in load_readings(path, RATE)[2] if "offset" in note)
    assert "m1 have an offset" in note
    write(path, "m1 [mm/s2],m2 [mm/s2]", *series.T)
    with pytest.raises(TelemetryError, match="acceleration_unit says g"):
        load_readings(path, RATE, unit="g")
    path = write(tmp_path / "a.csv", "m1 [mV],m2 [mV]", *series.T)
    with pytest.raises(TelemetryError, match="'mV', and acceleration_unit says None. Scale them"):
        load_readings(path, RATE)
    np.testing.assert_allclose(load_readings(path, RATE, unit="mg")[1], 9.80665e-3 * series)


def test_held_values_and_spikes_are_missing_and_short_gaps_bridged():
    rng = np.random.default_rng(1)
    truth = shaking(RATE, FRAMES) + 0.01 * rng.standard_normal((FRAMES, 2))
    given = truth.copy()
    given[1000:1300] = 0.0
    given[2000, 0], given[3000, 1] = np.nan, 50.0
    read = read_channels(given)
    values, good = read.values, read.good
    assert not good[1000:1300].any()
    assert good[:1000].all()
    assert good[1300:].all()
    np.testing.assert_allclose(values[1300:], truth[1300:], atol=0.2)


def test_a_channel_that_stops_spoils_no_frame_of_the_others():
    given = np.random.default_rng(1).standard_normal((FRAMES, 2))
    given[1000:, 1] = given[1000, 1]
    read = read_channels(given)
    assert (read.names, read.dead) == (("channel1",), ("channel2",))
    assert read.good.all()
    np.testing.assert_array_equal(read.values[:, 0], given[:, 0])
