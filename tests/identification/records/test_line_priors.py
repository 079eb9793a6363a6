"""Lines known beforehand: lists, and accelerometers beside the wavefront."""

import numpy as np
import pytest
from scipy.signal import coherence, lfilter

import lbt_synth as lbt
from lbt_synth.identification import LinePrior, accelerometer_lines, load_lines

RATE = 1000.0


def resonance(frequency_hz, damping, frames, seed):
    w = 2 * np.pi * frequency_hz / RATE
    a = [
        1,
        -2 * np.exp(-damping * w) * np.cos(w * np.sqrt(1 - damping**2)),
        np.exp(-2 * damping * w),
    ]
    x = lfilter([1.0], a, np.random.default_rng(seed).standard_normal(frames))
    return x / x.std()


def pairs(lines):
    return [(line.frequency_hz, line.frequency_error_hz) for line in load_lines(lines)]


def test_lists():
    known = LinePrior(frequency_hz=12, frequency_error_hz=0.3, source="log book")
    assert pairs([45.5, (16, 0.2), known]) == [(12.0, 0.3), (16.0, 0.2), (45.5, 0.0)]
    assert load_lines([45.5, known])[0] is known
    assert pairs(np.array([[20.0, 1.0], [10.0, 2.0]]))[0] == (10.0, 2.0)
    assert load_lines([]) == ()


def test_files(tmp_path):
    path = tmp_path / "lines.csv"
    for heading in ("frequency_error_hz,frequency_hz", "Error [Hz],Frequency [Hz]", "sigma,f"):
        path.write_text(f"{heading}\n0.1,20\n,45\n")
        assert pairs(path) == [(20.0, 0.1), (45.0, 0.0)]
    path.write_text("frequency_hz,error_hz\n45.5,0.3\n16,\n")
    assert pairs(path) == [(16, 0), (45.5, 0.3)]
    assert load_lines(path)[0].source == str(path)
    path.write_text("20\n30.5\n")
    assert [frequency for frequency, _ in pairs(str(path))] == [20, 30.5]


@pytest.mark.parametrize(
    ("lines", "error", "words"),
    [
        ([0.0], lbt.errors.ProblemError, "frequency_hz must be above 0"),
        ([(20, -1)], lbt.errors.ProblemError, "frequency_error_hz must be at least 0"),
        ([(20, 1, 2)], lbt.errors.ProblemError, "a pair of frequency and error"),
        (["20 Hz"], lbt.errors.ProblemError, "must be a number"),
        (20.0, lbt.errors.ProblemError, "a file or a list of frequencies; got float"),
        ("lines.xml", lbt.errors.TelemetryError, "a list of lines must end in .csv"),
        ("nowhere.csv", lbt.errors.TelemetryError, "cannot read nowhere.csv: No such file"),
    ],
)
def test_lines_that_are_refused(lines, error, words):
    with pytest.raises(error, match=words):
        load_lines(lines)
    with pytest.raises(lbt.errors.ProblemError, match="source must be a text"):
        LinePrior(frequency_hz=1, source=3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,2,3\n", "one or two columns"),
        ("-5\n", "frequency_hz must be above 0"),
        ("", "has no rows"),
        ("a\nb\n", "must be a number; got 'b'"),
    ],
)
def test_files_that_are_refused(tmp_path, text, words):
    path = tmp_path / "lines.txt"
    path.write_text(text)
    with pytest.raises(lbt.errors.TelemetryError, match=words) as caught:
        load_lines(path)
    assert str(path) in str(caught.value)


