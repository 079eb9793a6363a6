"""Broken loops of integrators, whose crossings have closed forms."""

import numpy as np
import pytest

import lbt_synth as lbt

RATE = 800.0


def broken(gain, *, delay=2, modes=1, **path):
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=modes, **path)
    return lbt.loop.broken_loops(
        lbt.close_loop(hardware, lbt.integrator(hardware, gain=gain).controller)
    )


@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize("gain", [0.1, 0.4])
def test_an_integrator_has_the_crossings_of_its_closed_form(gain, delay):
    """``L = g z^-d / (1 - z^-1)``: a gain of g / (2 sin(w/2)), a phase of -90 + (1/2 - d) w."""
    (found,) = broken(gain, delay=delay)
    omega = 2 * np.pi * found.frequency_hz / RATE
    assert np.allclose(found.gain_db, 20 * np.log10(gain / (2 * np.sin(omega / 2))), atol=1e-6)
    assert np.allclose(found.phase_deg, -90 + np.degrees((0.5 - delay) * omega), atol=1e-5)
    (crossing,) = found.gain_crossings
    assert found.phase_margin == crossing
    assert crossing.frequency_hz == pytest.approx(RATE / np.pi * np.arcsin(gain / 2))
    assert crossing.phase_deg == pytest.approx(
        90 - np.degrees((2 * delay - 1) * np.arcsin(gain / 2))
    )
    (rise,) = found.gain_margins
    assert rise.gain == pytest.approx(lbt.design.integrator_gain_limit(delay) / gain)


def test_equal_axes_share_a_response_and_others_have_their_own():
    assert [each.measurements for each in broken(0.3, modes=3)] == [(0, 1, 2)]
    one, two, three = (0.2, 0.4, 0.2)
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, modes=3)
    controller = lbt.Controller(
        A=np.eye(3), B=np.diag([one, two, three]), C=np.eye(3), D=np.zeros((3, 3)), dt_s=1 / RATE
    )
    found = lbt.loop.broken_loops(lbt.close_loop(hardware, controller))
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
    (found,) = lbt.loop.broken_loops(loop)
    fall, rise = found.gain_margins
    assert (fall.gain, fall.frequency_hz) == (pytest.approx(0.02 / 0.3), 0)
    assert rise.gain == pytest.approx(margins.gain_high)
    assert found.phase_deg[0] == pytest.approx(-180, abs=0.1)


def test_the_phase_of_two_integrators_begins_at_minus_180():
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    law = lbt.design.IntegratorLaw(integrators=2, zero_hz=40)
    twice = lbt.integrator(hardware, gain=0.1, law=law)
    (found,) = lbt.loop.broken_loops(lbt.close_loop(hardware, twice.controller))
    assert found.phase_deg[0] == pytest.approx(-180, abs=1)


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
    (found,) = lbt.loop.broken_loops(loop)
    z = np.exp(2j * np.pi * found.frequency_hz / RATE)
    expected = np.polyval(notch[::-1], 1 / z) / z**2 / (1 - 1 / z)
    assert np.allclose(found.response, expected, rtol=1e-6)
    assert np.max(np.abs(np.diff(np.unwrap(np.angle(expected))))) < 0.2
    centre = np.exp(1j * omega)
    least = np.abs(np.polyval(notch[::-1], 1 / centre) / (1 - 1 / centre))
    assert found.gain_db.min() == pytest.approx(20 * np.log10(least), abs=0.1)


def test_a_loop_without_a_crossing_has_no_phase_margin():
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    timid = lbt.Controller(A=0.5, B=0.1, C=1.0, D=0.0, dt_s=1 / RATE)
    loop = lbt.close_loop(hardware, timid)
    (found,) = lbt.loop.broken_loops(loop)
    assert found.phase_margin is None
    assert found.phase_deg[0] == pytest.approx(0, abs=1e-3)
    assert lbt.loop_margins(loop).phase_deg == np.inf


def test_an_unstable_loop_has_no_margins():
    hardware = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    fast = lbt.Controller(A=1.0, B=1.2, C=1.0, D=0.0, dt_s=1 / RATE)
    with pytest.raises(lbt.errors.UnstableLoopError):
        lbt.loop.broken_loops(lbt.close_loop(hardware, fast))


def test_a_response_that_vanishes_has_no_phase_there():
    """Half a frame of delay: ``(1 + z^-1) / 2`` is 0 at half the frame rate."""
    (found,) = broken(0.3, delay=2.5)
    omega = 2 * np.pi * found.frequency_hz / RATE
    assert np.isnan(found.phase_deg[-1])
    assert np.allclose(found.phase_deg[:-1], -90 - np.degrees(2 * omega[:-1]), atol=1e-4)
    (rise,) = found.gain_margins
    assert rise.frequency_hz == pytest.approx(RATE / 8)
