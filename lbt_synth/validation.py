"""Check arguments: numbers, arrays and matrices enter the package through here.

Each function returns the value in its canonical form (read-only float64
arrays, Python floats) or raises a :class:`~lbt_synth.errors.ProblemError`
that names the argument.
"""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from functools import cache, partial
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, TypeAlias, TypeVar, cast, get_args, get_type_hints

import numpy as np
import numpy.typing as npt

from lbt_synth.errors import DefinitenessError, DimensionError, NonFiniteError, ProblemError

FloatArray: TypeAlias = npt.NDArray[np.float64]
ComplexArray: TypeAlias = npt.NDArray[np.complex128]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
Entry = TypeVar("Entry", bound=np.generic)
T = TypeVar("T")
# Types of fields that `check_fields` checks: the metadata are keywords of `number` or `integer`.
Finite: TypeAlias = Annotated[float, ("at_least", -math.inf)]
Positive: TypeAlias = Annotated[float, ("above", 0)]
NotNegative: TypeAlias = Annotated[float, ("at_least", 0)]
Obstruction: TypeAlias = Annotated[float, ("at_least", 0), ("below", 1)]
Count: TypeAlias = Annotated[int, ("at_least", 1)]
_PARTS = "plant", "hardware", "truth", "design", "controller", "model", "imaging"  # of objects
_RELATIONS = {
    "above": operator.gt,
    "at_least": operator.ge,
    "below": operator.lt,
    "at_most": operator.le,
}


def read_only(array: npt.NDArray[Entry]) -> npt.NDArray[Entry]:
    """Make an array read-only and return it."""
    array.setflags(write=False)
    return array


def frozen_copy(array: npt.ArrayLike) -> FloatArray:
    """Return a read-only float64 copy of an array."""
    return read_only(np.array(array, dtype=np.float64))


def float_array(value: Any, name: str) -> FloatArray:
    """Return a float64 array of any shape, finite or not, without a copy if possible.

    What a masked array hides is nan.
    """
    if np.ma.is_masked(value):
        value = value.astype(np.float64).filled(np.nan)
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
        kind = f" of dtype {raw.dtype}" if raw.ndim else ""
        raise ProblemError(f"{name} must be an array of numbers; got {type(value).__name__}{kind}.")
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


def square(
    value: Any, name: str, *, stacked: bool = False, may_be_empty: bool = False
) -> FloatArray:
    """Return a finite square matrix, with at least one row unless it may be empty."""
    out = matrix(value, name, stacked=stacked)
    if out.shape[-2] != out.shape[-1] or not (may_be_empty or out.shape[-1]):
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
    """Return a symmetric positive definite matrix, whatever the units of its rows."""
    out = symmetric(value, name, size=size)
    units = np.sqrt(np.maximum(np.diag(out), 0.0))
    scaled = out / np.outer(units, units) if np.all(units > 0) else out
    least, scale = _extreme_eigenvalues(scaled)
    if not np.all(units > 0) or not np.all(least > 1e-14 * scale):
        raise DefinitenessError(
            f"{name} must be positive definite; got a least eigenvalue of "
            f"{np.min(_extreme_eigenvalues(out)[0]):.6g}."
        )
    return out


