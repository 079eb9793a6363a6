"""Margins against hand computation and against loops that are driven unstable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.plants import lbt_axis_plant

import lbt_synth as lbt


def test_marginal_and_unstable_loops_have_no_residual():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    truth = lbt.Truth(turbulence=None, noise_nm=1.0)
    for gain, word in ((1.0, "marginally stable"), (1.5, "unstable")):
        controller = lbt.Controller(A=1.0, B=gain, C=1.0, D=0.0, dt_s=1 / 800)
        loop = lbt.close_loop(path, controller)
        for ask in (
            lambda loop=loop: lbt.residual_budget(loop, truth),
            lambda loop=loop: lbt.loop_margins(loop),
        ):
            with pytest.raises(lbt.errors.UnstableLoopError, match=word) as caught:
                ask()
            assert caught.value.spectral_radius >= 1 - 1e-6
        with pytest.raises(lbt.errors.UnstableLoopError):
            lbt.simulate(controller, truth, hardware=path, frames=10)


# -- margins -------------------------------------------------------------------
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


@pytest.mark.parametrize("design", [lbt.kalman, lambda p: lbt.hinf(p, gamma_ratio=1.2)])
def test_the_ends_of_the_gain_interval_are_where_it_turns_unstable(design):
    plant = lbt_axis_plant(modes=2)
    controller = design(plant).controller
    low, high = lbt.loop.stable_sensor_gains(plant.hardware, controller)

    def stable(gain):
        return lbt.close_loop(plant.hardware, controller, sensor_gain=gain).is_stable

    assert all(stable(g) for g in np.geomspace(low * 1.0001, high * 0.9999, 25))
    assert not stable(low * 0.999)
    assert not stable(high * 1.001)


def test_the_delay_margin_is_that_of_the_simulated_loop():
    plant = lbt_axis_plant()
    controller = lbt.kalman(plant).controller
    margins = lbt.loop_margins(lbt.close_loop(plant.hardware, controller))
    assert margins.delay_s == margins.delay_frames / 800

    def radius(further: float) -> float:
        longer = replace(plant.hardware, delay_frames=2 + further)
        return lbt.close_loop(longer, controller).spectral_radius

    assert radius(margins.delay_frames) < 1 < radius(1.001 * margins.delay_frames)


def test_an_unstable_nominal_has_no_interval():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    wild = lbt.Controller(A=1.0, B=3.0, C=1.0, D=0.0, dt_s=1 / 800)
    assert np.all(np.isnan(lbt.loop.stable_sensor_gains(path, wild)))


@pytest.mark.parametrize("delay", [1.0, 2.0, 2.4])
@pytest.mark.parametrize("gain", [0.1, 0.5, 0.9])
def test_a_loop_is_stable_at_its_delay_margin_and_not_beyond(delay, gain):
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay, modes=1)
    limit = lbt.design.integrator_gain_limit(delay)
    controller = lbt.integrator(path, gain=gain * limit).controller
    margin = lbt.loop_margins(lbt.close_loop(path, controller)).delay_frames

    def stable(further: float) -> bool:
        longer = replace(path, delay_frames=delay + further)
        return lbt.close_loop(longer, controller).is_stable

    assert all(stable(margin * part) for part in (0.3, 0.6, 0.9, 1.0))
    assert not stable(1.01 * margin)


def test_a_loop_that_hardly_does_anything_has_no_delay_margin():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    lazy = lbt.integrator(path, gain=0.001).controller
    assert lbt.loop_margins(lbt.close_loop(path, lazy)).delay_frames == np.inf
