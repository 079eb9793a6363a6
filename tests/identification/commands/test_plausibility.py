"""A second opinion on a record: by the loop of its law, and by the model of the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.control_laws import RATE, SteppedLaw, ordinary_loop, run_law
from support.plants import lbt_axis_plant
from support.recorded_loops import resonant_record

import lbt_synth as lbt
from lbt_synth.identification.commands.control_law import fit_control_law
from lbt_synth.identification.commands.guesses import CoarseRecord, Guess
from lbt_synth.identification.commands.plausibility import (
    finer_saving_of_gain,
    fit_gains,
    law_controller,
)
from lbt_synth.identification.commands.verdict import explain_commands

AS_GIVEN = Guess(kind="as given")


def test_a_plausible_gain_is_no_reason_to_rescale_the_commands() -> None:
    """The fit's gain of 0.9 was compared with 0.35, 0.7 and 1.25, and likelier than these."""
    coarse = CoarseRecord(resonant_record())
    assert finer_saving_of_gain(coarse, AS_GIVEN, (0.35, 1.25), 0.7) == 0


def test_commands_of_another_unit_show_in_the_gain_of_the_fit() -> None:
    record = resonant_record()
    assert record.commands is not None
    coarse = CoarseRecord(replace(record, commands=10 * record.commands))
    assert finer_saving_of_gain(coarse, AS_GIVEN, (0.35, 1.25), 0.7) > 20


@pytest.mark.parametrize("factor", [0.5, 1e3])
def test_the_fit_tells_how_large_commands_are(factor: float) -> None:
    """The coarse gain is twice the true one here: wide resonances move it."""
    record = resonant_record()
    assert record.commands is not None
    record = replace(record, commands=factor * record.commands)
    coarse = CoarseRecord(record)
    gains = coarse.compare([AS_GIVEN]).gain[:, 0]
    assert np.all(gains > 1.5 * 0.9 / factor)
    np.testing.assert_allclose(fit_gains(coarse, AS_GIVEN, gains), 0.9 / factor, rtol=0.15)
    options = explain_commands(record).options
    assert options == ("" if factor < 1 else "--command-scale 0.001")  # 1.9 is left to the fit


def test_gains_that_no_fit_may_have_stay_coarse() -> None:
    gains = np.array([1e-9, 0.1])
    assert fit_gains(CoarseRecord(resonant_record()), AS_GIVEN, gains).tolist() == gains.tolist()


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
    left = lbt.residual_budget(loop, plant, frame_means=True)
    assert left.rms_nm == pytest.approx(design.rms, rel=1e-4)


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
