"""Records: the exact pseudo-open loop, faults that are found and none that are not there."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lbt_synth as lbt

RATE = 1000.0
SHELL = lbt.models.PositionLoop.of_bandwidth(
    natural_frequency_hz=50, damping=0.5, bandwidth_hz=300, sampling_hz=24_000
)
SLOW = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=RATE)
LINE = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=300, direction=[0.6, 0.8])


def ran(path, *, noise_nm=0.0, sensor_gain=1.0, frames=300, seed=3, gain=0.1):
    """A loop with an integrator: the simulation, and its noise."""
    truth = lbt.Truth(
        turbulence=SLOW, noise_nm=noise_nm, sensor_gain=sensor_gain, vibrations=(LINE,)
    )
    controller = lbt.integrator(path, gain=gain).controller
    return lbt.simulate(controller, truth, hardware=path, frames=frames, seed=seed)


def record(run, path, **more):
    return lbt.identification.loop_record(
        run.measurements[0],
        run.commands[0],
        frame_rate_hz=path.frame_rate_hz,
        delay_frames=path.delay_frames,
        mirror=path.mirror,
        unit="nm",
        **more,
    )


# ------------------------------------------------------ the pseudo-open loop
@pytest.mark.parametrize("mirror", [None, SHELL], ids=["settled", "moving"])
@pytest.mark.parametrize("sensor_gain", [0.4, 1.0, 1.3])
@pytest.mark.parametrize("delay", [1.0, 2.0, 2.4, 3.0])
def test_without_noise_it_is_the_phase_before_the_correction(delay, sensor_gain, mirror):
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, mirror=mirror)
    run = ran(path, sensor_gain=sensor_gain)
    seen = record(run, path)
    first = len(path.mirror_taps)
    assert not seen.usable[:first].any()
    assert seen.usable[first:].all()
    z = seen.pseudo_open_loop(sensor_gain)[first:]
    phase = run.total_nm[0, first - 1 : -1]
    assert np.max(np.abs(z - phase)) < 1e-9 * np.max(np.abs(phase))
    # what was taken out of it is the correction itself
    assert np.allclose(
        seen.corrections()[first:], (run.total_nm - run.residual_nm)[0, first - 1 : -1], atol=1e-8
    )


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
    path = lbt.LoopHardware(
        frame_rate_hz=RATE, delay_frames=delay, mirror=SHELL if moving else None
    )
    rng, frames = np.random.default_rng(seed), 80
    phase = np.cumsum(rng.standard_normal((frames, 2)), axis=0) * 20
    w = noise * rng.standard_normal((frames, 2))
    taps, g = path.mirror_taps, np.array(gains)
    u, y = np.zeros((frames, 2)), np.zeros((frames, 2))
    residual = np.zeros(2)
    for k in range(frames):
        y[k] = g * residual + w[k]
        u[k] = 0.99 * u[k - 1] + 0.1 * y[k]
        seen = [u[k - i] if k >= i else np.zeros(2) for i in range(len(taps))]
        residual = phase[k] - sum(c * past for c, past in zip(taps, seen, strict=True))
    seen = lbt.identification.loop_record(
        y, u, frame_rate_hz=RATE, delay_frames=delay, mirror=path.mirror, unit="nm"
    )
    z = seen.pseudo_open_loop(g)
    expected = phase[:-1] + w[1:] / g
    # before the record there were no commands: here even its first frames are right
    assert np.max(np.abs(z[1:] - expected)) < 1e-9 * np.max(np.abs(expected))


def test_an_open_loop_is_its_own_series():
    y = np.random.default_rng(0).standard_normal((50, 1))
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    assert np.array_equal(seen.pseudo_open_loop(), y)
    assert np.array_equal(seen.pseudo_open_loop(0.5), 2 * y)
    assert not seen.corrections().any()
    assert seen.stretches() == ((0, 50),)


def test_a_delay_can_come_later():
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=2.4)
    run = ran(path)
    u = run.commands[0].copy()
    u[100, 1] = np.nan
    unknown = lbt.identification.loop_record(run.measurements[0], u, frame_rate_hz=RATE, unit="nm")
    assert unknown.usable.all()
    with pytest.raises(
        lbt.errors.ProblemError, match="delay of this loop is not known; give delay_fram"
    ):
        unknown.corrections()
    seen = unknown.with_delay(2.4)
    # taps of u(k-2), u(k-3): frame 100 enters 102 and 103
    assert np.flatnonzero(~seen.usable).tolist() == [0, 1, 2, 102, 103]
    assert seen.health.usable == 295
    other = seen.with_delay(1.0)
    assert np.flatnonzero(~other.usable).tolist() == [0, 101]
    assert [row[0] for row in other.health.rows()].count("correction not known") == 1


def test_a_spoilt_command_spoils_what_its_correction_enters():
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=3.0)
    run = ran(path)
    u = run.commands[0].copy()
    u[50] = np.inf
    seen = lbt.identification.loop_record(
        run.measurements[0], u, frame_rate_hz=RATE, delay_frames=3, unit="nm"
    )
    assert np.flatnonzero(~seen.usable).tolist() == [0, 1, 2, 53]
    assert seen.stretches() == ((3, 53), (54, 300))
    good = seen.usable
    z = seen.pseudo_open_loop()
    assert np.allclose(z[1:][good[1:]], run.total_nm[0, :-1][good[1:]], atol=1e-9)
    assert np.all(np.isfinite(seen.commands))


# ------------------------------------------------------------------- health
def turbulence(frames, *, rate=RATE, noise=15.5, seed=0, line=None):
    """An AR2 turbulence of 592 nm, perhaps a line, and noise."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    a = [1, -1.997477, 0.997555]
    x = lfilter([1.0], a, rng.standard_normal(frames + 20_000))[20_000:]
    x *= 592 / np.sqrt((1 + 0.997555) / (1 - 0.997555) / ((1.997555) ** 2 - 1.997477**2))
    if line is not None:
        x = x + line(np.arange(frames) / rate)
    return x + noise * rng.standard_normal(frames)


