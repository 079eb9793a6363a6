"""Check arguments: numbers, arrays and matrices enter the package through here.

Each function returns the value in its canonical form (read-only float64
arrays, Python floats) or raises a :class:`~lbt_synth.errors.ProblemError`
that names the argument.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt

from lbt_synth.errors import DefinitenessError, DimensionError, NonFiniteError, ProblemError

FloatArray: TypeAlias = npt.NDArray[np.float64]
ComplexArray: TypeAlias = npt.NDArray[np.complex128]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
Entry = TypeVar("Entry", bound=np.generic)


def read_only(array: npt.NDArray[Entry]) -> npt.NDArray[Entry]:
    """Make an array read-only and return it."""
    array.setflags(write=False)
    return array


def frozen_copy(array: npt.ArrayLike) -> FloatArray:
    """Return a read-only float64 copy of an array."""
    return read_only(np.array(array, dtype=np.float64))


def float_array(value: Any, name: str) -> FloatArray:
    """Return a float64 array of any shape, finite or not, without a copy if possible."""
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    try:
        raw = np.asarray(value)
    except ValueError as error:
        raise DimensionError(
            f"{name} must be a rectangular array of numbers; got rows of unequal length."
        ) from error
    if raw.dtype.kind == "c":
        raise ProblemError(f"{name} must be real; got complex numbers.")
    if raw.dtype.kind not in "fiub":
        raise ProblemError(f"{name} must be an array of numbers; got {type(value).__name__}.")
    return np.asarray(raw, dtype=np.float64)


def real_array(value: Any, name: str) -> FloatArray:
    """Return a finite, read-only float64 array of any shape."""
    out = frozen_copy(float_array(value, name))
    if not np.all(np.isfinite(out)):
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(out))[0])
        raise NonFiniteError(
            f"{name} must be finite; got {out[where]} at index {where}. "
            "Check the data that it was computed from."
        )
    return out


def matrix(
    value: Any,
    name: str,
    *,
    rows: tuple[int, str] | None = None,
    cols: tuple[int, str] | None = None,
    stacked: bool = False,
) -> FloatArray:
    """Return a finite 2-D matrix; a scalar becomes (1, 1).

    ``rows`` and ``cols`` are pairs ``(size, why)``; ``why`` ends the sentence
    of the error, for example ``"to match A (4, 4)"``. With ``stacked``, leading
    dimensions are allowed: a stack of matrices.
    """
    out = real_array(value, name)
    if out.ndim == 0:
        out = frozen_copy(out.reshape(1, 1))
    if out.ndim < 2 or (out.ndim > 2 and not stacked):
        kind = "a matrix (2-D) or a stack of them" if stacked else "a matrix (2-D)"
        raise DimensionError(f"{name} must be {kind}; got {out.ndim}-D, shape {out.shape}.")
    for axis, required, word in ((-2, rows, "row"), (-1, cols, "column")):
        if required is not None and out.shape[axis] != required[0]:
            size, why = required
            plural = "" if size == 1 else "s"
            raise DimensionError(f"{name} must have {size} {word}{plural} {why}; got {out.shape}.")
    return out


def square(value: Any, name: str, *, stacked: bool = False) -> FloatArray:
    """Return a finite square matrix with at least one row."""
    out = matrix(value, name, stacked=stacked)
    if out.shape[-2] != out.shape[-1] or out.shape[-1] == 0:
        raise DimensionError(f"{name} must be square; got {out.shape}.")
    return out


def symmetric(
    value: Any, name: str, *, size: tuple[int, str] | None = None, stacked: bool = False
) -> FloatArray:
    """Return a finite symmetric matrix; refuse asymmetry beyond rounding."""
    out = matrix(value, name, rows=size, cols=size, stacked=stacked)
    if out.shape[-2] != out.shape[-1]:
        raise DimensionError(f"{name} must be square; got {out.shape}.")
    transposed = np.swapaxes(out, -1, -2)
    scale = np.max(np.abs(out), axis=(-2, -1), initial=0.0)
    skew = np.max(np.abs(out - transposed), axis=(-2, -1), initial=0.0)
    asymmetric = skew > 1e-10 * scale
    if np.any(asymmetric):
        worst = tuple(np.argwhere(asymmetric)[0])
        raise DefinitenessError(
            f"{name} must be symmetric; got an asymmetry of {skew[worst]:.3g} beside entries of "
            f"{scale[worst]:.3g}. Try {name} = ({name} + {name}.T) / 2 if it is rounding."
        )
    return frozen_copy((out + transposed) / 2)


def semidefinite(
    value: Any, name: str, *, size: tuple[int, str] | None = None, stacked: bool = False
) -> FloatArray:
    """Return a symmetric positive semidefinite matrix."""
    out = symmetric(value, name, size=size, stacked=stacked)
    least, scale = _extreme_eigenvalues(out)
    wrong = least < -1e-10 * scale
    if np.any(wrong):
        raise DefinitenessError(
            f"{name} must be positive semidefinite; got a least eigenvalue of "
            f"{np.min(least[wrong]):.6g}."
        )
    return out


def definite(value: Any, name: str, *, size: tuple[int, str] | None = None) -> FloatArray:
    """Return a symmetric positive definite matrix."""
    out = symmetric(value, name, size=size)
    least, scale = _extreme_eigenvalues(out)
    if not np.all(least > 1e-14 * scale):
        raise DefinitenessError(
            f"{name} must be positive definite; got a least eigenvalue of {np.min(least):.6g}."
        )
    return out


def _extreme_eigenvalues(symmetric_matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least eigenvalue, and largest modulus of one, of each matrix of a stack."""
    values = np.atleast_2d(np.linalg.eigvalsh(symmetric_matrix))
    return values[..., 0], np.max(np.abs(values), axis=-1)