def test_lines_that_both_feel_are_found_and_no_others():
    """Two shared resonances under turbulence; one more in each that the other does not feel."""
    frames = 60_000
    rng = np.random.default_rng(5)
    shared = [resonance(20.0, 0.01, frames, 1), resonance(47.3, 0.004, frames, 2)]
    walk = np.cumsum(rng.standard_normal(frames))
    own = resonance(33.0, 0.005, frames, 3)
    z = 100 * shared[0] + 40 * shared[1] + 5 * walk + 50 * own + 15 * rng.standard_normal(frames)
    a = np.column_stack(
        [
            shared[0] + resonance(70.0, 0.005, frames, 4) + rng.standard_normal(frames),
            0.5 * shared[1] + 0.5 * rng.standard_normal(frames),
        ]
    )
    found = accelerometer_lines(a, z, RATE)
    assert len(found) == 2
    for line, truth in zip(found, (20.0, 47.3), strict=True):
        assert abs(line.frequency_hz - truth) < 3 * line.frequency_error_hz
        assert 0 < line.frequency_error_hz < 0.6
        assert "false alarm 0.001" in line.source
    # the other axis of a wavefront feels nothing
    both = accelerometer_lines(a, np.column_stack([15 * rng.standard_normal(frames), z]), RATE)
    assert [line.frequency_hz for line in both] == pytest.approx(
        [line.frequency_hz for line in found], abs=0.1
    )


def test_false_alarms_are_as_rare_as_stated():
    """Coloured independent series, 150 times, at 20 %: binomial, 30 +- 5 expected at most."""
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(150):
        a = lfilter([1.0], [1, -0.9], rng.standard_normal(8192))
        z = lfilter([1.0], [1, -1.2, 0.9], rng.standard_normal((8192, 2)), axis=0)
        hits += bool(
            accelerometer_lines(a, z, RATE, segment_frames=256, false_alarm=0.2, lowest_hz=4)
        )
    assert 10 <= hits <= 45  # peaks have to be maxima, too: a little below 30


def test_the_coherence_is_that_of_scipy():
    """The loudest line of a record is where scipy's coherence, of differences, is largest."""
    frames = 40_000
    rng = np.random.default_rng(8)
    line = resonance(61.7, 0.002, frames, 6)
    a, z = line + rng.standard_normal(frames), 3 * line + rng.standard_normal(frames)
    (found,) = accelerometer_lines(a, z, RATE, segment_frames=2000)
    f, c = coherence(np.diff(a), np.diff(z), fs=RATE, nperseg=2000, noverlap=0)
    assert abs(f[np.argmax(c)] - found.frequency_hz) <= f[1]


def test_segments_with_holes_are_left_out():
    frames = 40_000
    rng = np.random.default_rng(2)
    shake = np.cos(2 * np.pi * 25 * np.arange(frames) / RATE)
    a, z = shake + rng.standard_normal(frames), shake + rng.standard_normal(frames)
    usable = np.ones(frames, dtype=bool)
    usable[10_000:10_500] = False
    z[10_000:10_500] = 1e6  # fillers may be anything
    (line,) = accelerometer_lines(a, z, RATE, usable=usable)
    assert abs(line.frequency_hz - 25) < 0.3
    usable[:-8000] = False
    with pytest.raises(
        lbt.errors.ProblemError, match="at least 8 segments of 1249 usable frames; got 6"
    ):
        accelerometer_lines(a, z, RATE, usable=usable)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"measurement": np.ones(99)}, "as many frames; got 100 and 99"),
        ({"accelerations": np.ones((2, 2, 2))}, r"must be \(frames, columns\)"),
        ({"accelerations": [np.nan] * 100}, "accelerations must be finite"),
        ({"frame_rate_hz": -1}, "frame_rate_hz must be above 0"),
        ({"false_alarm": 1.0}, "false_alarm must be below 1"),
        ({"segment_frames": 10}, "segment_frames must be at least 64"),
        ({"usable": [1, 0]}, "usable must be 100 truth values"),
        ({}, "coherence needs at least 8 segments of 64 usable frames; got 1"),
    ],
)
def test_accelerations_that_are_refused(change, words):
    given = {"accelerations": np.ones(100), "measurement": np.ones(100), "frame_rate_hz": RATE}
    with pytest.raises(lbt.errors.ProblemError, match=words):
        accelerometer_lines(**{**given, **change})