def kinds(seen, *, spoils=True):
    return {(f.kind, f.series, f.axis) for f in seen.health.findings if f.spoils == spoils}


def test_a_million_clean_frames_show_nothing():
    y = np.random.default_rng(11).standard_normal((1_000_000, 1))
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    assert seen.health.clean
    assert seen.health.findings == ()
    assert seen.usable.all()
    assert seen.health.notes == ()


def sinusoid(t):
    return 500 * np.sqrt(2) * np.cos(2 * np.pi * 20 * t + 1)


def burst(t):
    return 800 * np.exp(-(((t - t.mean()) / 0.8) ** 2)) * np.cos(2 * np.pi * 60 * t)


def high(t):
    return 500 * np.cos(2 * np.pi * 340 * t)


@pytest.mark.parametrize(
    "line", [None, sinusoid, burst, high], ids=lambda f: getattr(f, "__name__", "none")
)
@pytest.mark.parametrize("noise", [0.5, 15.5])
@pytest.mark.parametrize("step", [None, 1.0, 30.0], ids=["fine", "1 nm", "30 nm"])
def test_strong_lines_and_coarse_numbers_are_no_faults(line, noise, step):
    y = turbulence(60_000, noise=noise, line=line)
    y = y if step is None else step * np.round(y / step)
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    assert seen.health.rows() == ()


@pytest.mark.parametrize("step", [None, 1.0, 10.0])
def test_a_pure_sinusoid_is_no_fault(step):
    y = sinusoid(np.arange(40_000) / RATE)
    y = y if step is None else step * np.floor(y / step)
    assert lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm").health.rows() == ()


def test_resonances_and_closed_loops_are_no_faults():
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    sharp = lbt.Vibration(frequency_hz=45, damping=0.003, rms_nm=800, direction=[1.0, 0.2])
    truth = lbt.Truth(turbulence=SLOW, noise_nm=15.5, vibrations=(sharp, LINE))
    run = lbt.simulate(
        lbt.integrator(path, gain=0.3).controller, truth, hardware=path, frames=60_000, seed=9
    )
    seen = record(run, path)
    assert kinds(seen) == {("correction not known", "frames", None)}
    assert kinds(seen, spoils=False) == set()


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**31),
    at=st.one_of(st.integers(0, 3), st.integers(0, 4999)),
    sign=st.sampled_from([-1, 1]),
)
def test_one_spike_is_one_outlier(seed, at, sign):
    rng = np.random.default_rng(seed)
    y = 15 * rng.standard_normal((5000, 2))
    y[at, 1] += sign * 450  # half of it bends the frame beside an end
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    found = np.flatnonzero(~seen.usable)
    assert at in found
    # beside an end the frames that nothing can judge go with it
    assert len(found) == {0: 2, 1: 2, 2: 3}.get(min(at, 4999 - at), 1)
    assert kinds(seen) == {("outlier", "measurements", 1)}
    assert np.array_equal(seen.measurements[seen.usable], y[seen.usable])
    assert np.max(np.abs(seen.measurements)) < 300  # the filler is not the spike


