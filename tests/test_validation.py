import pickle
from dataclasses import dataclass
from functools import partial

import numpy as np
from support.refusals import refused, require_refusals

from lbt_synth import errors, validation
from lbt_synth.errors import DefinitenessError, DimensionError, NonFiniteError, ProblemError
from lbt_synth.identification import loop_record

NO_NUMBERS = (True, "3", None, np.complex128(20 + 5j), 1j, np.True_, np.array("20"))
SKEW = [[1, 0.5], [0, 1]]
TINY = [[1.0, 1e-10], [1e-10, 1e-20]]
SIZES = r"C must have 6 columns to match A \(6, 6\); got \(1, 4\)"
MASKED = np.ma.array([[0.5, 1.0], [2.0, 3.0]], mask=[[0, 1], [0, 0]])
INFINITE, COLUMNS = (np.nan, np.inf), (6, "to match A (6, 6)")
MISSHAPEN = ([[1, 2], [3]], np.ones((2, 2, 2)), np.ones(3))
matrix, number = validation.matrix, validation.number
definite, semidefinite = validation.definite, validation.semidefinite


def test_refusals():
    rows = [
        *((partial(matrix, [[1.0], [bad]], "A"), NonFiniteError, r"\(1, 0\)") for bad in INFINITE),
        (partial(matrix, np.ones((1, 4)), "C", cols=COLUMNS), DimensionError, SIZES),
        *((partial(matrix, bad, "M"), ProblemError, "M must") for bad in ("text", None, [[1j]])),
        *((partial(matrix, bad, "M"), DimensionError, "M must") for bad in MISSHAPEN),
        (partial(matrix, np.array([[{}]]), "M"), ProblemError, "got ndarray of dtype object"),
        (partial(semidefinite, SKEW, "Q"), DefinitenessError, "symmetric; got an asy"),
        (partial(semidefinite, [[1, 2], [2, 1]], "Q"), DefinitenessError, "semidefinite; got a le"),
        (lambda: definite([[1.0, 1.0], [1.0, 1.0]], "R"), DefinitenessError, "R must be positive"),
        (lambda: definite(TINY, "R"), DefinitenessError, "R must be positive definite"),
        *((partial(number, bad, "x"), ProblemError, "must be a number; got") for bad in NO_NUMBERS),
        (lambda: number(np.nan, "x"), NonFiniteError, "must be finite"),
        (lambda: number(10**400, "x"), NonFiniteError, "finite; got a number beyond 1e308"),
        (lambda: number(0.0, "x", above=0), ProblemError, "x must be above 0; got 0"),
        (lambda: number(-1.0, "x", at_least=0), ProblemError, "x must be at least 0; got -1"),
        (lambda: number(1.0, "x", below=1), ProblemError, "x must be below 1; got 1"),
        (lambda: number(2.0, "x", at_most=1), ProblemError, "x must be at most 1; got 2"),
        (lambda: validation.integer(1.5, "n"), ProblemError, "n must be an integer; got 1.5"),
        (partial(validation.integer, 0, "n", at_least=1), ProblemError, "n must be at least 1"),
        (lambda: validation.choice("c", "w", ("a", "b")), ProblemError, "one of a, b; got 'c'"),
        (lambda: validation.real_array(MASKED, "x"), NonFiniteError, "got nan at index"),
        (lambda: Outer(inner=3.0), ProblemError, "expected an Inner; got float"),
        (lambda: Outer(gain=-1), ProblemError, "gain must be at least 0; got -1"),
        (lambda: Outer(gain="1"), ProblemError, "gain must be a number"),
        (lambda: Outer(frames=0), ProblemError, "frames must be at least 1; got 0"),
        (lambda: Outer(frames=None), ProblemError, "frames must be an integer"),
    ]
    require_refusals(rows)


def test_what_is_taken():
    """Definite in any unit; symmetric but for rounding; a read-only copy; nan where a mask hides."""
    assert np.array_equal(definite(np.diag([1.0, 1e-20]), "R"), np.diag([1.0, 1e-20]))
    out = validation.symmetric([[1.0, 0.5], [0.5 + 1e-15, 1.0]], "Q")
    assert np.array_equal(out, out.T)
    source = np.eye(2)
    out = validation.matrix(source, "M")
    source[0, 0] = 7
    assert out[0, 0] == 1
    refused(lambda: out.fill(2), ValueError, "read-only")
    assert np.isnan(validation.float_array(MASKED, "x")[0, 1])
    record = np.ma.array(np.ones((600, 1)), mask=np.arange(600)[:, None] % 100 == 7)
    seen = loop_record(record, frame_rate_hz=100, unit="nm")
    assert int(np.sum(~seen.usable)) >= 6
    whole = np.ma.array([1.0, 2.0])
    np.testing.assert_array_equal(validation.real_array(whole, "x"), [1.0, 2.0])


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


def test_an_error_is_one_of_ours_keeps_its_data_and_knows_no_other():
    for kind in (DimensionError, NonFiniteError, DefinitenessError, errors.ConfigError):
        assert issubclass(kind, ProblemError)
        assert issubclass(kind, ValueError)
    assert issubclass(errors.InfeasibleError, errors.SynthesisError)
    assert issubclass(errors.SchemaVersionError, errors.GainFileError)
    error = pickle.loads(pickle.dumps(errors.InfeasibleError("no", gamma=2.0, conflict=("a",))))
    assert (str(error), error.gamma, error.gamma_least, error.conflict) == ("no", 2.0, None, ("a",))
    refused(lambda: errors.InfeasibleError("no", size=1), TypeError, "no attribute 'size'")
