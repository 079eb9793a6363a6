"""Structure of a matrix between axes."""

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.identification.commands.axis_matrix import classify_matrix


def test_diagonals():
    found = classify_matrix(np.diag([-0.3, -0.5]))
    assert (found.kind, found.signs) == ("diagonal", (-1, -1))
    found = classify_matrix([[0.0, -0.3], [0.5, 0.0]])
    assert (found.kind, found.signs) == ("swapped", (-1, 1))
    assert classify_matrix([[-2.0]]).signs == (-1,)


def test_errors_and_tolerance_count_as_zero():
    near = [[0.4, 0.03], [-0.03, 0.4]]
    assert classify_matrix(near).kind == "general"
    assert classify_matrix(near, 0.01).kind == "diagonal"
    assert classify_matrix(near, tolerance=0.1).kind == "diagonal"
    assert classify_matrix(near, 0.2).kind == "zero"
    assert classify_matrix(np.zeros((2, 2))).signs == (0, 0)


@pytest.mark.parametrize("matrix", [[[1.0, 0.9], [0.3, 0.6]], [[1.0, 1.0], [1.0, 1.0]]])
def test_general(matrix):
    assert classify_matrix(matrix).kind == "general"


def test_bad_input():
    with pytest.raises(lbt.errors.DimensionError, match="values must be square"):
        classify_matrix(np.ones((2, 3)))
    with pytest.raises(lbt.errors.ProblemError, match="tolerance must be at least 0"):
        classify_matrix(np.eye(2), tolerance=-1)
