"""Auto-regressive (AR) processes of any order, with their spectrum and variance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.validation import FloatArray, Positive, check_fields, frozen_copy, real_array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ARModel:
    """Stationary process ``x(k+1) = a1 x(k) + a2 x(k-1) + ... + v(k)``.

    Parameters
    ----------
    coefficients : (order,) array_like
        a1, a2, ...
    driving_rms_nm, frame_rate_hz : float
        Standard deviation of the white noise v [nm]; sampling frequency [Hz].

    Raises
    ------
    ProblemError
        If a value is not finite or the process is not stationary.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> ar1 = lbt.models.ARModel(coefficients=[0.6], driving_rms_nm=8.0, frame_rate_hz=1000)
    >>> round(ar1.rms_nm, 6)
    10.0
    """

    coefficients: FloatArray
    driving_rms_nm: Positive
    frame_rate_hz: Positive

    def __post_init__(self) -> None:
        a = np.atleast_1d(real_array(self.coefficients, "coefficients"))
        if a.ndim != 1 or a.size == 0:
            raise DimensionError(
                f"coefficients must be a list of at least one number; got shape {a.shape}."
            )
        check_fields(self, coefficients=frozen_copy(a))
        radius = float(np.max(np.abs(np.linalg.eigvals(self.companion))))
        with np.errstate(all="ignore"):
            ratio = variance_ratios(self.coefficients)
        if not (radius < 1 and 0 < ratio < np.inf):
            raise ProblemError(
                "an AR model must be stationary, all poles inside the unit circle; got a pole of "
                f"modulus {radius:.9g} and no finite variance. "
                "Check the signs: x(k+1) = a1 x(k) + a2 x(k-1) + ... + v(k)."
            )

    @property
    def order(self) -> int:
        """Number of coefficients."""
        return int(self.coefficients.size)

    @property
    def companion(self) -> FloatArray:
        """State matrix (order, order) of the state [x(k), x(k-1), ...]."""
        return companions(self.coefficients)

    @property
    def rms_nm(self) -> float:
        """Stationary standard deviation [nm]."""
        return self.driving_rms_nm * float(np.sqrt(variance_ratios(self.coefficients)))

    def psd(self, frequency_hz: ArrayLike) -> FloatArray:
        """One-sided power spectrum [nm^2/Hz] at frequencies [Hz] up to Nyquist, of their shape.

        It is ``2 s^2 / (f_s |1 - a1 z^-1 - a2 z^-2 - ...|^2)``; a frequency that is not finite
        raises a ProblemError.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> white = lbt.models.ARModel(coefficients=[0.0], driving_rms_nm=3.0, frame_rate_hz=900)
        >>> float(white.psd(100.0) * 450)
        9.0
        """
        frequency = real_array(frequency_hz, "frequency_hz")
        density = densities(self.coefficients, self.driving_rms_nm, self.frame_rate_hz, frequency)
        return density.reshape(frequency.shape)


def padded_coefficients(models: Sequence[ARModel]) -> FloatArray:
    """Coefficients (models, largest order) of several processes."""
    out = np.zeros((len(models), max(model.order for model in models)))
    for row, model in zip(out, models, strict=True):
        row[: model.order] = model.coefficients
    return out


def companions(coefficients: FloatArray) -> FloatArray:
    """State matrices (..., order, order) of AR processes with coefficients (..., order)."""
    order = coefficients.shape[-1]
    A = np.zeros((*coefficients.shape, order))
    A[..., 0, :] = coefficients
    A[..., 1:, :-1] = np.eye(order - 1)
    return A


def densities(
    coefficients: FloatArray, driving_rms: FloatArray | float, rate_hz: float, frequency: FloatArray
) -> FloatArray:
    """One-sided power spectra (..., f) of AR processes (..., order) at f frequencies."""
    delay = np.exp(-2j * np.pi * frequency.ravel() / rate_hz)
    lags = delay ** np.arange(1, coefficients.shape[-1] + 1)[:, None]
    drive = np.asarray(2 * np.square(driving_rms) / rate_hz)
    return np.asarray(drive[..., None] / np.abs(1 - coefficients @ lags) ** 2)


def variance_ratios(coefficients: FloatArray) -> FloatArray:
    """Variance over that of the driving noise, for processes (..., order), (...).

    By stepping down Levinson's recursion: with the reflection coefficients r the ratio is
    ``1 / prod(1 - r^2)``. This loses fewer digits than a Lyapunov equation when the poles
    crowd at the unit circle.
    """
    a = np.array(coefficients, dtype=np.float64)
    ratio = np.ones(a.shape[:-1])
    while a.shape[-1]:
        r, rest = a[..., -1:], a[..., :-1]
        ratio = ratio / ((1 - r) * (1 + r))[..., 0]
        # (rest + r back) / ((1 - r) (1 + r)) without its cancellation near r = -1
        back = rest[..., ::-1]
        a = (rest + back) / (2 * (1 - r)) + (rest - back) / (2 * (1 + r))
    return np.asarray(ratio, dtype=np.float64)
