"""Margins and broken loops, against closed forms and loops that they make unstable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.sensor_loops import example_plant

import lbt_synth as lbt
from lbt_synth.loop.margins import broken_loops

RATE = 800.0


def broken(gain, *, delay=2, modes=1, **path):
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=modes, **path)
    return broken_loops(lbt.close_loop(hardware, lbt.integrator(hardware, gain=gain).controller))


@pytest.mark.parametrize(("delay", "gain"), [(1, 1.2), (3, 0.1)])
def test_an_integrator_has_the_crossings_of_its_closed_form(delay, gain):
    """``L = g z^-d / (1 - z^-1)``: a gain of g / (2 sin(w/2)), a phase of -90 + (1/2 - d) w."""
    (response,) = broken(gain, delay=delay)
    omega = 2 * np.pi * response.frequency_hz / RATE
    expected_db = 20 * np.log10(gain / (2 * np.sin(omega / 2)))
    assert np.allclose(response.gain_db, expected_db, atol=1e-6)
    assert np.allclose(response.phase_deg, -90 + np.degrees((0.5 - delay) * omega), atol=1e-5)
    (crossing,), turn = response.gain_crossings, np.arcsin(gain / 2)
    assert response.phase_margin == crossing
    assert crossing.frequency_hz == pytest.approx(RATE / np.pi * turn)
    assert crossing.phase_deg == pytest.approx(90 - np.degrees((2 * delay - 1) * turn))
    (rise,) = response.gain_margins
    limit = 2 * np.sin(np.pi / (2 * (2 * delay - 1)))
    assert rise.gain == pytest.approx(limit / gain)


def test_loops_without_a_crossing_and_of_two_integrators():
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    timid = lbt.Controller(A=0.5, B=0.1, C=1.0, D=0.0, dt_s=1 / RATE)
    loop = lbt.close_loop(hardware, timid)
    (response,) = broken_loops(loop)
    assert response.phase_margin is None
    assert response.phase_deg[0] == pytest.approx(0, abs=1e-3)
    margins = lbt.loop_margins(loop)
    assert (margins.phase_deg, margins.delay_frames) == (np.inf, np.inf)
    law = lbt.design.IntegratorLaw(integrators=2, zero_hz=40)
    twice = lbt.integrator(hardware, gain=0.1, law=law)
    (response,) = broken_loops(lbt.close_loop(hardware, twice.controller))
    assert response.phase_deg[0] == pytest.approx(-180, abs=1)


def test_equal_axes_share_a_response_and_others_have_their_own():
    assert [each.measurements for each in broken(0.3, modes=3)] == [(0, 1, 2)]
    one, two, three = (0.2, 0.4, 0.2)
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, modes=3)
    controller = lbt.Controller(
        A=np.eye(3), B=np.diag([one, two, three]), C=np.eye(3), D=np.zeros((3, 3)), dt_s=1 / RATE
    )
    found = broken_loops(lbt.close_loop(hardware, controller))
    assert [each.measurements for each in found] == [(0, 2), (1,)]
    margins = [each.phase_margin.phase_deg for each in found]
    assert margins == pytest.approx([90 - np.degrees(3 * np.arcsin(g / 2)) for g in (one, two)])
    assert lbt.loop_margins(lbt.close_loop(hardware, controller)).phase_deg == margins[1]


def test_a_loop_of_an_unstable_controller_has_a_margin_on_both_sides():
    """``L = 0.3 z^-2 / (1 - 1.02 z^-1)`` is -15 at frequency 0."""
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    growing = lbt.Controller(A=1.02, B=0.3, C=1.0, D=0.0, dt_s=1 / RATE)
    loop = lbt.close_loop(hardware, growing)
    margins = lbt.loop_margins(loop)
    (found,) = broken_loops(loop)
    fall, rise = found.gain_margins
    assert (fall.gain, fall.frequency_hz) == (pytest.approx(0.02 / 0.3), 0)
    assert rise.gain == pytest.approx(margins.gain_high)
    assert found.phase_deg[0] == pytest.approx(-180, abs=0.1)


def test_a_response_is_followed_around_its_zeros():
    """``L = 0.15 z^-2 n(z) / (1 - z^-1)``, with two zeros n just inside the unit circle."""
    omega, radius = 2 * np.pi * 137.3 / RATE, 0.999
    notch = np.array([1, -2 * radius * np.cos(omega), radius**2])
    notch *= 0.15 / notch.sum()
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    controller = lbt.Controller(  # a sum, and the last two measurements
        A=[[1, notch[1], notch[2]], [0, 0, 0], [0, 1, 0]],
        B=[[notch[0]], [1], [0]],
        C=[[1, 0, 0]],
        D=0.0,
        dt_s=1 / RATE,
    )
    loop = lbt.close_loop(hardware, controller)
    (found,) = broken_loops(loop)
    z = np.exp(2j * np.pi * found.frequency_hz / RATE)
    expected = np.polyval(notch[::-1], 1 / z) / z**2 / (1 - 1 / z)
    assert np.allclose(found.response, expected, rtol=1e-6)
    assert np.max(np.abs(np.diff(np.unwrap(np.angle(expected))))) < 0.2
    centre = np.exp(1j * omega)
    least = np.abs(np.polyval(notch[::-1], 1 / centre) / (1 - 1 / centre))
    assert found.gain_db.min() == pytest.approx(20 * np.log10(least), abs=0.1)


def test_a_response_that_vanishes_has_no_phase_there():
    """Half a frame of delay: ``(1 + z^-1) / 2`` is 0 at half the frame rate."""
    (found,) = broken(0.3, delay=2.5)
    omega = 2 * np.pi * found.frequency_hz / RATE
    assert np.isnan(found.phase_deg[-1])
    assert np.allclose(found.phase_deg[:-1], -90 - np.degrees(2 * omega[:-1]), atol=1e-4)
    (rise,) = found.gain_margins
    assert rise.frequency_hz == pytest.approx(RATE / 8)


def test_marginal_and_unstable_loops_have_no_residual():
    direct = lbt.LoopHardware(frame_rate_hz=800, delay_frames=1, modes=1)
    for gain, stable in ((1.1e-9, True), (0.9e-9, False)):  # the pole is 1 - gain
        integrator = lbt.Controller(A=1.0, B=gain, C=1.0, D=0.0, dt_s=1 / 800)
        assert lbt.close_loop(direct, integrator).is_stable is stable
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    truth = lbt.Truth(turbulence=None, noise_nm=1.0)
    for gain, word in ((1.0, "marginally stable"), (1.5, "unstable")):
        controller = lbt.Controller(A=1.0, B=gain, C=1.0, D=0.0, dt_s=1 / 800)
        loop = lbt.close_loop(path, controller)
        for ask in (
            lambda loop=loop: lbt.residual_budget(loop, truth),
            lambda loop=loop: lbt.loop_margins(loop),
            lambda loop=loop: broken_loops(loop),
        ):
            with pytest.raises(lbt.errors.UnstableLoopError, match=word) as caught:
                ask()
            assert caught.value.spectral_radius >= 1 - 1e-6
        with pytest.raises(lbt.errors.UnstableLoopError):
            lbt.simulate(controller, truth, hardware=path, frames=10)
        assert np.all(np.isnan(lbt.loop.stable_sensor_gains(path, controller)))
    plant = example_plant()
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant))
    with pytest.raises(
        lbt.errors.ProblemError, match="broken loop needs a period of 1; got one of 4"
    ):
        broken_loops(loop)


def test_margins_of_an_integrator_against_hand_computation():
    """g z^-2/(1 - z^-1) = exp(-3j w/2) g / (2j sin(w/2)): |L| = 1 at w = 2 asin(g/2)."""
    g = 0.5
    path = lbt.LoopHardware(frame_rate_hz=1000, modes=1)
    margins = lbt.loop_margins(lbt.close_loop(path, lbt.integrator(path, gain=g).controller))
    w = 2 * np.arcsin(g / 2)
    phase = np.pi / 2 - 1.5 * w
    assert margins.crossover_hz == pytest.approx(w / (2 * np.pi) * 1000, rel=1e-9)
    assert margins.phase_deg == pytest.approx(np.degrees(phase), rel=1e-9)
    # in the frame after the third an exposure sees two commands: z^4 - z^3 + g ((1 - f) z + f)
    f = margins.delay_frames - 1
    assert np.abs(np.roots([1, -1, 0, g * (1 - f), g * f])).max() == pytest.approx(1, abs=1e-7)
    assert margins.gain_high == pytest.approx(2.0, rel=1e-9)
    theta = np.linspace(1e-4, np.pi, 400_001)
    z = np.exp(1j * theta)
    distance = np.abs(1 + g * z**-2 / (1 - 1 / z)).min()
    assert margins.modulus == pytest.approx(distance, rel=1e-6)
    loop = g * z**-2 / (1 - 1 / z)  # the disk margin of one axis: the norm of (S - T) / 2
    expected = 1 / np.max(abs((1 - loop) / (1 + loop) / 2))
    assert margins.disk == pytest.approx(expected, rel=1e-6)
    assert margins.disk_gain_low == pytest.approx(1 / margins.disk_gain_high)
    assert margins.disk_gain_high < margins.gain_high
    assert margins.disk_phase_deg < margins.phase_deg


def test_the_delay_margin_does_not_step_over_a_whole_delay():
    """At a whole delay the loop gain has a peak, here narrower than a step of the search."""
    air = lbt.models.ARModel(coefficients=[0.9999], driving_rms_nm=0.05, frame_rate_hz=1000)
    line = lbt.Vibration(frequency_hz=60, damping=0.003, rms_nm=50, direction=(1,))
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=1000,
        turbulence=air,
        noise_nm=0.04,
        vibrations=[line],
        delay_frames=1.7,
        modes=1,
    )
    filters = lbt.kalman(plant)
    whole = lbt.close_loop(replace(plant.hardware, delay_frames=2.0), filters, sensor_gain=0.978)
    assert whole.spectral_radius > 1.003
    margin = lbt.loop_margins(lbt.close_loop(plant.hardware, filters, sensor_gain=0.978))
    assert 0.29 < margin.delay_frames < 0.3


@pytest.fixture(scope="module")
def coupled():
    """Two lines along directions that are not at right angles, and a mirror that is askew."""
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=500,
        turbulence=lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=20.0, frame_rate_hz=500),
        vibrations=[
            lbt.Vibration(frequency_hz=30, damping=0.01, rms_nm=200, direction=(0.8, 0.6)),
            lbt.Vibration(frequency_hz=47, damping=0.01, rms_nm=100, direction=(-0.28, 0.96)),
        ],
        noise_nm=5.0,
        influence_matrix=np.array([[1.0, 0.6], [0.0, 0.8]]),
    )
    return plant.hardware, lbt.kalman(plant).controller


def test_gains_of_each_axis_within_the_disk_keep_a_coupled_loop_stable(coupled):
    path, law = coupled
    margins = lbt.loop_margins(lbt.close_loop(path, law))
    assert margins.disk_gain_low > margins.gain_low  # a common gain is easier to bear
    corners = [margins.disk_gain_low, margins.disk_gain_high]
    for gains in ((a, b) for a in corners for b in corners):
        moved = replace(path, sensor_matrix=np.diag(gains) @ path.sensor)
        assert lbt.close_loop(moved, law).is_stable
    wide = replace(path, sensor_matrix=np.diag([0.6 * corners[0], 1.6 * corners[1]]) @ path.sensor)
    assert not lbt.close_loop(wide, law).is_stable


@pytest.mark.parametrize(("delay", "gain"), [(1.0, 0.9), (2.0, 0.5), (2.4, 0.1)])
def test_a_loop_is_stable_at_its_delay_margin_and_not_beyond(delay, gain):
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay, modes=1)
    limit = lbt.design.integrator_gain_limit(path)
    controller = lbt.integrator(path, gain=gain * limit).controller
    margin = lbt.loop_margins(lbt.close_loop(path, controller)).delay_frames

    def stable(further: float) -> bool:
        longer = replace(path, delay_frames=delay + further)
        return lbt.close_loop(longer, controller).is_stable

    assert all(stable(margin * part) for part in (0.3, 0.6, 0.9, 1.0))
    assert not stable(1.01 * margin)


@pytest.mark.parametrize(("delay", "pole"), [(1.5, -0.5), (2.0, -0.5)])
def test_a_loop_that_needs_its_delay_has_an_early_margin(delay, pole):
    """``z (z - a) + g ((1 - f) z + f)`` of a delay 1 + f has the root -1 at a fraction f."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1)
    law = lbt.Controller(A=pole, B=0.9, C=1.0, D=0.0, dt_s=1 / RATE)
    margins = lbt.loop_margins(lbt.close_loop(path, law))
    assert margins.early_frames == pytest.approx(delay - 1 - (0.9 - 1 - pole) / 1.8, rel=1e-6)


def test_a_delay_margin_may_be_longer_than_any_delay():
    """A slow loop bears more delay than a loop is made with; of a slow mirror the mean counts."""
    shell = lbt.models.PositionLoop.from_bandwidth(
        natural_frequency_hz=50, damping=0.5, bandwidth_hz=300, sampling_hz=8000
    )
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1, mirror=shell)
    slow = lbt.Controller(A=1.0, B=0.03, C=1.0, D=0.0, dt_s=1 / 800)
    margin = lbt.loop_margins(lbt.close_loop(path, slow)).delay_frames
    mean = 1 + path.mirror_taps @ np.arange(path.mirror_taps.size)
    limit = 0.5 + np.pi / (4 * np.arcsin(0.03 / 2))  # delay at which the gain is the limit
    assert mean + margin == pytest.approx(limit, abs=0.1)
    assert margin > 20
    path = replace(path, mirror=None)  # beyond 100 frames none is sought
    slow = replace(slow, B=[[2 * np.sin(np.pi / (2 * (2 * 101 - 1)))]])
    assert lbt.loop_margins(lbt.close_loop(path, slow)).delay_frames == np.inf
