"""Controllers replayed on recorded data, against runs under the truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.predictions import (
    CASES,
    FLAT,
    GOOD,
    PATH,
    RATE,
    SPOILT,
    a_plant,
    a_truth,
    pseudo_open_loop,
)

import lbt_synth as lbt


@pytest.mark.parametrize(("delay", "gain", "mirror", "sensor"), CASES)
@pytest.mark.parametrize("method", ["lqg", "integrator"])
def test_a_replay_is_the_run_that_there_would_have_been(delay, gain, mirror, sensor, method):
    """Another controller's record gives the residual and noise of a run under the same truth."""
    path = a_plant(delay=delay, mirror=mirror, sensor=sensor).hardware
    ran = lbt.integrator(path, gain=0.15).controller
    if method == "lqg":
        new = lbt.lqg(a_plant(delay=delay, gain=gain, mirror=mirror, sensor=sensor)).controller
    else:
        new = lbt.integrator(path, gain=0.25).controller
    truth, size = a_truth(gain), {"hardware": path, "frames": 400, "seed": 3, "settle_frames": 0}
    night = lbt.simulate(ran, truth, **size)
    would = lbt.simulate(new.start(), truth, **size)  # stepped frame by frame
    assert np.array_equal(night.total_nm, would.total_nm)
    z = pseudo_open_loop(night.measurements[0], night.commands[0], path, gain)
    found = lbt.identification.replayed_residual(
        z, new, path, noise_nm=15.5, sensor_gain=gain, settle_frames=0
    )
    wanted = would.measurements[0] @ np.linalg.inv(gain * path.sensor).T
    scale = np.max(np.abs(wanted))
    np.testing.assert_allclose(found.measured_nm, wanted, rtol=0, atol=1e-9 * scale)
    # and that residual is the phase of the frame before, with its noise
    phase = would.residual_nm[0, :-1]
    noise = (would.measurements[0, 1:] - gain * phase @ path.sensor.T) @ np.linalg.inv(
        gain * path.sensor
    ).T
    np.testing.assert_allclose(found.measured_nm[1:], phase + noise, rtol=0, atol=1e-9 * scale)
    back = np.linalg.inv(gain * path.sensor)
    np.testing.assert_allclose(
        found.covariance_nm2,
        wanted.T @ wanted / 400 - 15.5**2 * back @ back.T,
        rtol=0,
        atol=1e-9 * scale**2,
    )


def test_without_noise_the_residual_itself_is_found():
    path = a_plant().hardware
    new = lbt.kalman(a_plant()).controller
    truth = a_truth(noise_nm=0.0)
    size = {"hardware": path, "frames": 3000, "seed": 1, "settle_frames": 0}
    night = lbt.simulate(lbt.integrator(path, gain=0.1).controller, truth, **size)
    z = pseudo_open_loop(night.measurements[0], night.commands[0], path)
    np.testing.assert_allclose(z[1:], night.total_nm[0, :-1], rtol=0, atol=1e-8)
    found = lbt.identification.replayed_residual(z, new, path, noise_nm=0.0)
    begin, end = found.stretches[0]
    would = lbt.simulate(new, truth, **size).residual_nm[0, begin - 1 : end - 1]
    np.testing.assert_allclose(found.covariance_nm2, would.T @ would / len(would), rtol=1e-9)