@pytest.mark.parametrize("length", [2, 3, 4])
def test_spikes_side_by_side(length):
    y = 15 * np.random.default_rng(length).standard_normal(5000)
    y[1000 : 1000 + length] += 400
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    found = set(np.flatnonzero(~seen.usable))
    edges = {1000, 1000 + length - 1}
    assert edges <= found
    assert found <= set(range(998, 1002 + length))


def test_gaps_of_every_kind():
    y = 10 * np.random.default_rng(1).standard_normal((2000, 2))
    y[100, 0] = np.nan
    y[200:203, 1] = np.inf
    y[500:540, 0] = y[500, 0]
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    assert seen.health.rows() == (
        ("not finite", "measurements", 0, 1, 0.05, 100, "spoilt"),
        ("stuck", "measurements", 0, 40, 2.0, 500, "spoilt"),
        ("not finite", "measurements", 1, 3, 0.15, 200, "spoilt"),
    )
    assert not seen.health.clean
    assert seen.health.usable == np.sum(seen.usable) == 2000 - 44
    assert seen.stretches() == ((0, 100), (101, 200), (203, 500), (540, 2000))
    assert np.all(np.isfinite(seen.measurements))
    assert seen.health.summary() == (
        "1956 of 2000 frames are usable; 1 not finite (measurements), 40 stuck (measurements), "
        "3 not finite (measurements)."
    )


def test_masked_and_absurd_values_are_gaps():
    y = np.random.default_rng(0).standard_normal((100, 1))
    y[20] = 1e308
    y[30] = -3e105
    masked = np.ma.masked_array(y, mask=np.arange(100)[:, None] == 50)
    for unit in ("nm", "m"):
        seen = lbt.identification.loop_record(masked, frame_rate_hz=RATE, unit=unit)
        assert np.flatnonzero(~seen.usable).tolist() == [20, 30, 50]
        assert np.all(np.abs(seen.measurements) < 1e11)


def test_a_dead_axis_leaves_nothing():
    y = np.random.default_rng(0).standard_normal((5000, 2))
    y[:, 1] = 0.0
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    assert not seen.usable.any()
    assert kinds(seen) == {("stuck", "measurements", 1)}
    with pytest.raises(
        lbt.errors.ProblemError, match="got 0, the longest stretch 0. 0 of 5000 frames"
    ):
        lbt.identification.require_length(seen)


@pytest.mark.parametrize("ends", [(-np.inf, 25.0), (-25.0, np.inf), (-25.0, 25.0)])
def test_a_range_that_is_cut_off_is_found(ends):
    y = 15 * np.random.default_rng(4).standard_normal(20_000)
    cut = np.clip(y, *ends)
    seen = lbt.identification.loop_record(cut, frame_rate_hz=RATE, unit="nm")
    assert kinds(seen) == {("saturated", "measurements", 0)}
    assert np.array_equal(seen.usable, cut == y)


def test_clipped_commands_spoil_open_loops_are_reported():
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    run = ran(path, frames=3000, noise_nm=5)
    u = np.clip(run.commands[0], -250, None)
    u[1000:1100] = 0.0
    u[2000:2050, 0] = u[2000, 0]
    seen = lbt.identification.loop_record(
        run.measurements[0], u, frame_rate_hz=RATE, delay_frames=2, unit="nm"
    )
    assert kinds(seen, spoils=False) == {
        ("loop open", "commands", None),
        ("held", "commands", 0),
    }
    count = {f.kind: (f.count, f.first_frame) for f in seen.health.findings if not f.spoils}
    assert count == {"loop open": (100, 1000), "held": (50, 2000)}
    clipped = np.any(run.commands[0] < -250, axis=1) & np.all(u != 0, axis=1)
    expected = np.zeros(3000, dtype=bool)
    expected[:2] = True
    expected[2:] |= clipped[:-2]
    assert clipped.sum() > 5
    assert np.array_equal(~seen.usable, expected)


def test_an_open_loop_with_zero_commands():
    y = np.random.default_rng(0).standard_normal((200, 2))
    seen = lbt.identification.loop_record(y, 0 * y, frame_rate_hz=RATE, delay_frames=2, unit="nm")
    assert ("loop open", "commands", None, 200, 100.0, 0, "reported") in seen.health.rows()
    assert seen.usable[2:].all()
    assert np.array_equal(seen.pseudo_open_loop(), y)


