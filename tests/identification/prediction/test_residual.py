"""Controllers replayed on recorded data, against runs under the truth.

Where replays start, and which frames count.
"""

from __future__ import annotations

import runpy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.plants import ROOT
from support.predictions import (
    CAMERA,
    FLAT,
    GOOD,
    PATH,
    RATE,
    SHELL,
    SPOILT,
    TILTED,
    a_plant,
    a_series,
    a_truth,
    pseudo_open_loop,
)

import lbt_synth as lbt
from lbt_synth.errors import ProblemError, UnstableLoopError
from lbt_synth.identification.prediction.residual import estimate_residual, replay, settled_test
from lbt_synth.models import ARModel

ONE_MODE = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
SWELL = ARModel(coefficients=[1.97, -0.972], driving_rms_nm=4.0, frame_rate_hz=RATE)


def test_the_standard_errors_are_those_of_many_nights():
    """Correlated axes, coloured residuals, two stretches: errors per axis, in total, and paired."""
    rng = np.random.default_rng(7)
    stretches = ((0, 700), (900, 1500))
    rows = np.r_[0:700, 900:1500]
    noise = np.diag([1.0, 4.0])
    mixing = np.array([[1.0, 0.0], [0.8, 0.6]])
    model = ARModel(coefficients=[0.9], driving_rms_nm=1.0, frame_rate_hz=RATE)
    # of y = 0.4 x and of x itself, both with the same noise
    exact = np.array([1, 0.16])[:, None, None] * mixing @ mixing.T * model.rms_nm**2
    seen, errors, paired, paired_errors = [], [], [], []
    for _ in range(300):
        x = np.column_stack([a_series(model, 1500, rng, 200) for _ in range(2)]) @ mixing.T
        w = rng.standard_normal((1500, 2)) @ np.sqrt(noise)
        one, other = (
            estimate_residual(
                (part * x + w)[rows], stretches, noise_nm2=noise, noise_error_nm4=np.zeros((2, 2))
            )
            for part in (1.0, 0.4)
        )
        seen.append([*one.variance_nm2, one.total_nm2])
        errors.append([*np.sqrt(np.diag(one.error_nm4)), one.total_error_nm2])
        difference, error = one.above(other)
        paired.append(difference)
        paired_errors.append(error)
    wanted = np.array([*np.diag(exact[0]), np.trace(exact[0])])
    seen, errors = np.array(seen), np.sqrt(np.mean(np.square(errors), axis=0))
    scatter = np.std(seen, axis=0)
    # 300 nights know their scatter to 4 %, and their mean to scatter / 17
    np.testing.assert_allclose(scatter, errors, rtol=0.15)
    assert np.all(np.abs(np.mean(seen, axis=0) - wanted) < 4 * scatter / np.sqrt(300))
    # without the correlation of the axes the error of the total would be too small
    assert errors[2] > 1.1 * np.hypot(errors[0], errors[1])
    rms = np.sqrt(np.mean(np.square(paired_errors)))
    assert np.std(paired) == pytest.approx(rms, rel=0.15)
    assert abs(np.mean(paired) - np.trace(exact[0] - exact[1])) < 4 * rms / np.sqrt(300)
    backwards, error = other.above(one)
    assert (backwards, error) == (-paired[-1], pytest.approx(paired_errors[-1], rel=1e-12))


@pytest.mark.study
def test_the_errors_of_a_pure_sinusoid_are_far_too_large():
    """They are those of Gaussian series; the mean square of a sinusoid hardly scatters."""
    path, rng = lbt.LoopHardware(frame_rate_hz=RATE, modes=1), np.random.default_rng(7)
    air = ARModel(coefficients=[1.97, -0.972], driving_rms_nm=4.0, frame_rate_hz=RATE)
    new = lbt.integrator(path, gain=0.3).controller
    seen, errors = [], []
    for phase in rng.uniform(0, 2 * np.pi, 60):
        line = np.sqrt(2) * 200 * np.sin(2 * np.pi * 20 * np.arange(6000) / RATE + phase)
        z = (line + a_series(air, 6000, rng) + 15.5 * rng.standard_normal(6000))[:, None]
        found = lbt.identification.replayed_residual(z, new, path, noise_nm=15.5)
        seen.append(found.total_nm2)
        errors.append(found.total_error_nm2)
    assert 12 < np.sqrt(np.mean(np.square(errors))) / np.std(seen) < 20


