"""One controller on every sample of a study: stable, unstable or failed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.validation import BoolArray, FloatArray, float_array

PARTS = ("turbulence", "vibration", "noise")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControllerSamples:
    """One controller on n samples; all arrays (n,)."""

    controller: str  # its name
    strehl: FloatArray  # 0 where unstable, nan where the evaluation failed
    residual_nm: FloatArray  # [nm rms]; inf where unstable, nan where the evaluation failed
    evaluated: BoolArray  # where the evaluation did not fail
    unstable: BoolArray
    parts_nm: dict[str, FloatArray]  # of the residual, by origin [nm rms]

    @property
    def stable(self) -> BoolArray:
        """Where the loop is stable, (n,)."""
        return self.evaluated & ~self.unstable


def read_column(
    columns: Mapping[str, Any], name: str, size: int | None = None, *, finite: bool = False
) -> FloatArray:
    """Return a column of the results, of the given length if there is one."""
    if name not in columns:
        raise ProblemError(
            f"the results must have a column {name!r}; got {', '.join(map(repr, columns))}. "
            "Check the names of parameters and controllers."
        )
    out = float_array(columns[name], f"column {name!r}")
    if out.ndim != 1 or (size is not None and len(out) != size):
        demand = "be 1-D" if size is None else f"have {size} rows, as the others"
        raise DimensionError(f"column {name!r} must {demand}; got shape {out.shape}.")
    if finite:
        _refuse_where(~np.isfinite(out), out, NonFiniteError, f"column {name!r} must be finite")
    return out


def read_controller_samples(
    columns: Mapping[str, Any], controller: str, size: int | None = None
) -> ControllerSamples:
    """Read the columns of a controller, (n,) each."""
    stable_column = read_column(columns, f"{controller}.stable", size)
    size = len(stable_column)
    evaluated, unstable = ~np.isnan(stable_column), stable_column == 0
    stable = stable_column == 1
    demand = f"column '{controller}.stable' must be 1, 0 or nan"
    _refuse_where(evaluated & ~unstable & ~stable, stable_column, ProblemError, demand)
    found = {}
    for name, most, range_ in (
        ("strehl", 1 + 1e-9, "within [0, 1]"),
        ("residual_nm", np.inf, "at least 0"),
    ):
        found[name] = values = read_column(columns, f"{controller}.{name}", size)
        demand = (
            f"column '{controller}.{name}' must be finite and {range_} where the loop is stable"
        )
        _refuse_where(stable & ~np.isfinite(values), values, NonFiniteError, demand)
        outside = ~((values >= 0) & (values <= most))
        _refuse_where(stable & outside, values, ProblemError, demand)
    return ControllerSamples(
        controller=controller,
        strehl=np.where(stable, found["strehl"], np.where(evaluated, 0.0, np.nan)),
        residual_nm=np.where(stable, found["residual_nm"], np.where(evaluated, np.inf, np.nan)),
        evaluated=evaluated,
        unstable=unstable,
        parts_nm={
            part: read_column(columns, name, size)
            for part in PARTS
            if (name := f"{controller}.{part}_nm") in columns
        },
    )


def _refuse_where(
    wrong: BoolArray, values: FloatArray, error: type[ProblemError], demand: str
) -> None:
    """Refuse a column with wrong values, and show the first."""
    if np.any(wrong):
        row = int(np.argmax(wrong))
        raise error(f"{demand}; got {values[row]:g} at index {row}. Check the file of the results.")
