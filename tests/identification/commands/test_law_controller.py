"""A control law as a controller."""

from __future__ import annotations

import numpy as np
import pytest
from support.control_laws import RATE, SteppedLaw, ordinary_loop, run_law
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.identification.commands.control_law import fit_control_law
from lbt_synth.identification.commands.law_controller import law_controller


def replay(controller, y):
    run = controller.start()
    return np.array([run.step(row) for row in y])


@pytest.mark.parametrize("late", [0, 2])
def test_it_repeats_the_commands(late):
    y, u = run_law(SteppedLaw([[0.3, 0.1], [0.0, 0.2]], leak=0.98), frames=3000)
    law = fit_control_law(y, np.roll(u, late, axis=0))
    again = law_controller(law, RATE)
    assert again.dt_s == pytest.approx(1 / RATE)
    # what the command was before the record has decayed
    expected = np.roll(u, late, axis=0)[-500:]
    np.testing.assert_allclose(replay(again, y)[-500:], expected, atol=1e-6)


def test_the_filter_of_a_design_has_its_residual():
    plant = lbt_axis_plant()
    design = lbt.kalman(plant)
    truth = lbt.Truth(turbulence=plant.turbulence, vibrations=plant.vibrations, noise_nm=15.5)
    law = fit_control_law(*run_law(design.controller, truth=truth, hardware=plant.hardware))
    loop = lbt.close_loop(plant.hardware, law_controller(law, plant.hardware.frame_rate_hz))
    assert lbt.loop.model_budget(loop, plant).rms_nm == pytest.approx(design.rms, rel=1e-4)


def test_increments():
    y, u = ordinary_loop()
    law = fit_control_law(y[1:], np.diff(u, axis=0))
    np.testing.assert_allclose(
        replay(law_controller(law, RATE), [[1.0, 2.0]]), [[0.4, 0.6]], atol=1e-9
    )


def test_laws_that_cannot_run():
    y, u = ordinary_loop()
    with pytest.raises(lbt.errors.ProblemError, match="got one where the commands do not follow"):
        law_controller(fit_control_law(y, 0 * u), RATE)
    with pytest.raises(lbt.errors.ProblemError, match="know measurements of 2 frames later"):
        law_controller(fit_control_law(y[:-2], u[2:]), RATE)
    with pytest.raises(lbt.errors.ProblemError, match="frame_rate_hz must be above 0"):
        law_controller(fit_control_law(y, u), 0)