def test_the_noise_of_coupled_sensors_has_common_errors():
    """Against the noise subtracted with each deviation a little larger, one at a time."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, sensor_matrix=[[1, 0.9], [0.9, 1]])
    z = 100 * np.random.default_rng(0).standard_normal((1000, 2))
    new = lbt.integrator(path, gain=0.3).controller
    noise, error = np.array([10.0, 8.0]), np.array([1.0, 0.5])

    def estimate(noise_nm, error_nm):
        return lbt.identification.replayed_residual(
            z, new, path, noise_nm=noise_nm, noise_error_nm=error_nm
        )

    added = estimate(noise, error).error_nm4 - estimate(noise, 0.0).error_nm4
    more = [estimate(noise + 0.01 * step, 0.0).variance_nm2 for step in np.eye(2)]
    less = [estimate(noise - 0.01 * step, 0.0).variance_nm2 for step in np.eye(2)]
    slope = (np.array(more) - np.array(less)).T / 0.02
    np.testing.assert_allclose(added, slope @ np.diag(error**2) @ slope.T, rtol=1e-6)
    # 2 s ds through the squares of the inverse, on both axes at once
    squares = np.linalg.inv(path.sensor) ** 2
    total = np.linalg.norm(np.sum(squares, axis=0) * 2 * noise * error)
    assert np.sqrt(np.sum(added)) == pytest.approx(total, rel=1e-9)
    assert total > 1.3 * np.sqrt(np.trace(added))


def test_a_residual_far_below_zero_refutes_the_noise():
    idle = lbt.Controller(A=0.0, B=0.0, C=0.0, D=0.0, dt_s=1 / RATE)
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    z = 10 * np.random.default_rng(0).standard_normal((4000, 1))
    right, wrong = (
        lbt.identification.replayed_residual(z, idle, path, noise_nm=s) for s in (10.0, 12.0)
    )
    assert not right.refuted
    assert np.isfinite(right.upper_nm)
    assert wrong.refuted
    below = -wrong.total_nm2 / wrong.total_error_nm2
    assert below == pytest.approx(44 * np.sqrt(3600 / 2) / 100, rel=0.1)
    assert np.isnan([wrong.upper_nm, wrong.rms_nm, wrong.rms_error_nm]).all()
    # one axis is enough
    both = lbt.identification.replayed_residual(
        np.column_stack([z, 10 * z]),
        lbt.Controller(A=0.0, B=[[0.0, 0.0]], C=[[0.0], [0.0]], D=np.zeros((2, 2)), dt_s=1 / RATE),
        PATH,
        noise_nm=12.0,
    )
    assert both.total_nm2 > 0
    assert both.refuted


def test_a_residual_below_its_noise_is_not_cut_off():
    path = lbt.LoopHardware(frame_rate_hz=RATE)
    idle = lbt.Controller(
        A=0.0, B=[[0.0, 0.0]], C=[[0.0], [0.0]], D=np.zeros((2, 2)), dt_s=1 / RATE
    )
    signs = []
    for seed in range(40):
        z = 10 * np.random.default_rng(seed).standard_normal((800, 2))
        found = lbt.identification.replayed_residual(z, idle, path, noise_nm=10.0)
        exact = np.sum(np.mean(z[400:] ** 2, axis=0)) - 200
        assert found.total_nm2 == pytest.approx(exact, abs=1e-9)
        assert abs(found.total_nm2) < 5 * found.total_error_nm2
        negative = found.total_nm2 < 0
        assert np.isnan(found.rms_nm) == np.isnan(found.rms_error_nm) == negative
        assert found.upper_nm**2 == pytest.approx(
            max(found.total_nm2 + 2 * found.total_error_nm2, 0)
        )
        signs.append(negative)
    assert 10 < sum(signs) < 30  # there is nothing: either sign


@pytest.mark.parametrize(
    ("delay", "gain", "mirror", "sensor", "method"),
    [
        (1.0, 0.6, None, None, "integrator"),
        (2.4, 0.5, None, None, "lqg"),
        (2.25, 0.8, SHELL, TILTED, "lqg"),
        (3.0, 1.3, SHELL, None, "integrator"),
    ],
)
def test_a_replay_is_the_run_that_there_would_have_been(delay, gain, mirror, sensor, method):
    """Another controller's record gives the residual and noise of a run under the same truth.

    As soon as both have forgotten where they began.
    """
    path = a_plant(delay=delay, mirror=mirror, sensor=sensor).hardware
    ran = lbt.integrator(path, gain=0.15).controller
    if method == "lqg":
        new = lbt.lqg(a_plant(delay=delay, gain=gain, mirror=mirror, sensor=sensor)).controller
    else:
        new = lbt.integrator(path, gain=0.25).controller
    truth, size = a_truth(gain), {"hardware": path, "frames": 2400, "seed": 3, "settle_frames": 0}
    night = lbt.simulate(ran, truth, **size)
    would = lbt.simulate(new.start(), truth, **size)  # stepped frame by frame
    assert np.array_equal(night.total_nm, would.total_nm)
    z = pseudo_open_loop(night.measurements[0], night.commands[0], path, gain)
    found = lbt.identification.replayed_residual(
        z, new, replace(path, sensor_matrix=gain * path.sensor), noise_nm=15.5, test=[(2000, 2400)]
    )
    wanted = would.measurements[0, 2000:] @ np.linalg.inv(gain * path.sensor).T
    scale = np.max(np.abs(wanted))
    np.testing.assert_allclose(found.measured_nm, wanted, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(
        found.noise_nm2,
        15.5**2 * np.linalg.inv(sensed := gain * path.sensor) @ np.linalg.inv(sensed).T,
    )
    # and that residual is the phase of the frame before, with its noise
    phase = would.residual_nm[0, 1999:-1]
    noise = (would.measurements[0, 2000:] - gain * phase @ path.sensor.T) @ np.linalg.inv(
        gain * path.sensor
    ).T
    np.testing.assert_allclose(found.measured_nm, phase + noise, rtol=0, atol=1e-9 * scale)
    back = np.linalg.inv(gain * path.sensor)
    np.testing.assert_allclose(
        found.covariance_nm2,
        wanted.T @ wanted / 400 - 15.5**2 * back @ back.T,
        rtol=0,
        atol=1e-9 * scale**2,
    )


@settings(max_examples=10)
@given(
    st.integers(0, 2**31),
    st.floats(1e-3, 1e3),
    st.integers(0, 300),
    st.sampled_from([1.0, 1.7, 2.0, 2.5]),
)
def test_scale_and_beginning(seed, scale, start, delay):
    """A replay is linear, and begins with its stretch: what lies outside is not read."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay)
    new = lbt.integrator(path, gain=0.3).controller
    z = np.random.default_rng(seed).standard_normal((1200, 2))
    whole = lbt.identification.replayed_residual(z[start:], new, path, noise_nm=0.1)
    torn = np.full_like(z, np.nan)
    torn[start:] = scale * z[start:]
    part = lbt.identification.replayed_residual(
        torn, new, path, noise_nm=0.1 * scale, stretches=[(start, 1200)]
    )
    assert part.stretches == ((start + 400, 1200),)
    np.testing.assert_allclose(
        part.measured_nm, scale * whole.measured_nm, rtol=0, atol=1e-12 * scale
    )
    np.testing.assert_allclose(
        part.covariance_nm2, scale**2 * whole.covariance_nm2, rtol=1e-9, atol=1e-9 * scale**2
    )
    assert part.total_error_nm2 == pytest.approx(scale**2 * whole.total_error_nm2, rel=1e-9)