def test_a_scatter_that_changes_is_said():
    y = np.random.default_rng(0).standard_normal((4000, 2))
    y[:, 1] *= np.linspace(1, 6, 4000)
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    (note,) = seen.health.notes
    assert note.startswith("axis 1 is not stationary: the rms difference of two frames is 2")
    assert seen.usable.all()


# ------------------------------------------------------------------- clocks
@pytest.mark.parametrize("by", ["times", "numbers", "both"])
def test_missing_frames_become_holes(by):
    y = np.random.default_rng(0).standard_normal((500, 2))
    kept = np.delete(np.arange(500), [100, 101, 300])
    clock = {}
    if by != "numbers":
        jitter = np.random.default_rng(1).uniform(-1e-4, 1e-4, len(kept))
        clock["times_s"] = 1.7e9 + kept / RATE + jitter
    if by != "times":
        clock["frame_numbers"] = 7000 + kept
    rate = RATE if by == "numbers" else None
    seen = lbt.identification.loop_record(y[kept], frame_rate_hz=rate, unit="nm", **clock)
    assert np.flatnonzero(~seen.usable).tolist() == [100, 101, 300]
    assert seen.frames == 500
    assert seen.frame_rate_hz == pytest.approx(RATE, rel=1e-5)
    assert np.array_equal(seen.measurements[seen.usable], y[kept])
    assert seen.health.rows() == (("missing", "frames", None, 3, 0.6, 100, "spoilt"),)


def test_rounded_times_of_a_known_rate():
    kept = np.delete(np.arange(2000), [500, 501])
    times = np.round(kept / 800, 3)  # steps of 1 and 2 ms
    y = np.random.default_rng(0).standard_normal(len(kept))
    seen = lbt.identification.loop_record(y, frame_rate_hz=800, times_s=times, unit="nm")
    assert np.flatnonzero(~seen.usable).tolist() == [500, 501]
    with pytest.raises(
        lbt.errors.ProblemError, match="the times may be rounded. Give frame_rate_hz"
    ):
        lbt.identification.loop_record(y, times_s=times, unit="nm")


def test_rows_that_come_twice():
    y = np.random.default_rng(0).standard_normal((100, 2))
    order = np.sort(np.concatenate([np.arange(100), [20, 20, 50]]))
    rows = y[order].copy()
    same = lbt.identification.loop_record(rows, frame_rate_hz=RATE, frame_numbers=order, unit="nm")
    assert same.usable.all()
    assert np.array_equal(same.measurements, y)
    assert same.health.notes == ("3 rows of a time that had been recorded already were left out",)
    rows[np.flatnonzero(order == 50)[1]] += 1  # two stories of one frame
    torn = lbt.identification.loop_record(rows, times_s=order / RATE, unit="nm")
    assert np.flatnonzero(~torn.usable).tolist() == [50]
    assert torn.health.rows() == (("repeated", "frames", None, 1, 1.0, 50, "spoilt"),)


@pytest.mark.parametrize(
    ("clock", "words"),
    [
        ({}, "frame rate is not known; give frame_rate_hz"),
        ({"times_s": [0, 1, 2]}, r"times_s must have shape \(6,\)"),
        ({"times_s": [0, 1, 2, 1.5, 3, 4]}, "must not run backwards; got 2 and then 1.5 at row 3"),
        ({"times_s": [0, 1, 2, np.nan, 3, 4]}, "times_s must be finite"),
        ({"times_s": [1, 1, 1, 1, 1, 1]}, "times_s must rise"),
        ({"times_s": [0, 1, 2.4, 4.3, 5.3, 6.3]}, "lie on no regular grid of 1 Hz"),
        ({"times_s": np.arange(6), "frame_rate_hz": 2}, "must be that of the times, 1 Hz; got 2"),
        ({"times_s": [0, 1, 2, 3, 4, 500]}, "495 of 501 frames would be missing"),
        (
            {"times_s": [0, 1, 2, 3, 4, 500], "frame_rate_hz": 1},
            "495 of 501 frames would be missing",
        ),
        ({"frame_numbers": [0, 2, 4, 6, 8, 10], "frame_rate_hz": 2}, "median step of 2"),
        ({"frame_numbers": [0, 1, 2, 0, 1, 2], "frame_rate_hz": 2}, "frame_numbers must not run b"),
        ({"frame_numbers": [0, 1, 2, 2.5, 3, 4], "frame_rate_hz": 2}, "must be whole numbers"),
        ({"frame_rate_hz": 0}, "frame_rate_hz must be above 0"),
    ],
)
def test_clocks_that_are_refused(clock, words):
    y = np.random.default_rng(0).standard_normal((6, 1))
    with pytest.raises(lbt.errors.ProblemError, match=words):
        lbt.identification.loop_record(y, unit="nm", **clock)


