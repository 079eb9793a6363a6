"""Records: gaps, faults, commands and clocks, the pseudo-open loop, bridges and halves."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter
from support.predictions import SHELL
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification import LoopRecord, loop_record
from lbt_synth.identification.records.record import cut_stretches, require_length, split_halves
from lbt_synth.models import ARModel

RATE = 1000.0
SLOW = ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=RATE)
LINE = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=300, direction=[0.6, 0.8])
laid = partial(loop_record, unit="nm")  # by clocks, unless a rate is stated
at_rate = partial(laid, frame_rate_hz=RATE)


def ran(*, noise_nm=0.0, lines=(LINE,), gain=0.1, frames=300, delay_frames=2.0):
    """Measurements and commands of an integrator's loop, (frames, 2) each."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay_frames)
    truth = lbt.Truth(turbulence=SLOW, noise_nm=noise_nm, vibrations=lines)
    controller = lbt.integrator(path, gain=gain).controller
    run = lbt.simulate(controller, truth, hardware=path, frames=frames, seed=3)
    return run.measurements[0], run.commands[0]


def noise(frames):
    return np.random.default_rng(0).standard_normal(frames)


def kinds(seen):
    return {(finding.kind, finding.series, finding.axis) for finding in seen.findings}


def findings(seen):
    """What was found in a record: kind, series, axis, frames, the first of them."""
    return [(f.kind, f.series, f.axis, f.count, f.first_frame) for f in seen.findings]


def test_gaps_of_every_kind():
    y = 10 * np.random.default_rng(1).standard_normal((2000, 2))
    y[100, 0], y[200:203, 1], y[300, 1] = np.nan, np.inf, -3e105
    y = np.ma.masked_array(y, mask=y == y[400, 1])
    y[500:540, 0] = y[500, 0]
    seen = at_rate(y)
    assert findings(seen) == [
        ("not finite", "measurements", 0, 1, 100),
        ("stuck", "measurements", 0, 40, 500),
        ("not finite", "measurements", 1, 5, 200),
    ]
    ends = np.reshape([0, 100, 101, 200, 203, 300, 301, 400, 401, 500, 540, 2000], (-1, 2))
    assert np.array_equal(seen.stretches(), ends)
    assert np.all(np.isfinite(seen.measurements))
    assert seen.summary() == (
        "1954 of 2000 frames are usable; 1 not finite (measurements), 40 stuck (measurements), "
        "5 not finite (measurements)."
    )


def test_clipped_commands_spoil_their_corrections():
    y, commands = ran(frames=3000, noise_nm=5)
    u = np.clip(commands, -250, None)
    u[1000:1100] = 0.0  # the loop was open, and zeros are no end of a range
    seen = at_rate(y, u, delay_frames=2)
    clipped = np.any(commands < -250, axis=1) & np.all(u != 0, axis=1)
    assert clipped.sum() > 5
    assert np.array_equal(~seen.usable, np.append([True, True], clipped[:-2]))


def test_a_scatter_that_changes_is_said():
    y = np.random.default_rng(0).standard_normal((4000, 2))
    seen = at_rate(y * np.linspace([1, 1], [1, 6], 4000))
    (note,) = seen.notes
    assert note.startswith("axis 1 is not stationary: ")
    assert note.endswith("of two frames in the first quarter is 31 % of that in the last")
    assert seen.usable.all()


def test_half_a_million_clean_frames_show_nothing():
    seen = at_rate(np.random.default_rng(11).standard_normal((500_000, 1)))
    assert (seen.findings, seen.notes) == ((), ())
    assert seen.usable.all()


@pytest.mark.parametrize("step", [None, 30.0], ids=["fine", "30 nm"])
def test_strong_lines_and_coarse_numbers_are_no_faults(step):
    """Beside a turbulence of 592 nm: no line, a sinusoid, a burst, and one of high frequency."""
    rng, t = np.random.default_rng(0), np.arange(30_000) / RATE
    y = lfilter([1.2], [1, -1.997477, 0.997555], rng.standard_normal(50_000))[20_000:]
    burst = 800 * np.exp(-(((t - 15) / 0.8) ** 2))
    for size, hz in ((0, 0), (707, 20), (burst, 60), (500, 340)):
        seen = y * 592 / y.std() + size * np.cos(2 * np.pi * hz * t + 1)
        seen = seen + (0.5 if step is None else 15.5) * rng.standard_normal(t.size)
        assert findings(at_rate(seen if step is None else step * np.round(seen / step))) == []