def test_a_constant_needs_no_warming_up():
    """However slow the loop is: a replay begins in its equilibrium."""
    path = a_plant().hardware
    z = 1e6 + np.random.default_rng(0).standard_normal((5000, 2))
    for new in (lbt.integrator(path, gain=2e-5), lbt.kalman(a_plant())):
        found, without = (
            lbt.identification.replayed_residual(one, new.controller, path, noise_nm=0.0)
            for one in (z, z - 1e6)
        )
        constant = lbt.close_loop(path, new.controller).rejection().frequency_response([0.0])[0]
        left = found.measured_nm - 1e6 * np.sum(constant.real, axis=1)
        assert found.stretches == without.stretches
        np.testing.assert_allclose(left, without.measured_nm, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("runs", "test", "kept"),
    [
        ([(0, 4000)], [(2000, 4000)], [(2000, 4000)]),
        ([(0, 4000)], [(100, 3000)], [(400, 3000)]),
        ([(0, 900), (950, 4000)], [(500, 900), (950, 3000)], [(500, 900), (1350, 3000)]),
        ([(0, 900), (950, 1300), (1400, 4000)], [(950, 1300), (1600, 4000)], [(1800, 4000)]),
    ],
)
def test_the_first_half_second_of_a_stretch_does_not_count(runs, test, kept):
    assert settled_test(tuple(runs), tuple(test), ONE_MODE) == tuple(kept)


