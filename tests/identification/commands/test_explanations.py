"""What guesses mean: repairs, words, fine angles."""

from __future__ import annotations

import numpy as np
import pytest
from support.control_laws import ordinary_loop
from support.wrong_commands import ROTATION, record

from lbt_synth.identification.commands.control_law import record_control_law
from lbt_synth.identification.commands.explanations import (
    invert_axes,
    refine_guess,
    repair_guess,
    wrong_scale,
)
from lbt_synth.identification.commands.guesses import CoarseRecord, Guess
from lbt_synth.identification.commands.repair import rotation

_MIRROR = np.diag([1.0, -1.0])


@pytest.mark.parametrize("angle", range(-180, 181, 15))
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_repair_is_the_matrix_of_its_guess(angle, mirrored) -> None:
    matrix = rotation(float(angle)) @ (_MIRROR if mirrored else np.eye(2))
    repair, delay, words = repair_guess(Guess(kind="matrix", matrix=matrix), 2.0, 0)
    np.testing.assert_allclose(repair.turn(2), matrix, atol=1e-12)
    assert delay is None
    assert len(words) == 1


def test_any_matrix_has_a_repair() -> None:
    matrix = np.array([[0.9, 0.4], [0.1, 1.1]])
    repair, _, words = repair_guess(Guess(kind="matrix", matrix=matrix), 2.0, 0)
    np.testing.assert_allclose(repair.turn(2), matrix)
    assert "a matrix (0.9, 0.4, 0.1, 1.1)" in words[0]


def test_a_shift_of_a_law_without_lag_is_another_delay() -> None:
    repair, delay, words = repair_guess(Guess(kind="shift", shift_frames=1.0), 2.0, 0)
    assert (repair.options, delay, words) == ("", 3.0, ["the total delay is 3 frames, not 2"])
    repair, delay, words = repair_guess(Guess(kind="shift", shift_frames=-1.0), 2.0, 1)
    assert (repair.shift_frames, delay) == (-1, None)
    assert words == ["they are recorded 1 frame late"]
    repair, delay, words = repair_guess(Guess(kind="shift", shift_frames=-1.0), 2.0, 2)
    assert (repair.shift_frames, delay) == (-2, 3.0)


def test_a_fine_angle_is_that_of_the_law() -> None:
    y, u = ordinary_loop()
    turned = record(y, u @ ROTATION)  # commands turned by -30 degrees
    coarse = CoarseRecord(turned)
    guess = Guess(kind="matrix", matrix=rotation(45.0))
    law = record_control_law(turned)
    for known, within in ((None, 6.0), (law, 0.01)):
        fine = refine_guess(coarse, guess, known).matrix
        angle = np.degrees(np.arctan2(fine[1, 0], fine[0, 0]))
        assert angle == pytest.approx(30.0, abs=within)


def test_fine_limits_stay_near(request) -> None:
    coarse = CoarseRecord(record(*ordinary_loop()))
    guess = Guess(kind="clipped", limit_nm=np.array([100.0, 200.0]))
    fine = refine_guess(coarse, guess, None).limit_nm
    assert np.all(abs(fine / guess.limit_nm - 1) < 0.2)


def test_axes_of_a_law_are_inverted() -> None:
    gain = np.array([[0.3, 0.1], [0.05, 0.4]])
    inverse = invert_axes(gain)
    assert abs(np.linalg.det(inverse)) == pytest.approx(1)
    assert invert_axes(np.ones((2, 2))) is None
    product = inverse @ gain
    np.testing.assert_allclose(product, product[0, 0] * np.eye(2), atol=1e-15)


def test_words_for_a_scale() -> None:
    gain = np.array([0.0007])
    assert wrong_scale(np.array([0.001]), gain).startswith("they are 1000 times too large")
    assert wrong_scale(np.array([2.0]), gain).startswith("they are 2 times too small")
    assert wrong_scale(np.array([1.0, 2.0]), np.array([0.8, 1.6])) == (
        "those of axis 1 are 2 times too small (with them the sensor has a gain of 0.8, 1.6)"
    )