def test_resonances_and_closed_loops_are_no_faults():
    sharp = lbt.Vibration(frequency_hz=45, damping=0.003, rms_nm=800, direction=[1.0, 0.2])
    loop = ran(gain=0.3, noise_nm=15.5, lines=(sharp, LINE), frames=60_000)
    assert kinds(at_rate(*loop, delay_frames=2)) == {("correction not known", "frames", None)}


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**31),
    at=st.one_of(st.integers(0, 3), st.integers(0, 4999)),
    sign=st.sampled_from([-1, 1]),
)
def test_one_spike_is_one_outlier(seed, at, sign):
    y = 15 * np.random.default_rng(seed).standard_normal((5000, 2))
    y[at, 1] += sign * 450  # half of it bends the frame beside an end
    seen = at_rate(y)
    unusable = np.flatnonzero(~seen.usable)
    assert at in unusable
    # beside an end the frames that nothing can judge go with it
    assert len(unusable) == {0: 2, 1: 2, 2: 3}.get(min(at, 4999 - at), 1)
    assert kinds(seen) == {("outlier", "measurements", 1)}
    assert np.array_equal(seen.measurements[seen.usable], y[seen.usable])
    assert np.max(np.abs(seen.measurements)) < 300  # the filler is not the spike


def test_spikes_side_by_side():
    for length in (2, 4):
        y = 15 * np.random.default_rng(length).standard_normal(5000)
        y[1000 : 1000 + length] += 400
        unusable = set(np.flatnonzero(~at_rate(y).usable))
        assert {1000, 1000 + length - 1} <= unusable <= set(range(998, 1002 + length))


@pytest.mark.parametrize("step", [None, 1.0])
@pytest.mark.parametrize("ends", [(-np.inf, 25.0), (-25.0, np.inf), (-25.0, 25.0)])
def test_a_range_that_is_cut_off_is_found(ends, step):
    y = 15 * np.random.default_rng(4).standard_normal(20_000)
    cut = np.clip(y if step is None else step * np.round(y / step), *ends)
    seen = at_rate(cut)
    assert kinds(seen) == {("saturated", "measurements", 0)}
    assert np.array_equal(seen.usable, (cut > ends[0]) & (cut < ends[1]))


@pytest.mark.parametrize("by", ["times", "numbers", "both"])
def test_missing_frames_become_holes(by):
    y, kept = noise(500), np.delete(np.arange(500), [100, 101, 300])
    clock = {"frame_rate_hz": RATE} if by == "numbers" else {}
    if by != "times":
        clock["frame_numbers"] = 7000 + kept
    if by != "numbers":
        jitter = np.random.default_rng(1).uniform(-1e-4, 1e-4, len(kept))
        clock["times_s"] = 1.7e9 + kept / RATE + jitter
    seen = laid(y[kept], **clock)
    assert np.flatnonzero(~seen.usable).tolist() == [100, 101, 300]
    assert seen.frames == 500
    assert seen.frame_rate_hz == pytest.approx(RATE, rel=1e-5)
    assert np.array_equal(seen.measurements[seen.usable, 0], y[kept])
    assert findings(seen) == [("missing", "frames", None, 3, 100)]
    words = "the times lie 0.057 frames rms beside a regular grid"
    assert (words in seen.notes) is (by != "numbers")


def test_rows_that_come_twice():
    y, order = noise(100), np.sort(np.concatenate([np.arange(100), [20, 20, 50]]))
    rows = y[order]
    same = at_rate(rows, frame_numbers=order)
    assert same.usable.all()
    assert np.array_equal(same.measurements[:, 0], y)
    assert same.notes == ("3 rows of a time that had been recorded already were left out",)
    rows[np.flatnonzero(order == 50)[1]] += 1  # two stories of one frame
    torn = at_rate(rows, times_s=order / RATE)
    assert np.flatnonzero(~torn.usable).tolist() == [50]
    assert findings(torn) == [("repeated", "frames", None, 1, 50)]


@pytest.mark.parametrize("frames", [None, np.arange(20_000)])  # by times alone, and by both
def test_a_stated_rate_is_held_against_the_times(frames):
    clock = {"times_s": np.arange(20_000) / 1000, "frame_numbers": frames}
    words = "must be that of the times, 1000 Hz; got"
    for rate in (1004, 999, 1000.2):
        refused(partial(laid, noise(20_000), frame_rate_hz=rate, **clock), ProblemError, words)
    for rate in (1000.05, 1000):
        near = laid(noise(20_000), frame_rate_hz=rate, **clock)
        assert (near.frame_rate_hz, near.notes) == (rate, ())


