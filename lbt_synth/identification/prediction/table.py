"""The table of controllers on recorded data, and its rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.prediction.residual_estimate import ResidualEstimate
from lbt_synth.identification.stretches import Stretches
from lbt_synth.validation import FloatArray, frozen_copy

_AXES = ("tip", "tilt")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictionRow:
    """One controller on the data, and by the model.

    Attributes
    ----------
    name : str
        What it is.
    replayed : ResidualEstimate or None
        Residual on the test data; None for the limit, which is no controller.
    model_nm2 : (n, n) ndarray or None
        Covariance that the model promises [nm^2]; None for what ran, unless its controller is
        known.
    strehl, model_strehl : float
        Strehl ratios of the two; nan where there is none.
    """

    name: str
    replayed: ResidualEstimate | None
    model_nm2: FloatArray | None
    strehl: float
    model_strehl: float

    @property
    def model_nm(self) -> float:
        """Residual over all axes that the model promises [nm rms]; nan if unknown."""
        return float(np.sqrt(np.trace(self.model_nm2))) if self.model_nm2 is not None else np.nan

    @property
    def model_axis_nm(self) -> FloatArray | None:
        """The same of each axis, (n,) [nm rms]."""
        return None if self.model_nm2 is None else frozen_copy(np.sqrt(np.diag(self.model_nm2)))

    @property
    def replayed_nm(self) -> float:
        """Residual over all axes on the data [nm rms]; nan if negative within its error."""
        return np.nan if self.replayed is None else self.replayed.rms_nm

    @property
    def replayed_error_nm(self) -> float:
        """Standard error of that [nm]."""
        return np.nan if self.replayed is None else self.replayed.rms_error_nm

    @property
    def ratio(self) -> float:
        """Residual on the data over what the model promises; nan where either is unknown."""
        return self.replayed_nm / self.model_nm if self.model_nm > 0 else np.nan

    @property
    def deviations(self) -> float:
        """Variance on the data less that of the model, in standard errors; nan if unknown."""
        if self.replayed is None or self.model_nm2 is None:
            return np.nan
        difference = self.replayed.total_nm2 - float(np.trace(self.model_nm2))
        error = self.replayed.total_error_nm2
        return difference / error if error > 0 else np.nan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictionTable:
    """What ran, controllers, a predictor without a model, and the limit, on the same data.

    Attributes
    ----------
    entries : tuple of PredictionRow
        The rows.
    fit, test : tuple of (start, stop)
        Frames that the predictor was fitted to, and those that all rows are measured on.
    settle_frames : int
        Frames dropped before each stretch of the test.
    notes : tuple of str
        What is left out of the table or cannot be, and why.
    """

    entries: tuple[PredictionRow, ...]
    fit: Stretches
    test: Stretches
    settle_frames: int
    notes: tuple[str, ...]

    def __getitem__(self, name: str) -> PredictionRow:
        """Return the row of a name."""
        for entry in self.entries:
            if entry.name == name:
                return entry
        raise ProblemError(
            f"the table has the rows {', '.join(entry.name for entry in self.entries)}; got "
            f"{name!r}."
        )

    @property
    def headings(self) -> tuple[str, ...]:
        """Names of the columns of :meth:`rows`, with their units."""
        return (
            "controller",
            *(f"{axis}_nm" for axis in self._axes),
            "data_nm",
            "data_error_nm",
            "model_nm",
            "data_over_model",
            "strehl",
            "model_strehl",
        )

    @property
    def _axes(self) -> tuple[str, ...]:
        n = next(e.replayed.noise_nm2.shape[0] for e in self.entries if e.replayed is not None)
        return _AXES[:n] if n <= len(_AXES) else tuple(f"axis_{i}" for i in range(n))

    def rows(self) -> tuple[tuple[Any, ...], ...]:
        """Return a tuple per row, in the order of :attr:`headings`; nan where nothing is known.

        The axes' columns are of the data, except in the row of the limit.
        """
        out = []
        for entry in self.entries:
            axes = entry.model_axis_nm if entry.replayed is None else entry.replayed.axis_rms_nm
            assert axes is not None
            out.append(
                (
                    entry.name,
                    *(float(value) for value in axes),
                    entry.replayed_nm,
                    entry.replayed_error_nm,
                    entry.model_nm,
                    entry.ratio,
                    entry.strehl,
                    entry.model_strehl,
                )
            )
        return tuple(out)
