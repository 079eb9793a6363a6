"""Turbulence of many modes, with an auto-regressive process for each, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.ar_model import (
    ARModel,
    companions,
    densities,
    padded_coefficients,
    variance_ratios,
)
from lbt_synth.models.turbulence.ar_models import pole
from lbt_synth.models.turbulence.atmosphere import Atmosphere
from lbt_synth.models.turbulence.zernike import noll_orders, zernike_variances
from lbt_synth.validation import (
    FloatArray,
    Positive,
    check_fields,
    frozen_copy,
    integer,
    matrix,
    number,
    positive,
    real_array,
    require_instance,
    sequence,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalTurbulence:
    """Independent stationary processes ``x(k+1) = a1 x(k) + a2 x(k-1) + ... + v(k)``, one per mode.

    Parameters
    ----------
    coefficients : (n, order) array_like
        a1, a2, ... of each mode.
    driving_rms_nm : (n,) array_like
        Standard deviation of each mode's white noise v [nm].
    frame_rate_hz : float
        Sampling frequency [Hz].

    Raises
    ------
    ProblemError
        If a value is not finite, a process is not stationary or sizes clash.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> air = lbt.models.ModalTurbulence(
    ...     coefficients=[[0.99], [0.98]], driving_rms_nm=[10.0, 5.0], frame_rate_hz=800
    ... )
    >>> air.n_modes, air.rms_nm.round(2).tolist()
    (2, [70.89, 25.13])
    """

    coefficients: FloatArray
    driving_rms_nm: FloatArray
    frame_rate_hz: Positive

    def __post_init__(self) -> None:
        a = matrix(self.coefficients, "coefficients")
        if a.size == 0:
            raise DimensionError(
                f"coefficients must be (modes, order) with at least one of each; got {a.shape}."
            )
        driving = positive(self.driving_rms_nm, "driving_rms_nm")
        if driving.shape != (len(a),):
            raise DimensionError(
                f"driving_rms_nm must have shape ({len(a)},) to match coefficients {a.shape}; got "
                f"{driving.shape}."
            )
        check_fields(self, coefficients=a, driving_rms_nm=driving)
        radii = np.abs(np.linalg.eigvals(self.companions)).max(axis=1)
        if not np.all(radii < 1):
            worst = int(np.argmax(radii))
            raise ProblemError(
                "every process must be stationary, all poles inside the unit circle; got a pole of "
                f"modulus {radii[worst]:.9g} in mode {worst}."
            )

    @classmethod
    def of(cls, models: ARModel | Sequence[ARModel]) -> ModalTurbulence:
        """Return the processes of single models, one per mode, of any orders.

        No model at all, anything but an ARModel, and different frame rates raise a ProblemError.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=800)
        >>> lbt.models.ModalTurbulence.of([slow, slow]).n_modes
        2
        """
        each = (models,) if isinstance(models, ARModel) else sequence(models, "models")
        if not each or not all(isinstance(model, ARModel) for model in each):
            kinds = sorted({type(model).__name__ for model in each}) or "an empty list"
            raise ProblemError(f"models must be one ARModel a mode; got {kinds}.")
        rate = each[0].frame_rate_hz
        if not all(np.isclose(model.frame_rate_hz, rate, rtol=1e-9) for model in each):
            raise ProblemError("all models must be sampled at the same frame rate; they are not.")
        return cls(
            coefficients=padded_coefficients(each),
            driving_rms_nm=frozen_copy([model.driving_rms_nm for model in each]),
            frame_rate_hz=rate,
        )

    @property
    def n_modes(self) -> int:
        """Number of modes n."""
        return int(self.coefficients.shape[0])

    @property
    def order(self) -> int:
        """Number of coefficients of each process."""
        return int(self.coefficients.shape[1])

    @property
    def companions(self) -> FloatArray:
        """State matrices (n, order, order) of the states [x(k), x(k-1), ...]."""
        return companions(self.coefficients)

    @property
    def rms_nm(self) -> FloatArray:
        """Stationary standard deviation of each mode [nm], (n,)."""
        return frozen_copy(self.driving_rms_nm * np.sqrt(variance_ratios(self.coefficients)))

    def model(self, mode: int) -> ARModel:
        """Return the process of one mode, from 0; any other is a ProblemError."""
        i = integer(mode, "mode", at_least=0, at_most=self.n_modes - 1)
        return ARModel(
            coefficients=self.coefficients[i],
            driving_rms_nm=float(self.driving_rms_nm[i]),
            frame_rate_hz=self.frame_rate_hz,
        )

    def psd(self, frequency_hz: ArrayLike) -> FloatArray:
        """One-sided power spectra (n, f) [nm^2/Hz] at frequencies (f,) [Hz] up to Nyquist."""
        frequency = np.atleast_1d(real_array(frequency_hz, "frequency_hz"))
        return densities(self.coefficients, self.driving_rms_nm, self.frame_rate_hz, frequency)


def modal_turbulence(
    atmosphere: Atmosphere, *, modes: int, frame_rate_hz: float
) -> ModalTurbulence:
    """AR1 models of the first Zernike modes after piston, in Noll's order.

    Each has the variance of von Karman turbulence on a disc and the pole of Le Roux et al.,
    ``exp(-2 pi 0.3 (n + 1) V / (D f_s))`` with the radial order n: the cut-off frequency of the
    mode is right, the shape of its spectrum is not (that of frozen flow falls with the power
    -17/3, that of AR1 with -2), and what modes of one azimuthal order have in common is left out.
    B. Le Roux et al., J. Opt. Soc. Am. A 21, 1261 (2004), doi:10.1364/JOSAA.21.001261. Modes of
    a mirror that are sorted like Zernike modes (Karhunen-Loeve modes) have nearly these variances.

    Parameters
    ----------
    atmosphere : Atmosphere
        Turbulence and telescope; an obstruction plays no part.
    modes : int
        Number of modes, tip and tilt first.
    frame_rate_hz : float
        Sampling frequency [Hz].

    Returns
    -------
    ModalTurbulence
        Processes of order 1; mode i has Noll's number i + 2.

    Raises
    ------
    ProblemError
        If a value is out of its range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> air = lbt.Atmosphere(
    ...     seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22
    ... )
    >>> modes = lbt.models.modal_turbulence(air, modes=672, frame_rate_hz=800)
    >>> modes.rms_nm[[0, 2, 671]].round(1).tolist()
    [591.6, 308.8, 3.0]
    >>> modes.coefficients[[0, 2, 671], 0].round(4).tolist()
    [0.9886, 0.9829, 0.8089]
    """
    require_instance(atmosphere, Atmosphere)
    radial, _ = noll_orders(modes)
    rate = number(frame_rate_hz, "frame_rate_hz", above=0)
    poles = pole(atmosphere.wind_speed_m_s, atmosphere.diameter_m, rate, radial)
    variances = zernike_variances(atmosphere, int(radial[-1]))[radial - 1]
    return ModalTurbulence(
        coefficients=poles[:, None],
        driving_rms_nm=np.sqrt(variances * (1 - poles**2)),
        frame_rate_hz=frame_rate_hz,
    )
