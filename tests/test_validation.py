from __future__ import annotations

import pickle
from dataclasses import dataclass

import numpy as np
import pytest

from lbt_synth import errors, validation
from lbt_synth.identification import loop_record


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_matrix_names_the_place_of_a_value_that_is_not_finite(bad):
    with pytest.raises(errors.NonFiniteError, match=r"A must be finite; got .* at index \(1, 0\)"):
        validation.matrix([[1.0, 2.0], [bad, 4.0]], "A")


def test_matrix_says_both_sizes():
    with pytest.raises(
        errors.DimensionError, match=r"C must have 6 columns to match A \(6, 6\); got \(1, 4\)"
    ):
        validation.matrix(np.ones((1, 4)), "C", cols=(6, "to match A (6, 6)"))


@pytest.mark.parametrize(
    ("value", "error"),
    [
        ("text", errors.ProblemError),
        ([[1, 2], [3]], errors.DimensionError),
        ([[1 + 1j]], errors.ProblemError),
        (np.ones((2, 2, 2)), errors.DimensionError),
        (np.ones(3), errors.DimensionError),
        (None, errors.ProblemError),
    ],
)
def test_matrix_refuses(value, error):
    with pytest.raises(error, match="M must"):
        validation.matrix(value, "M")


def test_arrays_are_read_only_copies():
    source = np.eye(2)
    out = validation.matrix(source, "M")
    source[0, 0] = 7
    assert out[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        out[0, 0] = 2


def test_asymmetric_and_indefinite_covariances_are_refused():
    with pytest.raises(errors.DefinitenessError, match=r"Q must be symmetric; got an asymmetry"):
        validation.semidefinite([[1.0, 0.5], [0.0, 1.0]], "Q")
    with pytest.raises(errors.DefinitenessError, match="positive semidefinite; got a least"):
        validation.semidefinite([[1.0, 2.0], [2.0, 1.0]], "Q")
    with pytest.raises(errors.DefinitenessError, match="R must be positive definite"):
        validation.definite([[1.0, 1.0], [1.0, 1.0]], "R")


def test_definiteness_does_not_depend_on_units():
    assert np.array_equal(validation.definite(np.diag([1.0, 1e-20]), "R"), np.diag([1.0, 1e-20]))
    with pytest.raises(errors.DefinitenessError, match="R must be positive definite"):
        validation.definite([[1.0, 1e-10], [1e-10, 1e-20]], "R")


@pytest.mark.parametrize(
    "value", [np.complex128(20 + 5j), 1j, np.True_, np.array("20"), np.array([1.0 + 0j])]
)
def test_what_only_looks_like_a_number_is_refused(value):
    with pytest.raises(errors.ProblemError, match="x must be a number; got"):
        validation.number(value, "x")


def test_an_integer_beyond_all_floats_is_refused():
    with pytest.raises(errors.NonFiniteError, match="x must be finite; got a number beyond 1e308"):
        validation.number(10**400, "x")


def test_rounding_asymmetry_is_symmetrised():
    out = validation.symmetric([[1.0, 0.5], [0.5 + 1e-15, 1.0]], "Q")
    assert np.array_equal(out, out.T)


@pytest.mark.parametrize(
    ("value", "bounds", "text"),
    [
        (True, {}, "must be a number; got True"),
        ("3", {}, "must be a number; got '3'"),
        (None, {}, "must be a number; got None"),
        (np.nan, {}, "must be finite"),
        (0.0, {"above": 0}, "must be above 0; got 0"),
        (-1.0, {"at_least": 0}, "must be at least 0; got -1"),
        (1.0, {"below": 1}, "must be below 1; got 1"),
        (2.0, {"at_most": 1}, "must be at most 1; got 2"),
    ],
)
def test_number_refuses(value, bounds, text):
    with pytest.raises(errors.ProblemError, match=text):
        validation.number(value, "x", **bounds)


def test_integer_and_choice_refuse():
    with pytest.raises(errors.ProblemError, match="n must be an integer; got 1.5"):
        validation.integer(1.5, "n", at_least=1)
    with pytest.raises(errors.ProblemError, match="n must be at least 1; got 0"):
        validation.integer(0, "n", at_least=1)
    with pytest.raises(errors.ProblemError, match="word must be one of a, b; got 'c'"):
        validation.choice("c", "word", ("a", "b"))


def test_every_error_is_one_of_ours():
    for name in ("DimensionError", "NonFiniteError", "DefinitenessError", "ConfigError"):
        kind = getattr(errors, name)
        assert issubclass(kind, errors.ProblemError)
        assert issubclass(kind, ValueError)
    assert issubclass(errors.InfeasibleError, errors.SynthesisError)
    assert issubclass(errors.SchemaVersionError, errors.GainFileError)


@dataclass(frozen=True, kw_only=True)
class Inner:
    size: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Outer:
    inner: Inner | None = None
    gain: validation.NotNegative | None = None
    frames: validation.Count = 1
    names: tuple[str, ...] = ()

    def __post_init__(self):
        validation.check_fields(self, names=tuple(self.names))


def test_fields_are_checked_by_their_types():
    made = Outer(inner=Inner(), gain=1, frames=np.int64(3), names=["a"])
    assert (type(made.inner), type(made.gain), type(made.frames)) == (Inner, float, int)
    assert (made.names, Outer().inner, Outer().gain) == (("a",), None, None)


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"inner": 3.0}, "expected an Inner; got float"),
        ({"gain": -1}, "gain must be at least 0; got -1"),
        ({"gain": "1"}, "gain must be a number"),
        ({"frames": 0}, "frames must be at least 1; got 0"),
        ({"frames": None}, "frames must be an integer"),
    ],
)
def test_fields_of_other_types_are_refused(fields, text):
    with pytest.raises(errors.ProblemError, match=text):
        Outer(**fields)


def test_an_error_keeps_its_data_and_knows_no_other():
    error = pickle.loads(pickle.dumps(errors.InfeasibleError("no", gamma=2.0, conflict=("a",))))
    assert (str(error), error.gamma, error.gamma_least, error.conflict) == ("no", 2.0, None, ("a",))
    with pytest.raises(TypeError, match="no attribute 'size'"):
        errors.InfeasibleError("no", size=1)


def test_what_a_mask_hides_is_no_number():
    hidden = np.ma.array([[0.5, 1.0], [2.0, 3.0]], mask=[[0, 1], [0, 0]])
    assert np.isnan(validation.float_array(hidden, "x")[0, 1])
    with pytest.raises(errors.NonFiniteError, match="got nan at index"):
        validation.real_array(hidden, "x")
    record = np.ma.array(np.ones((600, 1)), mask=np.arange(600)[:, None] % 100 == 7)
    seen = loop_record(record, frame_rate_hz=100, unit="nm")
    assert int(np.sum(~seen.usable)) >= 6
    whole = np.ma.array([1.0, 2.0])
    np.testing.assert_array_equal(validation.real_array(whole, "x"), [1.0, 2.0])