@settings(max_examples=15)
@given(
    st.integers(0, 2**31),
    st.floats(1e-3, 1e3),
    st.integers(0, 300),
    st.sampled_from([1.0, 1.7, 2.0, 2.5]),
)
def test_scale_and_beginning(seed, scale, start, delay):
    """A replay is linear, and each stretch begins anew: what lies outside is not read."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay)
    new = lbt.integrator(path, gain=0.3).controller
    z = np.random.default_rng(seed).standard_normal((700, 2))
    whole = lbt.identification.replayed_residual(
        z[start:], new, path, noise_nm=0.1, settle_frames=7
    )
    torn = np.full_like(z, np.nan)
    torn[start:] = scale * z[start:]
    part = lbt.identification.replayed_residual(
        torn, new, path, noise_nm=0.1 * scale, settle_frames=7, stretches=[(start, 700)]
    )
    assert part.stretches == ((start + 7, 700),)
    np.testing.assert_allclose(
        part.measured_nm, scale * whole.measured_nm, rtol=0, atol=1e-12 * scale
    )
    np.testing.assert_allclose(
        part.covariance_nm2, scale**2 * whole.covariance_nm2, rtol=1e-9, atol=1e-9 * scale**2
    )
    assert part.total_error_nm2 == pytest.approx(scale**2 * whole.total_error_nm2, rel=1e-9)


def test_the_default_settling_is_long_enough():
    path = a_plant().hardware
    z = 1e3 + np.zeros((5000, 2))  # a step: an integrator forgets it at the loop's own pace
    new = lbt.integrator(path, gain=0.02).controller
    found = lbt.identification.replayed_residual(z, new, path, noise_nm=0.0)
    assert 0.01 < np.max(np.abs(found.measured_nm)) < 0.2
    radius = lbt.close_loop(path, new).spectral_radius
    assert found.stretches[0][0] == int(np.ceil(np.log(1e-4) / np.log(radius)))


@pytest.mark.parametrize(
    ("series", "more", "message"),
    [
        (GOOD[:, :1], {}, r"open_loop must be \(frames, 2\)"),
        (GOOD[0], {}, r"open_loop must be \(frames, 2\)"),
        (GOOD[:0], {}, r"open_loop must be \(frames, 2\)"),
        (GOOD + 0j, {}, "open_loop must be real"),
        (SPOILT, {}, r"open_loop, frames 0 to 2000, must be finite; got nan at index \(77, 0\)"),
        (SPOILT, {"stretches": [(50, 900)]}, r"frames 50 to 900, .* index \(27, 0\)"),
        (GOOD, {"noise_nm": -1.0}, "noise_nm must be at least 0"),
        (
            GOOD,
            {"noise_nm": [1.0, 2.0, 3.0]},
            r"noise_nm must be one number, or one per measurement \(2\); got 3",
        ),
        (GOOD, {"noise_nm": np.nan}, "noise_nm must be finite"),
        (GOOD, {"noise_error_nm": -0.1}, "noise_error_nm must be at least 0"),
        (GOOD, {"sensor_gain": 0.0}, "sensor_gain must be above 0"),
        (GOOD, {"settle_frames": -1}, "settle_frames must be at least 0"),
        (GOOD, {"settle_frames": 2000}, "longer than the 2000 frames in which the loop settles"),
        (GOOD, {"settle_frames": 1950}, "at least 100 frames after settling; got 50"),
        (GOOD, {"stretches": [(0, 2001)]}, "within 2000 frames"),
    ],
)
def test_replays_that_are_refused(series, more, message):
    new = lbt.integrator(PATH, gain=0.3).controller
    with pytest.raises(lbt.errors.ProblemError, match=message):
        lbt.identification.replayed_residual(series, new, PATH, **({"noise_nm": 1.0} | more))


def test_loops_that_cannot_be_replayed():
    new = lbt.integrator(PATH, gain=0.3).controller
    with pytest.raises(lbt.errors.ProblemError, match="can be inverted; got \\(2, 2\\) of rank 1"):
        lbt.identification.replayed_residual(GOOD, new, FLAT, noise_nm=1.0)
    with pytest.raises(lbt.errors.UnstableLoopError, match="must be stable"):
        lbt.identification.replayed_residual(GOOD, new, PATH, noise_nm=1.0, sensor_gain=4.0)
    with pytest.raises(lbt.errors.ProblemError, match="expected a LoopHardware"):
        lbt.identification.replayed_residual(GOOD, new, a_plant(), noise_nm=1.0)
    one = lbt.identification.replayed_residual(GOOD, new, PATH, noise_nm=1.0)
    other = lbt.identification.replayed_residual(GOOD, new, PATH, noise_nm=1.0, settle_frames=500)
    with pytest.raises(lbt.errors.ProblemError, match="on the same frames only"):
        one.above(other)
