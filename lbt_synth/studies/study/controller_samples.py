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


def read_column(columns: Mapping[str, Any], name: str, size: int | None = None) -> FloatArray:
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
    return out


def read_controller_samples(
    columns: Mapping[str, Any], controller: str, size: int | None = None
) -> ControllerSamples:
    """Read the columns of a controller, (n,) each.

    Examples
    --------
    >>> from lbt_synth.studies.study.controller_samples import read_controller_samples
    >>> nan = float("nan")
    >>> columns = {
    ...     "a.stable": [1, 0, nan],
    ...     "a.strehl": [0.8, nan, nan],
    ...     "a.residual_nm": [50, nan, nan],
    ... }
    >>> read_controller_samples(columns, "a").strehl
    array([0.8, 0. , nan])
    """
    stable_column = read_column(columns, f"{controller}.stable", size)
    size = len(stable_column)
    evaluated = ~np.isnan(stable_column)
    unstable = stable_column == 0
    stable = stable_column == 1
    odd = evaluated & ~unstable & ~stable
    if np.any(odd):
        row = int(np.argmax(odd))
        raise ProblemError(
            f"column '{controller}.stable' must be 1, 0 or nan; got {stable_column[row]:g} "
            f"at index {row}."
        )
    strehl = read_column(columns, f"{controller}.strehl", size)
    residual = read_column(columns, f"{controller}.residual_nm", size)
    _require_range(controller, "strehl", strehl, stable, "within [0, 1]", most=1 + 1e-9)
    _require_range(controller, "residual_nm", residual, stable, "at least 0", most=np.inf)
    parts = {
        part: read_column(columns, f"{controller}.{part}_nm", size)
        for part in PARTS
        if f"{controller}.{part}_nm" in columns
    }
    return ControllerSamples(
        controller=controller,
        strehl=np.where(stable, strehl, np.where(evaluated, 0.0, np.nan)),
        residual_nm=np.where(stable, residual, np.where(evaluated, np.inf, np.nan)),
        evaluated=evaluated,
        unstable=unstable,
        parts_nm=parts,
    )


def _require_range(
    controller: str, name: str, values: FloatArray, where: BoolArray, demand: str, *, most: float
) -> None:
    """Refuse values of stable loops that are not finite, or out of range."""
    for wrong, error in (
        (where & ~np.isfinite(values), NonFiniteError),
        (where & ~((values >= 0) & (values <= most)), ProblemError),
    ):
        if np.any(wrong):
            row = int(np.argmax(wrong))
            raise error(
                f"column '{controller}.{name}' must be finite and {demand} where the loop is "
                f"stable; got {values[row]:g} at index {row}. Check the file of the results."
            )
