"""Guesses of how commands reach measurements, on one record."""

from __future__ import annotations

import numpy as np
import pytest
from support.control_laws import ordinary_loop
from support.wrong_commands import record

from lbt_synth.identification.commands.guesses import CoarseRecord, Guess, list_guesses


@pytest.fixture(scope="module")
def coarse() -> CoarseRecord:
    return CoarseRecord(record(*ordinary_loop()))


def test_the_first_guess_is_the_record_as_given() -> None:
    guesses = list_guesses(record(*ordinary_loop()), earliest_frames=1.0)
    assert guesses[0].kind == "as given"
    assert [g.kind for g in guesses].count("as given") == 1
    shifts = [g.shift_frames for g in guesses if g.kind == "shift"]
    assert min(shifts) == -1.0  # a total delay of one frame is the least
    assert max(shifts) == 3.0
    early = list_guesses(record(*ordinary_loop()), earliest_frames=-1.0)
    assert min(g.shift_frames for g in early) == -3.0


def test_one_axis_may_only_be_turned() -> None:
    y, u = ordinary_loop()
    guesses = list_guesses(record(y[:, :1], u[:, :1]), earliest_frames=1.0)
    matrices = [g.matrix for g in guesses if g.matrix is not None]
    assert [m.tolist() for m in matrices] == [[[-1.0]]]


def test_a_matrix_mixes_the_axes(coarse) -> None:
    plain = coarse.transform(Guess(kind="as given"))
    mixed = coarse.transform(Guess(kind="matrix", matrix=np.array([[0.0, 1.0], [2.0, 1.0]])))
    np.testing.assert_allclose(mixed[0], plain[1])
    np.testing.assert_allclose(mixed[1], 2 * plain[0] + plain[1])


def test_the_record_as_given_is_the_likeliest(coarse) -> None:
    guesses = list_guesses(coarse.record, earliest_frames=1.0)
    found = coarse.compare(guesses)
    assert np.all(found.contrast[1:] > found.contrast[0] + 5)
    np.testing.assert_allclose(found.gain[:, 0], 0.7, rtol=0.1)
    assert found.misfit[0] < 2


def test_other_gains_are_less_likely(coarse) -> None:
    given = Guess(kind="as given")
    best = coarse.compare([given])
    more = coarse.profile(given, np.array([[0.35, 0.7, 1.4]] * 2)) - best.axis_contrast
    assert np.all(more > -0.5)
    assert np.all(more[:, [0, 2]] > 25)
    own = coarse.profile(given, best.gain) - best.axis_contrast
    np.testing.assert_allclose(own, 0, atol=0.02)  # what fits end within
    assert coarse.unrelated() > np.sum(best.axis_contrast) + 100
