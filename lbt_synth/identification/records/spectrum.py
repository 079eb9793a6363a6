"""A record that consists of power spectra of tip and tilt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models import TabulatedSpectrum
from lbt_synth.validation import (
    Count,
    FloatArray,
    Positive,
    check_fields,
    frozen_copy,
    matrix,
    real_array,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpectrumRecord:
    """One-sided power spectra of one or two axes.

    Parameters
    ----------
    frequency_hz : (f,) array_like
        Increasing frequencies, at least 0 [Hz].
    density_nm2_hz : (f, axes) array_like
        Densities [nm^2/Hz], at least 0, of the disturbance in open loop; integrated over the
        frequencies above 0 they give the variance.
    frame_rate_hz : float, optional
        Frame rate of the series that they were computed from [Hz].
    averages : int, optional
        Periodograms that were averaged.
    diameter_m : float, optional
        Telescope diameter [m].
    source : str, optional
        Where it is from.
    notes : tuple of str, optional
        How the file was read.

    Raises
    ------
    ProblemError
        If frequencies do not increase or lie above half the frame rate, a density is negative,
        or sizes clash.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> flat = lbt.identification.SpectrumRecord(
    ...     frequency_hz=[0, 50, 100], density_nm2_hz=[[4], [4], [4]]
    ... )
    >>> flat.rms_nm.tolist(), flat.axes
    ([20.0], 1)
    """

    frequency_hz: FloatArray
    density_nm2_hz: FloatArray
    frame_rate_hz: Positive | None = None
    averages: Count | None = None
    diameter_m: Positive | None = None
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        density: Any = real_array(self.density_nm2_hz, "density_nm2_hz")
        density = matrix(density[:, None] if density.ndim == 1 else density, "density_nm2_hz")
        frequency = real_array(self.frequency_hz, "frequency_hz")
        if frequency.shape != density.shape[:1] or not 1 <= density.shape[1] <= 2:
            raise DimensionError(
                "density_nm2_hz must have a row per frequency, and one or two axes; got "
                f"{density.shape} and {frequency.shape} frequencies."
            )
        for column in density.T:
            TabulatedSpectrum(frequency_hz=frequency, density_nm2_hz=column)
        check_fields(self, frequency_hz=frequency, density_nm2_hz=density)
        half = np.inf if self.frame_rate_hz is None else self.frame_rate_hz / 2
        if frequency[-1] > half * (1 + 1e-9):
            raise ProblemError(
                f"frequencies must lie below half the frame rate, {half:.6g} Hz; got "
                f"{frequency[-1]:.6g} Hz."
            )

    @property
    def axes(self) -> int:
        """Number of axes, 1 or 2."""
        return int(self.density_nm2_hz.shape[1])

    @property
    def rms_nm(self) -> FloatArray:
        """Root of the integral over the frequencies of the record, (axes,) [nm]."""
        middles = (self.density_nm2_hz[1:] + self.density_nm2_hz[:-1]) / 2
        return frozen_copy(np.sqrt(np.diff(self.frequency_hz) @ middles))

    @property
    def spectra(self) -> tuple[TabulatedSpectrum, ...]:
        """The spectra as disturbances of a :class:`Truth`, one per axis."""
        return tuple(
            TabulatedSpectrum(frequency_hz=self.frequency_hz, density_nm2_hz=column)
            for column in self.density_nm2_hz.T
        )