def test_replays_that_begin_in_a_record_cover_those_that_know_its_past():
    """A loop that forgets slowly: what its start adds is within the error of the residual."""
    deviations = []
    loop = lbt.close_loop(ONE_MODE, lbt.integrator(ONE_MODE, gain=0.001).controller)
    for seed in range(30):
        z = a_series(SWELL, 20_000, np.random.default_rng(seed))[:, None]
        knowing, late = (replay(loop, z, ((first, 20_000),))[12_400:] for first in (0, 12_000))
        zero = np.zeros((1, 1))
        found = estimate_residual(late, ((12_400, 20_000),), zero, zero)
        deviations.append((found.total_nm2 - np.mean(knowing**2)) / found.total_error_nm2)
    assert np.mean(np.abs(deviations) < 1) > 2 / 3


def test_a_residual_in_words():
    zero = np.zeros((1, 1))
    z = 10 * np.random.default_rng(0).standard_normal((4000, 1))
    shown, hidden, refuted = (
        estimate_residual(z, ((0, 4000),), noise * np.eye(1), zero) for noise in (50, 100, 150)
    )
    assert shown.text == f"{shown.rms_nm:.3g} +- {shown.rms_error_nm:.2g} nm"
    assert hidden.text == f"at most {hidden.upper_nm:.2g} nm (the noise hides it)"
    assert "more noise than the data" in refuted.text
    assert 0 < hidden.strehl(CAMERA) <= 1
    assert np.isnan(refuted.strehl(CAMERA))


def test_the_future_changes_nothing_before_it():
    """Nor does what a replay begins with: it runs over the frames before the test."""
    z = np.random.default_rng(0).standard_normal((3000, 2)).cumsum(axis=0)
    later = z.copy()
    later[2600:] += 1000.0
    new = lbt.kalman(a_plant()).controller
    one, other = (
        lbt.identification.replayed_residual(
            series, new, PATH, noise_nm=1.0, stretches=[(10, 3000)], test=[(1500, 3000)]
        ).measured_nm
        for series in (z, later)
    )
    assert np.array_equal(one[:1100], other[:1100])
    assert np.max(np.abs(one[1100:] - other[1100:])) > 500