@pytest.mark.parametrize("rate", [800, 999.9, 1000])
@pytest.mark.parametrize("rounding", [np.round, np.floor])
def test_rounded_times_lose_no_frame_at_a_known_rate(rate, rounding):
    y, times = noise(20_000), 1e-3 * rounding(np.arange(20_000) / rate * 1e3 + 0.25)
    seen = laid(y, frame_rate_hz=rate, times_s=times)
    assert (seen.frame_rate_hz, seen.usable.all()) == (rate, True)
    assert np.array_equal(seen.measurements[:, 0], y)
    if rate != 1000:
        words = "may be rounded: .*Give frame_rate_hz"
        refused(lambda: laid(y, times_s=times), ProblemError, words)


@settings(max_examples=60, deadline=None)
@given(
    rate=st.floats(300, 2500),
    phase=st.floats(0, 1e-3),
    lost=st.lists(st.integers(1, 2998), max_size=4),
    frames=st.sampled_from([40, 300, 3000]),
    quantum=st.sampled_from([1e-3, 1e-4, 1e-6]),
)
def test_frames_are_laid_where_they_were_or_refused(rate, phase, lost, frames, quantum):
    """Never silently elsewhere, unless rounding cannot be distinguished at that rate."""
    there = np.isin(np.arange(frames), lost, invert=True)
    times = quantum * np.round((np.flatnonzero(there) / rate + phase) / quantum)
    y = noise(frames)
    try:
        seen = laid(y[there], frame_rate_hz=rate, times_s=times)
    except ProblemError:
        assert quantum * rate > 0.4  # never without a reason: times as coarse as frames
        return
    ends = [k for k in lost if k < frames and not frames // 8 < k < frames - frames // 8]
    if quantum * rate > 0.9 and ends:
        return  # rounding may hide a frame at the ends
    assert seen.frames == frames
    assert np.array_equal(seen.usable, there)
    assert np.array_equal(seen.measurements[there, 0], y[there])


@pytest.mark.parametrize(
    ("rate", "lost", "step_s", "phase", "frames"),
    [
        (800, 2, 1e-3, 1e-6, 40_000),
        (1000, 0, 1.0, 1e-6, 40_000),
        (2000, 0, 1e-3, 1e-6, 40_000),  # a step of two frames hides one
        (1000.1, 1, 1e-3, 1e-6, 40_000),  # and so does a rate that is not quite that of the times
        (999, 0, 1e-3, 0.9, 300),  # one step of two may be rounding, or a frame that is lost
    ],
)
def test_stamps_that_may_hide_a_lost_frame_are_refused(rate, lost, step_s, phase, frames):
    kept = np.delete(np.arange(frames), 17_000 + np.arange(lost))
    times = np.floor(kept / round(rate) / step_s + phase) * step_s
    stamped = partial(laid, noise(len(kept)), frame_rate_hz=rate, times_s=times)
    refused(stamped, ProblemError, "cannot tell which frames are missing")
    assert stamped(frame_numbers=kept).frames == frames


def test_one_row_has_no_rate_of_its_own():
    seen = at_rate([[1.0]], times_s=[5.0])
    assert (seen.frame_rate_hz, seen.notes) == (RATE, ())


def test_arrays_and_clocks_that_are_refused():
    y = np.random.default_rng(0).standard_normal((30, 2))
    odd_rate = {"frame_rate_hz": 777, "delay_frames": 2, "mirror": SHELL}
    arrays = [
        ({"measurements": np.ones((3, 5))}, "one or two axes.*Choose tip and tilt"),
        ({"measurements": np.ones((2, 50))}, "one or two axes.*Transpose it"),
        ({"measurements": []}, "not empty"),
        ({"commands": np.ones((30, 1))}, "commands must match measurements"),
        ({"delay_frames": 0.5}, "delay_frames must be at least 1"),
        ({"obstruction": 1}, "obstruction must be below 1"),
        ({"mirror": "shell"}, "expected a PositionLoop"),
        (odd_rate, "whole number of samples per frame"),
    ]
    clocks = [
        ({}, "frame rate is not known; give frame_rate_hz"),
        ({"measurements": [[1.0]], "times_s": [5.0]}, "frame rate is not known"),
        ({"times_s": [0, 1, 2]}, r"times_s must have shape \(6,\)"),
        ({"times_s": [0, 1, 2, 1.5, 3, 4]}, "must not run backwards; got 2 and then 1.5 at row 3"),
        ({"times_s": [0, 1, 2, np.nan, 3, 4]}, "times_s must be finite"),
        ({"times_s": [1, 1, 1, 1, 1, 1], "frame_rate_hz": 2}, "times_s must rise"),
        ({"times_s": [0, 1, 2, 3.5, 5.3, 6.3]}, "lie on no regular grid of 1 Hz"),
        ({"times_s": np.arange(6), "frame_rate_hz": 2}, "must be that of the times, 1 Hz; got 2"),
        ({"times_s": [0, 1, 2, 3, 4, 500]}, "495 of 501 frames would be missing"),
        ({"times_s": [0, 1, 2, 3, 4, 1e19], "frame_rate_hz": 1}, "frames would be missing .* cut"),
        ({"frame_numbers": [0, 1, 2, 3, 4, 1e19], "frame_rate_hz": 1}, "frames would be missing"),
        ({"frame_numbers": [0, 1, 2, 0, 1, 2], "frame_rate_hz": 2}, "frame_numbers must not run b"),
        ({"frame_numbers": [0, 1, 2, 2.5, 3, 4], "frame_rate_hz": 2}, "must be whole numbers"),
        ({"frame_rate_hz": 0}, "frame_rate_hz must be above 0"),
    ]
    loop = {"measurements": y, "commands": y, "frame_rate_hz": RATE}
    rows = [(loop | change, words) for change, words in arrays]
    rows += [({"measurements": noise(6)} | clock, words) for clock, words in clocks]
    require_refusals((partial(laid, **fields), ProblemError, words) for fields, words in rows)


@settings(max_examples=25)
@given(
    delay=st.floats(1.0, 3.5),
    gains=st.tuples(st.floats(0.3, 1.4), st.floats(0.3, 1.4)),
    noise=st.floats(0.1, 50),
    moving=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_with_noise_it_is_phase_and_noise_over_the_gain(delay, gains, noise, moving, seed):
    """Against the loop stepped by hand, one gain an axis, from its first frame."""
    mirror = SHELL if moving else None
    taps = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, mirror=mirror).mirror_taps
    rng, frames, g = np.random.default_rng(seed), 80, np.array(gains)
    phase = np.cumsum(rng.standard_normal((frames, 2)), axis=0) * 20
    w = noise * rng.standard_normal((frames, 2))
    u, y, residual = np.zeros((frames, 2)), np.zeros((frames, 2)), np.zeros(2)
    for k in range(frames):
        y[k] = g * residual + w[k]
        u[k] = 0.99 * u[k - 1] + 0.1 * y[k]
        residual = phase[k] - sum(taps[i] * u[k - i] for i in range(min(len(taps), k + 1)))
    z = at_rate(y, u, delay_frames=delay, mirror=mirror).pseudo_open_loop(g)
    expected = phase[:-1] + w[1:] / g
    # before the record there were no commands: here even its first frames are right
    assert np.max(np.abs(z[1:] - expected)) < 1e-9 * np.max(np.abs(expected))


def test_a_delay_can_come_later():
    y, u = ran(delay_frames=2.4)
    unknown = at_rate(y, np.where(np.arange(300)[:, None] == 100, np.nan, u))
    assert unknown.usable.all()
    words = "delay of this loop is not known; give delay_fram"
    refused(unknown.corrections, ProblemError, words)
    seen = unknown.with_delay(2.4)
    # taps of u(k-2), u(k-3): frame 100 enters 102 and 103
    assert np.flatnonzero(~seen.usable).tolist() == [0, 1, 2, 102, 103]
    other = seen.with_delay(1.0)
    assert other.mirror is seen.mirror
    assert np.flatnonzero(~other.usable).tolist() == [0, 101]
    assert [finding.kind for finding in other.findings].count("correction not known") == 1


def test_short_holes_are_bridged_on_the_pseudo_open_loop():
    phase = 200 * np.sin(2 * np.pi * 10 * np.arange(2000) / RATE)[:, None]
    u = noise(2000)[:, None]
    y = 0.6 * (np.roll(phase, 1, axis=0) - np.roll(u, 2, axis=0))
    y[300], y[700:703], y[900:904] = np.nan, np.nan, np.nan
    seen = at_rate(y, u, delay_frames=2)
    whole = seen.bridged(sensor_gain=0.6)
    assert "4 frames in 2 holes of at most 3 were interpolated" in whole.notes
    assert np.flatnonzero(~whole.usable).tolist() == [0, 1, 900, 901, 902, 903]
    z = whole.pseudo_open_loop(0.6)
    assert np.array_equal(z[seen.usable], seen.pseudo_open_loop(0.6)[seen.usable])
    holes = np.array([300, 700, 701, 702])
    np.testing.assert_allclose(z[holes], phase[holes - 1], atol=0.01)
    # the original stays as it was, and its delay may still change
    assert not seen.usable[300]
    assert not whole.with_delay(2.4).usable[300]
    assert whole.bridged() is whole
    for gain in (0, [1, 1]):
        refused(partial(seen.bridged, sensor_gain=gain), ProblemError, "must be")


def test_more_than_one_hundredth_of_a_record_is_not_bridged():
    y = noise(600)
    y[100:700:100] = np.nan
    assert at_rate(y).bridged().usable.all()
    y[150:153] = np.nan
    seen = at_rate(y)
    assert seen.bridged() is seen


def test_records_are_frozen():
    seen = at_rate([1.0, 2.0], [1.0, 3.0])
    for name in ("measurements", "commands", "usable", "measured", "commanded"):
        assert not getattr(seen, name).flags.writeable
    with pytest.raises(dataclasses.FrozenInstanceError):
        seen.source = "x"
    require_refusals(
        (partial(dataclasses.replace, seen, **change), DimensionError, words)
        for change, words in (
            ({"measured": np.ones(3, dtype=bool)}, "2 truth values"),
            ({"commands": np.ones((3, 1))}, "commands must have 2 rows"),
        )
    )


def test_length():
    y = noise(6000)
    y[::200] = np.nan  # stretches of 199
    broken = at_rate(y)
    assert require_length(broken.bridged()) == 5999
    short = at_rate(y[1:200], frame_rate_hz=2000)
    coarse = at_rate(y[1:1000:2], frame_rate_hz=400)
    dead = at_rate(np.column_stack([y[1:200], np.zeros(199)]))
    assert kinds(dead) == {("stuck", "measurements", 1)}
    require_refusals(
        (partial(require_length, record, seconds=seconds), ProblemError, words)
        for record, seconds, words in (
            (broken, 2, r"needs 2000 usable frames \(2 s at 1000 Hz\).*got 0 "),
            (broken.bridged(), 7, r"needs 7000 usable frames \(7 s at 1000 Hz\)"),
            (short, 2, "needs 4000 usable frames"),
            (coarse, 2, "needs 1024 usable frames"),
            (dead, 2, r"got 0 \(0 s\), the longest stretch 0. 0 of 199 frames"),
        )
    )


def test_commands_before_a_record_do_not_make_it_shorter():
    y = noise(5000)
    whole = at_rate(y, y, delay_frames=2.5)
    assert whole.stretches() == ((3, 5000),)
    assert require_length(whole, seconds=5) == 5000
    y[3] = np.nan  # a frame that was lost
    late = at_rate(y, np.zeros(5000), delay_frames=2.5)
    assert (late.first_known, late.lost) == (3, pytest.approx(1 / 4997))
    refused(lambda: require_length(late, seconds=5), ProblemError, "needs 5000 usable frames")


def frames_in(stretches):
    return np.concatenate([np.arange(start, stop) for start, stop in stretches])


@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_halves_are_apart_and_in_order(good):
    good = np.array(good)
    y = np.ones((len(good), 1))
    record = LoopRecord(frame_rate_hz=500, measurements=y, measured=good, commanded=good | True)
    if sum(good) < 2:
        words = f"to fit and to test on; got {sum(good)} usable"
        refused(lambda: split_halves(record), ProblemError, words)
        return
    fit, test = (frames_in(half.stretches()) for half in split_halves(record))
    assert len(fit) == sum(good) // 2
    np.testing.assert_array_equal(np.concatenate([fit, test]), np.flatnonzero(good))


def test_a_half_keeps_what_was_bridged_and_its_commands():
    y = noise(2000)
    y[[300, 1500]] = np.nan
    record = at_rate(y, y, delay_frames=2).bridged()
    first, later = split_halves(record)
    assert (first.usable[300], later.usable[1500]) == (True, True)
    np.testing.assert_array_equal(first.usable | later.usable, record.usable)
    np.testing.assert_array_equal(later.corrections(), record.corrections())


def test_cuts_are_those_of_the_usable_frames():
    usable = ((10, 400), (450, 460), (500, 1001))
    everything = frames_in(usable)
    for first, last in ((0, 390), (389, 401), (395, 901)):
        part = cut_stretches(usable, first, last)
        assert np.array_equal(frames_in(part), everything[first:last])
