"""A vibration that is a pure sinusoid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.models.vibration.resonance import unit_direction
from lbt_synth.validation import Positive, check_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class SinusoidalVibration:
    """A vibration that is a pure sinusoid.

    Parameters
    ----------
    frequency_hz : float
        Frequency [Hz].
    rms_nm : float
        Standard deviation, amplitude / sqrt(2), along its direction [nm rms wavefront].
    direction : tuple of float, optional
        Direction over the modes, made a unit vector.

    Raises
    ------
    ProblemError
        If a value is not finite or out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> round(lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=797).amplitude_nm, 1)
    1127.1
    """

    frequency_hz: Positive
    rms_nm: Positive
    direction: tuple[float, ...] = (1.0, 0.0)

    def __post_init__(self) -> None:
        check_fields(self, direction=unit_direction(self.direction))

    @property
    def amplitude_nm(self) -> float:
        """Peak displacement [nm rms wavefront]."""
        return float(np.sqrt(2) * self.rms_nm)
