"""Margins against hand computation and against loops that are driven unstable."""

from __future__ import annotations

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
    assert margins.delay_frames == pytest.approx(phase / w, rel=1e-9)
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


def test_the_delay_margin_is_where_a_longer_delay_destabilises():
    plant = lbt_axis_plant()
    controller = lbt.kalman(plant).controller
    margins = lbt.loop_margins(lbt.close_loop(plant.hardware, controller))
    f = np.geomspace(0.05, 399.9, 20_001)
    loop = lbt.close_loop(plant.hardware, controller)
    open_loop = 1 / loop.output_sensitivity().frequency_response(f)[:, 0, 0] - 1

    def distance(delay_s):
        """Least distance from -1 of the loop with a further delay."""
        return np.abs(1 + open_loop * np.exp(-2j * np.pi * f * delay_s)).min()

    assert distance(margins.delay_s) < 1e-3
    before = [distance(t) for t in np.linspace(0, 0.95, 60) * margins.delay_s]
    assert min(before) > 0.02


def test_an_unstable_nominal_has_no_interval():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    wild = lbt.Controller(A=1.0, B=3.0, C=1.0, D=0.0, dt_s=1 / 800)
    assert np.all(np.isnan(lbt.loop.stable_sensor_gains(path, wild)))