# ------------------------------------------------------------ bridges, length
def test_short_holes_are_bridged_on_the_pseudo_open_loop():
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=2.4)
    run = ran(path, frames=2000, sensor_gain=0.6)
    y = run.measurements[0].copy()
    y[300, 0] = np.nan
    y[700:703] = np.nan
    y[900:904] = np.nan
    seen = lbt.identification.loop_record(
        y, run.commands[0], frame_rate_hz=RATE, delay_frames=2.4, unit="nm"
    )
    whole = seen.bridged(sensor_gain=0.6)
    assert whole.health.bridged == 4
    assert "4 frames in 2 holes of at most 3 were interpolated" in whole.health.notes
    assert np.flatnonzero(~whole.usable).tolist() == [0, 1, 2, 900, 901, 902, 903]
    assert whole.health.usable == 1993
    z, phase = whole.pseudo_open_loop(0.6), run.total_nm[0]
    assert np.array_equal(z[seen.usable], seen.pseudo_open_loop(0.6)[seen.usable])
    # a cubic through two frames on either side, to the last bit of a cubic
    inside = np.array([300, 700, 701, 702])
    for k, wide in ((300, [298, 299, 301, 302]), (701, [698, 699, 703, 704])):
        cubic = np.polynomial.polynomial.polyfit(np.array(wide) - k, phase[np.array(wide) - 1], 3)
        assert np.allclose(z[k], cubic[0], atol=1e-6)
    # what is left out by a plain interpolation of y would be far off
    assert np.max(np.abs(z - np.vstack([phase[:1], phase[:-1]]))[inside]) < 60
    # the original stays as it was, and its delay may still change
    assert seen.health.bridged == 0
    assert not seen.usable[300]
    assert whole.with_delay(2.4).health.bridged == 0
    assert not whole.with_delay(2.4).usable[300]


def test_bridges_have_a_budget():
    y = np.random.default_rng(0).standard_normal(1000)
    y[[100, 200, 300]] = np.nan
    y[400:402] = y[500:503] = np.nan
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    part = seen.bridged(most_fraction=0.005)
    assert part.health.bridged == 5
    assert part.health.notes[-1].endswith("1 more such holes were left, beyond 0.5 %")
    assert np.flatnonzero(~part.usable).tolist() == [500, 501, 502]
    assert seen.bridged(1).health.bridged == 3
    assert seen.bridged(most_fraction=0.0) is seen
    for bad in ({"most": 0}, {"most_fraction": 2}, {"sensor_gain": 0}, {"sensor_gain": [1, 1]}):
        with pytest.raises(lbt.errors.ProblemError, match="must be"):
            seen.bridged(**bad)


def test_a_hole_with_one_frame_beside_it_is_bridged_straight():
    y = np.array([1.0, 2.0, np.nan, 4.0, np.nan, 7.0, 9.0, 3.0, 2.0, 5.0])
    seen = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm").bridged(most_fraction=1)
    assert seen.measurements[[2, 4], 0] == pytest.approx([3.0, 5.5])


def test_length():
    y = np.random.default_rng(0).standard_normal(6000)
    y[::200] = np.nan  # stretches of 199
    broken = lbt.identification.loop_record(y, frame_rate_hz=RATE, unit="nm")
    with pytest.raises(
        lbt.errors.ProblemError, match=r"needs 4096 usable frames \(4.1 s\).*got 0, the l"
    ):
        lbt.identification.require_length(broken)
    assert lbt.identification.require_length(broken.bridged()) == 5999
    whole = broken.bridged()
    with pytest.raises(lbt.errors.ProblemError, match=r"needs 7000 usable frames \(7 s\)"):
        lbt.identification.require_length(whole, seconds=7)
    assert lbt.identification.require_length(whole, resolution_hz=0.2) == 5999
    with pytest.raises(lbt.errors.ProblemError, match="0.1 Hz apart a stretch of 10000 frames"):
        lbt.identification.require_length(whole, resolution_hz=0.1)
    quick = lbt.identification.loop_record(y[1:200], frame_rate_hz=2000, unit="nm")
    with pytest.raises(lbt.errors.ProblemError, match="needs 8000 usable frames"):
        lbt.identification.require_length(quick)
