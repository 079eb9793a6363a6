"""Margins and broken loops, against closed forms and loops that they make unstable."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.lqg import shell
from support.refusals import refused
from support.sensor_loops import example_plant

import lbt_synth as lbt
from lbt_synth.loop.margins import broken_loops

RATE = 800.0


def loop_of(gain, pole=1.0, *, delay=2, modes=1, **path):
    """Return the loop of a law of first order, an integrator unless it has another pole."""
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=modes, **path)
    A, B = pole * np.eye(modes), np.diag(np.broadcast_to(gain, modes))
    law = lbt.Controller(A=A, B=B, C=np.eye(modes), D=np.zeros_like(A), dt_s=1 / RATE)
    return lbt.close_loop(hardware, law)


@pytest.mark.parametrize(("delay", "gain"), [(1, 1.2), (2, 0.5), (3, 0.1)])
def test_an_integrator_has_the_margins_of_its_closed_form(delay, gain):
    """``L = g z^-d / (1 - z^-1)``: a gain of g / (2 sin(w/2)), a phase of -90 + (1/2 - d) w."""
    loop = loop_of(gain, delay=delay)
    (response,), margins = broken_loops(loop), lbt.loop_margins(loop)
    omega = 2 * np.pi * response.frequency_hz / RATE
    expected_db = 20 * np.log10(gain / (2 * np.sin(omega / 2)))
    assert np.allclose(response.gain_db, expected_db, atol=1e-6)
    assert np.allclose(response.phase_deg, -90 + np.degrees((0.5 - delay) * omega), atol=1e-5)
    (crossing,), turn = response.gain_crossings, np.arcsin(gain / 2)
    assert response.phase_margin == crossing
    expected = RATE / np.pi * turn, 90 - np.degrees((2 * delay - 1) * turn)
    assert (crossing.frequency_hz, crossing.phase_deg) == pytest.approx(expected)
    assert (margins.crossover_hz, margins.phase_deg) == pytest.approx(expected, rel=1e-9)
    (rise,), limit = response.gain_margins, 2 * np.sin(np.pi / (2 * (2 * delay - 1)))
    assert (rise.gain, margins.gain_high) == pytest.approx((limit / gain,) * 2, rel=1e-9)
    # an exposure that ends within a frame sees two commands
    late, f = divmod(delay + margins.delay_frames, 1)
    poles = np.roots(np.polyadd([1, -1] + [0] * int(late), [gain * (1 - f), gain * f]))
    assert np.abs(poles).max() == pytest.approx(1, abs=1e-7)
    z = np.exp(1j * np.linspace(1e-4, np.pi, 400_001))
    L = gain * z**-delay / (1 - 1 / z)
    assert margins.modulus == pytest.approx(np.abs(1 + L).min(), rel=1e-6)
    # the disk margin of one axis: the norm of (S - T) / 2
    assert margins.disk == pytest.approx(1 / np.max(abs((1 - L) / (1 + L) / 2)), rel=1e-6)
    assert margins.disk_gain_low == pytest.approx(1 / margins.disk_gain_high)
    assert margins.disk_gain_high < margins.gain_high
    assert margins.disk_phase_deg < margins.phase_deg


def test_loops_without_a_crossing_and_of_two_integrators():
    timid = loop_of(0.1, 0.5)
    (response,), margins = broken_loops(timid), lbt.loop_margins(timid)
    assert response.phase_margin is None
    assert response.phase_deg[0] == pytest.approx(0, abs=1e-3)
    assert (margins.phase_deg, margins.delay_frames) == (np.inf, np.inf)
    law = lbt.design.IntegratorLaw(integrators=2, zero_hz=40)
    twice = lbt.integrator(timid.hardware, gain=0.1, law=law)
    (response,) = broken_loops(lbt.close_loop(timid.hardware, twice))
    assert response.phase_deg[0] == pytest.approx(-180, abs=1)


def test_equal_axes_share_a_response_and_others_have_their_own():
    (shared,) = broken_loops(loop_of(0.3, modes=3))
    assert shared.measurements == (0, 1, 2)
    loop = loop_of((0.2, 0.4, 0.2), modes=3)
    responses = broken_loops(loop)
    assert [response.measurements for response in responses] == [(0, 2), (1,)]
    margins = [response.phase_margin.phase_deg for response in responses]
    assert margins == pytest.approx([90 - np.degrees(3 * np.arcsin(g / 2)) for g in (0.2, 0.4)])
    assert lbt.loop_margins(loop).phase_deg == margins[1]


def test_a_loop_of_an_unstable_controller_has_a_margin_on_both_sides():
    """``L = 0.3 z^-2 / (1 - 1.02 z^-1)`` is -15 at frequency 0."""
    loop = loop_of(0.3, 1.02)
    (response,) = broken_loops(loop)
    fall, rise = response.gain_margins
    assert (fall.gain, fall.frequency_hz) == (pytest.approx(0.02 / 0.3), 0)
    assert rise.gain == pytest.approx(lbt.loop_margins(loop).gain_high)
    assert response.phase_deg[0] == pytest.approx(-180, abs=0.1)


def test_a_response_is_followed_around_its_zeros():
    """``L = 0.15 z^-2 n(z) / (1 - z^-1)``, with two zeros n just inside the unit circle."""
    omega, radius = 2 * np.pi * 137.3 / RATE, 0.999
    notch = np.array([1, -2 * radius * np.cos(omega), radius**2])
    notch *= 0.15 / notch.sum()
    A = [[1, notch[1], notch[2]], [0, 0, 0], [0, 1, 0]]  # a sum, and the last two measurements
    law = lbt.Controller(A=A, B=[[notch[0]], [1], [0]], C=[[1, 0, 0]], D=0.0, dt_s=1 / RATE)
    (response,) = broken_loops(lbt.close_loop(lbt.LoopHardware(frame_rate_hz=RATE, modes=1), law))
    z = np.exp(2j * np.pi * response.frequency_hz / RATE)
    expected = np.polyval(notch[::-1], 1 / z) / z**2 / (1 - 1 / z)
    assert np.allclose(response.response, expected, rtol=1e-6)
    assert np.max(np.abs(np.diff(np.unwrap(np.angle(expected))))) < 0.2
    centre = np.exp(1j * omega)
    least = np.abs(np.polyval(notch[::-1], 1 / centre) / (1 - 1 / centre))
    assert response.gain_db.min() == pytest.approx(20 * np.log10(least), abs=0.1)


def test_a_response_that_vanishes_has_no_phase_there():
    """Half a frame of delay: ``(1 + z^-1) / 2`` is 0 at half the frame rate."""
    (response,) = broken_loops(loop_of(0.3, delay=2.5))
    omega = 2 * np.pi * response.frequency_hz / RATE
    assert np.isnan(response.phase_deg[-1])
    assert np.allclose(response.phase_deg[:-1], -90 - np.degrees(2 * omega[:-1]), atol=1e-4)
    (rise,) = response.gain_margins
    assert rise.frequency_hz == pytest.approx(RATE / 8)


def test_marginal_and_unstable_loops_have_no_residual():
    # the pole is 1 - gain
    assert [loop_of(gain, delay=1).is_stable for gain in (1.1e-9, 0.9e-9)] == [True, False]
    truth, unstable = lbt.Truth(turbulence=None, noise_nm=1.0), lbt.errors.UnstableLoopError
    for gain, word in ((1.0, "marginally stable"), (1.5, "unstable")):
        loop = loop_of(gain)
        path, law = loop.hardware, loop.controller
        asks = partial(lbt.residual_budget, loop, truth), partial(lbt.loop_margins, loop)
        for ask in (*asks, partial(broken_loops, loop)):
            assert refused(ask, unstable, word).spectral_radius >= 1 - 1e-6
        refused(partial(lbt.simulate, law, truth, hardware=path, frames=9), unstable, word)
        assert np.all(np.isnan(lbt.loop.stable_sensor_gains(path, law)))
    plant = example_plant()
    several = lbt.close_loop(plant.hardware, lbt.kalman(plant))
    words = "broken loop needs a period of 1; got one of 4"
    refused(lambda: broken_loops(several), lbt.errors.ProblemError, words)


def test_the_delay_margin_does_not_step_over_a_whole_delay():
    """At a whole delay the loop gain has a peak, here narrower than a step of the search."""
    air = lbt.models.ARModel(coefficients=[0.9999], driving_rms_nm=0.05, frame_rate_hz=1000)
    line = lbt.Vibration(frequency_hz=60, damping=0.003, rms_nm=50, direction=(1,))
    facts = {"frame_rate_hz": 1000, "delay_frames": 1.7, "noise_nm": 0.04, "modes": 1}
    plant = lbt.tip_tilt_plant(**facts, turbulence=air, vibrations=[line])
    early, whole = (
        lbt.close_loop(path, lbt.kalman(plant), sensor_gain=0.978)
        for path in (plant.hardware, replace(plant.hardware, delay_frames=2.0))
    )
    assert whole.spectral_radius > 1.003
    assert 0.29 < lbt.loop_margins(early).delay_frames < 0.3


def test_gains_of_each_axis_within_the_disk_keep_a_coupled_loop_stable():
    """Two lines along directions that are not at right angles, and a mirror that is askew."""
    plant = example_plant((), noise_nm=5.0, influence_matrix=[[1.0, 0.6], [0.0, 0.8]])
    path, law = plant.hardware, lbt.kalman(plant)
    margins = lbt.loop_margins(lbt.close_loop(path, law))
    assert margins.disk_gain_low > margins.gain_low  # a common gain is easier to bear
    low, high = corners = [margins.disk_gain_low, margins.disk_gain_high]
    gains = [(a, b) for a in corners for b in corners] + [(0.6 * low, 1.6 * high)]
    paths = [replace(path, sensor_matrix=np.diag(pair) @ path.sensor) for pair in gains]
    stable = [lbt.close_loop(moved, law).is_stable for moved in paths]
    assert stable == [True] * 4 + [False]


@pytest.mark.parametrize(("delay", "gain"), [(1.0, 1.8), (2.0, 0.5), (2.4, 0.1)])
def test_a_loop_is_stable_at_its_delay_margin_and_not_beyond(delay, gain):
    margin = lbt.loop_margins(loop_of(gain, delay=delay)).delay_frames
    further = margin * np.array([0.3, 0.6, 0.9, 1.0, 1.01])
    stable = [loop_of(gain, delay=delay + frames).is_stable for frames in further]
    assert stable == [True] * 4 + [False]


@pytest.mark.parametrize(("delay", "pole"), [(1.5, -0.5), (2.0, -0.5)])
def test_a_loop_that_needs_its_delay_has_an_early_margin(delay, pole):
    """``z (z - a) + g ((1 - f) z + f)`` of a delay 1 + f has the root -1 at a fraction f."""
    margins = lbt.loop_margins(loop_of(0.9, pole, delay=delay))
    assert margins.early_frames == pytest.approx(delay - 1 - (0.9 - 1 - pole) / 1.8, rel=1e-6)


def test_a_delay_margin_may_be_longer_than_any_delay():
    """A slow loop bears more delay than a loop is made with; of a slow mirror the mean counts."""
    slow = loop_of(0.03, mirror=shell(300, natural_frequency_hz=50, sampling_hz=8000))
    margin, taps = lbt.loop_margins(slow).delay_frames, slow.hardware.mirror_taps
    limit = 0.5 + np.pi / (4 * np.arcsin(0.03 / 2))  # delay at which the gain is the limit
    assert 1 + taps @ np.arange(taps.size) + margin == pytest.approx(limit, abs=0.1)
    assert margin > 20
    # beyond 100 frames none is sought
    slower = loop_of(2 * np.sin(np.pi / (2 * (2 * 101 - 1))))
    assert lbt.loop_margins(slower).delay_frames == np.inf
