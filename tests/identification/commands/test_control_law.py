"""The control law of a record, on loops whose law is known.

Structure of a matrix between axes.
"""

from functools import partial

import numpy as np
import pytest
from support.control_laws import RATE, SteppedLaw, ordinary_loop, rotation, run_law
from support.plants import lbt_axis_plant
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.identification import LoopRecord
from lbt_synth.identification.commands.control_law import (
    classify_matrix,
    fit_control_law,
    law_controller,
)

RAN = np.diag([0.4, 0.3])
SWAP = np.array([[0.0, 1.0], [1.0, 0.0]])


def law_of(y, u, usable=None):
    """The law of a record whose frames are all good, unless it is said."""
    good = np.ones(len(y), dtype=bool) if usable is None else usable
    marks = {"measured": good, "commanded": good}
    return fit_control_law(LoopRecord(frame_rate_hz=RATE, measurements=y, commands=u, **marks))


@pytest.mark.parametrize(
    ("change", "structure", "signs", "late"),
    [
        (np.eye(2), "diagonal", (1, 1), -1),
        (-np.eye(2), "diagonal", (-1, -1), -4),
        (-SWAP, "swapped", (-1, -1), 2),
        (rotation(30), "general", (0, 0), 0),
        (np.array([[1.0, 0.9], [0.3, 0.6]]), "general", (0, 0), 4),
    ],
)
def test_commands_by_a_matrix_that_are_shifted(change, structure, signs, late):
    y, u = ordinary_loop()
    law = law_of(y[5:-5], np.roll(u @ change.T, late, axis=0)[5:-5])
    assert (law.kind, law.lag_frames, law.order) == ("integrator", late, 1)
    np.testing.assert_allclose(law.gain, change @ RAN, atol=1e-9 * np.abs(change).max())
    assert classify_matrix(law.gain) == (structure, signs)
    np.testing.assert_allclose(law.poles, 1.0, atol=1e-9)
    assert law.exact
    assert np.mean(law.axis_coherence) > 1 - 1e-6


def test_increments_in_place_of_positions():
    y, u = ordinary_loop()
    law = law_of(y[1:], np.diff(u, axis=0))
    assert (law.kind, law.order, law.lag_frames, law.poles.size) == ("proportional", 0, 0, 0)
    np.testing.assert_allclose(law.gain, RAN, atol=1e-9)


def test_commands_of_another_night_have_no_law():
    y, u = ordinary_loop()
    _, other = ordinary_loop(seed=2)
    for measurements, commands in (
        (y, other),
        (y[1000:], u[:-1000]),  # the same night, a second later
        (y, np.zeros_like(u)),
    ):
        law = law_of(measurements, commands)
        assert law.kind == "none"
        assert np.mean(law.axis_coherence) < 0.02
        assert law.axes_kind == "zero"
        assert not law.exact


@pytest.mark.parametrize(
    ("controller", "kind", "poles", "gain"),
    [
        (SteppedLaw(0.4, leak=0.99), "integrator", [0.99], 0.4 * np.eye(2)),
        (SteppedLaw(0.3, again=0.02), "double integrator", [1.0, 1.0], 0.006 * np.eye(2)),
        (SteppedLaw(0.4, limit_nm=300, wind_up=True), "integrator", [1.0], 0.4 * np.eye(2)),
    ],
)
def test_laws_of_low_order(controller, kind, poles, gain):
    law = law_of(*run_law(controller))
    assert (law.kind, law.lag_frames) == (kind, 0)
    np.testing.assert_allclose(law.poles, [poles, poles], atol=1e-5)
    np.testing.assert_allclose(law.gain, gain, atol=1e-6)
    assert law.exact