@cache
def short_record() -> lbt.identification.LoopRecord:
    """Return one axis for 18 s, in the loop of an integrator."""
    path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    slow = ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=500)
    line = lbt.Vibration(frequency_hz=40, damping=0.01, rms_nm=60, direction=(1.0,))
    truth = lbt.Truth(turbulence=slow, vibrations=(line,), noise_nm=5.0, sensor_gain=0.8)
    law = lbt.integrator(path, gain=0.3).controller
    run = lbt.simulate(law, truth, hardware=path, frames=9000)
    return lbt.identification.loop_record(
        run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    )


INTEGRATOR = lbt.integrator(PATH, gain=0.3).controller
REFUSED = (ProblemError, UnstableLoopError)
STRONG = replace(PATH, sensor_matrix=4 * np.eye(2))


def replayed(series=GOOD, path=PATH, **options):
    options = {"noise_nm": 1.0} | options
    return lbt.identification.replayed_residual(series, INTEGRATOR, path, **options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: replayed(GOOD[:, :1]), r"open_loop must be \(frames, 2\)"),
        (lambda: replayed(GOOD[0]), r"open_loop must be \(frames, 2\)"),
        (lambda: replayed(GOOD[:0]), r"open_loop must be \(frames, 2\)"),
        (lambda: replayed(GOOD + 0j), "open_loop must be real"),
        (lambda: replayed(SPOILT), r"frames 0 to 2000, must be finite; .* index \(77, 0\)"),
        (lambda: replayed(SPOILT, stretches=[(50, 900)]), r"frames 50 to 900, .* index \(27, 0\)"),
        (lambda: replayed(noise_nm=-1.0), "noise_nm must be at least 0"),
        (lambda: replayed(noise_nm=[1.0, 2.0, 3.0]), r"or one per measurement \(2\); got 3"),
        (lambda: replayed(noise_nm=np.nan), "noise_nm must be finite"),
        (lambda: replayed(noise_error_nm=-0.1), "noise_error_nm must be at least 0"),
        (lambda: replayed(test=[(1950, 2000)]), "at least 400 frames beyond the first 400 .* 50"),
        (
            lambda: replayed(test=[(800, 2000)], stretches=[(0, 900), (900, 2000)]),
            r"within the usable stretches; got \(800, 2000\) in \(0, 900\), \(900, 2000\)",
        ),
        (lambda: replayed(stretches=[(0, 2001)]), "within 2000 frames"),
        (lambda: replayed(path=FLAT), r"can be inverted; got \(2, 2\) of rank 1"),
        (lambda: replayed(path=STRONG), "must be stable"),
        (lambda: replayed(path=a_plant()), "expected a LoopHardware"),
        (lambda: replayed().above(replayed(test=[(500, 2000)])), "on the same frames only"),
    ],
)
def test_what_cannot_be_replayed_is_refused(call, message):
    with pytest.raises(REFUSED, match=message):
        call()


def test_the_league_of_designs_and_rivals(monkeypatch, capsys):
    """The script of the benchmarks ranks a filter of the model above the best integrator."""
    league = runpy.run_path(str(ROOT / "benchmarks/league.py"))
    names = ("best integrator", "least squares, 32 taps", "Kalman")
    entries = {name: league["ENTRIES"][name] for name in names}
    monkeypatch.setitem(league["play"].__globals__, "ENTRIES", entries)
    short = replace(short_record(), measured=np.arange(9000) < 600)
    league["play"]({"night": short_record(), "brief": short}, 2)
    failure, _, heading, *rows = capsys.readouterr().out.splitlines()
    assert failure.startswith("brief is not in the table: ")
    assert heading.split()[-1] == "night"
    assert [row[:26].strip() for row in rows] == ["Kalman", "least squares, 32 taps", names[0]]
    assert float(rows[0].split()[-1]) == 0.0
    assert float(rows[2].split()[-1]) > 20