def _extreme_eigenvalues(symmetric_matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least eigenvalue, and largest modulus of one, of each matrix of a stack."""
    values = np.atleast_2d(np.linalg.eigvalsh(symmetric_matrix))
    return values[..., 0], np.max(np.abs(values), axis=-1)


def number(value: Any, name: str, *, hint: str = "", **bounds: float) -> float:
    """Return a finite float ``above``, ``at_least``, ``below`` or ``at_most`` its bounds."""
    kind = getattr(getattr(value, "dtype", None), "kind", "f")
    if isinstance(value, bool | str | bytes) or value is None or kind not in "fiu":
        raise ProblemError(f"{name} must be a number; got {value!r}.")
    try:
        out = float(value)
    except OverflowError as error:
        raise NonFiniteError(f"{name} must be finite; got a number beyond 1e308.") from error
    except (TypeError, ValueError) as error:
        raise ProblemError(f"{name} must be a number; got {value!r}.") from error
    if not math.isfinite(out):
        raise NonFiniteError(f"{name} must be finite; got {out}.")
    _require_bounds(out, name, bounds, hint)
    return out


def _require_bounds(value: float, name: str, bounds: dict[str, float], hint: str = "") -> None:
    for relation, bound in bounds.items():
        if not _RELATIONS[relation](value, bound):
            wanted = f"{relation.replace('_', ' ')} {bound:.12g}"
            raise ProblemError(f"{name} must be {wanted}; got {value:.12g}. {hint}".strip())


def positive(values: Any, name: str) -> FloatArray:
    """Return a finite array whose entries are all above 0."""
    out = real_array(values, name)
    if np.any(out <= 0):
        raise ProblemError(f"{name} must be above 0; got {out.min():.6g}.")
    return out


def one_or_each(value: Any, name: str, size: int | None = None, **bounds: Any) -> FloatArray:
    """Return one number (), or a list of one per measurement (size,), all within bounds."""
    out = real_array(value, name) if np.ndim(value) else np.asarray(number(value, name, **bounds))
    if out.ndim > 1 or out.size == 0 or (out.ndim == 1 and size not in (None, out.size)):
        wanted = "" if size is None else f" ({size})"
        got = out.size if out.ndim == 1 and out.size else f"shape {out.shape}"
        raise DimensionError(
            f"{name} must be one number, or one per measurement{wanted}; got {got}."
        )
    for entry in out.ravel():
        number(entry, name, **bounds)
    return out


def each_of(value: Any, name: str, size: int, **bounds: Any) -> FloatArray:
    """Return numbers (size,): one for all, alone or in a list, or one each, within bounds."""
    out = np.atleast_1d(real_array(value, name))
    out = one_or_each(out[0] if out.size == 1 else out, name, size, **bounds)
    return np.broadcast_to(out, (size,))


def integer(value: Any, name: str, **bounds: float) -> int:
    """Return an integer that is ``at_least`` or ``at_most`` its bounds."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ProblemError(f"{name} must be an integer; got {value!r}.")
    _require_bounds(int(value), name, bounds)
    return int(value)


def check_fields(target: Any, **values: Any) -> None:
    """Set values of a frozen dataclass, and check the fields whose types say what they hold.

    That is a bounded number, such as ``Positive``, or another dataclass; None passes where the
    type allows it.
    """
    set_fields(target, **values)
    for name, check, optional in _declared_checks(target.__class__):
        value = getattr(target, name)
        if not (optional and value is None):
            object.__setattr__(target, name, check(value, name))


@cache
def _declared_checks(kind: Any) -> list[tuple[str, Callable[[Any, str], Any], bool]]:
    """Name and check of each field that declares one, and whether it may be None."""
    found: list[tuple[str, Callable[[Any, str], Any], bool]] = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        optional = NoneType in get_args(hint)
        options = [one for one in get_args(hint) if one is not NoneType] if optional else [hint]
        one = options[0]
        if hasattr(one, "__metadata__"):
            bounded = integer if one.__origin__ is int else number
            found.append((name, partial(bounded, **dict(one.__metadata__)), optional))
        elif len(options) == 1 and is_dataclass(one):
            found.append((name, partial(_instance, kind=one), optional))
    return found


def _instance(value: object, _: str, kind: Any) -> object:
    require_instance(value, kind)
    return value


def choice(value: Any, name: str, options: Sequence[str], **advice: str) -> str:
    """Return one of a list of words; advice goes with the error for any other."""
    if value not in options:
        text = f"{name} must be one of {', '.join(options)}; got {value!r}."
        raise ProblemError(text, **advice)
    return cast(str, value)


def agree(one: FloatArray, other: FloatArray, tolerance: float = 1e-9) -> bool:
    """Return whether arrays agree to a relative tolerance, or to a part of the largest entry."""
    largest = float(np.max(np.abs(other), initial=0.0))
    return bool(np.allclose(one, other, rtol=tolerance, atol=1e-3 * tolerance * largest))


def text(value: Any, name: str) -> str:
    """Return a text; refuse anything else."""
    if not isinstance(value, str):
        raise ProblemError(f"{name} must be a text; got {value!r}.")
    return value


def file_path(value: Any, name: str) -> Path:
    """Return the path of a file; refuse what is none."""
    if not isinstance(value, str | os.PathLike):
        raise ProblemError(f"{name} must be the path of a file; got {type(value).__name__}.")
    return Path(value)


def sequence(value: Any, name: str) -> tuple[Any, ...]:
    """Return a list or tuple as a tuple; refuse anything else."""
    if not isinstance(value, list | tuple):
        raise ProblemError(f"{name} must be a list; got {type(value).__name__}.")
    return tuple(value)


def set_fields(target: object, **values: Any) -> None:
    """Set fields of a frozen dataclass while it is being initialised."""
    for name, value in values.items():
        object.__setattr__(target, name, value)


def require_instance(value: object, kind: type[T], name: str = "") -> T:
    """Return an instance of a class, refuse anything else; the message names the argument."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        start = f"{name} must be" if name else "expected"
        raise ProblemError(
            f"{start} {article} {kind.__name__}; got {type(value).__name__}."
            f"{suggest_part(value, kind)}"
        )
    return value


def suggest_part(value: object, kind: type[Any]) -> str:
    """Return the sentence that names the part of an object that is of a class, or nothing."""
    makers = {kind.__name__, *(each.__name__ for each in kind.__subclasses__())}
    for name in _PARTS:
        part = getattr(value, name, None)
        if isinstance(part, kind):
            own = type(value).__name__.lower()
            designer = f", or {own}.design(...)" if callable(getattr(value, "design", None)) else ""
            return f" Try {own}.{name}{designer}."
        if getattr(part, "__annotations__", {}).get("return") in makers:
            return f" Try {type(value).__name__.lower()}.{name}()."
    return ""