def number(
    value: Any,
    name: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
    at_most: float | None = None,
    hint: str = "",
) -> float:
    """Return a finite float within its bounds."""
    if isinstance(value, bool | str | bytes) or value is None:
        raise ProblemError(f"{name} must be a number; got {value!r}.")
    try:
        out = float(value)
    except (TypeError, ValueError) as error:
        raise ProblemError(f"{name} must be a number; got {value!r}.") from error
    if not math.isfinite(out):
        raise NonFiniteError(f"{name} must be finite; got {out}.")
    bounds = (
        (above, "above", above is not None and not out > above),
        (at_least, "at least", at_least is not None and not out >= at_least),
        (below, "below", below is not None and not out < below),
        (at_most, "at most", at_most is not None and not out <= at_most),
    )
    for bound, word, broken in bounds:
        if broken:
            raise ProblemError(
                f"{name} must be {word} {bound:.12g}; got {out:.12g}. {hint}".strip()
            )
    return out


def integer(value: Any, name: str, *, at_least: int) -> int:
    """Return an integer that is at least a bound."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ProblemError(f"{name} must be an integer; got {value!r}.")
    if value < at_least:
        raise ProblemError(f"{name} must be at least {at_least}; got {value}.")
    return int(value)


def choice(value: Any, name: str, options: Sequence[str]) -> str:
    """Return one of a list of words."""
    if value not in options:
        raise ProblemError(f"{name} must be one of {', '.join(options)}; got {value!r}.")
    return cast(str, value)


def sequence(value: Any, name: str) -> tuple[Any, ...]:
    """Return a list or tuple as a tuple; refuse anything else."""
    if not isinstance(value, list | tuple):
        raise ProblemError(f"{name} must be a list; got {type(value).__name__}.")
    return tuple(value)


def set_fields(target: object, **values: Any) -> None:
    """Set fields of a frozen dataclass while it is being initialised."""
    for name, value in values.items():
        object.__setattr__(target, name, value)


def require_instance(value: object, kind: type[Any]) -> None:
    """Refuse anything that is not an instance of a class."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise ProblemError(f"expected {article} {kind.__name__}; got {type(value).__name__}.")