def test_the_law_of_a_filter_is_that_of_its_design():
    plant = lbt_axis_plant()
    controller = lbt.kalman(plant).controller
    known = {"turbulence": plant.turbulence, "vibrations": plant.vibrations, "noise_nm": 15.5}
    truth = lbt.Truth(**known, sensor_gain=1.0)
    law = law_of(*run_law(controller, truth=truth, hardware=plant.hardware))
    assert (law.kind, law.lag_frames, law.exact) == ("higher order", 0, True)
    rate_hz = plant.hardware.frame_rate_hz
    frequencies_hz = rate_hz * np.array([0.001, 0.01, 0.025, 0.1, 0.3])
    again, exact = (
        one.to_statespace().frequency_response(frequencies_hz)[:, 0, 0]
        for one in (law_controller(law, rate_hz), controller)
    )
    np.testing.assert_allclose(again, exact, rtol=1e-4)


def test_coarse_commands_and_those_in_single_precision():
    y, u = ordinary_loop()
    coarse = law_of(y, 3.0 * np.round(u / 3.0))
    assert (coarse.kind, coarse.lag_frames, coarse.axes_kind) == ("integrator", 0, "diagonal")
    np.testing.assert_allclose(coarse.gain, RAN, atol=0.005)
    # two roundings of variance 9/12, of the increments' variance
    rounding = np.mean(1.5 / np.var(np.diff(u, axis=0), axis=0))
    assert coarse.residual == pytest.approx(rounding, rel=0.1)
    single = law_of(y.astype(np.float32), (u + 1e4).astype(np.float32))
    assert (single.kind, single.exact) == ("integrator", True)


def test_a_loop_that_is_shaken_by_its_commands_is_not_read_backwards():
    law = law_of(*run_law(SteppedLaw(0.4, dither_nm=20.0), frames=6000))
    assert law.lag_frames == 0
    assert law.residual > 0.5
    np.testing.assert_allclose(law.gain, 0.4 * np.eye(2), atol=0.02)


def test_frames_that_follow_no_law():
    y, u = ordinary_loop()
    usable = np.random.default_rng(0).random(len(y)) > 0.01
    marked = usable[:, None]
    holes = law_of(np.where(marked, y, 0.0), np.where(marked, u, 1e5), usable=usable)
    frame = np.arange(len(y))[:, None]
    y = np.where(frame % 500 == 0, 0.0, y)  # spoilt, and not said
    u = np.where(frame < 5000, u, u - 4000.0)  # an offload
    spoilt = law_of(np.delete(y, 7777, axis=0), np.delete(u, 7777, axis=0))
    for law in (holes, spoilt):
        assert law.kind == "integrator"
        np.testing.assert_allclose(law.gain, RAN, atol=1e-9)


def test_one_axis_without_a_law():
    y, u = ordinary_loop()
    law = law_of(y + [0, 100] * np.random.default_rng(0).standard_normal(y.shape), u)
    assert law.lag_frames == 0
    assert law.axis_coherence[0] > 0.999 > 0.1 > law.axis_coherence[1]
    assert law.gain[0, 0] == pytest.approx(0.4)


def test_small_elements_count_as_zero():
    assert classify_matrix([[0.4, 0.03], [-0.03, 0.4]])[0] == "general"
    assert classify_matrix([[0.4, 0.015], [-0.015, 0.4]])[0] == "diagonal"
    assert classify_matrix(np.zeros((2, 2))) == ("zero", (0, 0))


def test_it_repeats_the_commands():
    y, u = run_law(SteppedLaw([[0.3, 0.1], [0.0, 0.2]], leak=0.98))
    late = np.roll(u, 2, axis=0)
    law = law_of(y, late)
    assert law.lag_text == ", 2 frames late"
    run = law_controller(law, RATE).start()
    replayed = np.array([run.step(row) for row in y])
    # what the command was before the record has decayed
    np.testing.assert_allclose(replayed[-500:], late[-500:], atol=1e-6)


def test_records_without_a_law_and_laws_that_cannot_run():
    y, u = ordinary_loop()
    assert law_of(y[:300], u[:300]) is None
    assert law_of(y, None) is None
    require_refusals(
        (partial(law_controller, law_of(*series), RATE), lbt.errors.ProblemError, words)
        for series, words in (
            ((y, 0 * u), "a law that can run; got no law"),
            ((y[:-2], u[2:]), "can run; got .*, 2 frames early"),
        )
    )
