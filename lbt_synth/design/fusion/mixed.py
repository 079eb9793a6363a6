"""The mixed filter of several sensors: the central filter that just meets a bound of the norm."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from lbt_synth.design.fusion.fused_filter import FusedFilter, make_design
from lbt_synth.design.fusion.levels import central_filter, error_norm, find_level
from lbt_synth.models.fusion.plant import FusedPlant

_DECADES = 4.0  # of gamma, over which a central filter is searched
_INSIDE = 1e-7  # by which the norm stays below its bound


def fused_mixed(
    plant: FusedPlant, *, gamma: float | None = None, gamma_ratio: float | None = None
) -> FusedFilter:
    """Design the filter of several sensors that trades variance for a bound of the norm.

    A central H-infinity filter stays below its level. The level is raised until the norm of the
    error is the bound itself: the variance falls with each step. It is the least among central
    filters, not among all.

    Parameters
    ----------
    plant : FusedPlant
        Loop, disturbances and sensors.
    gamma, gamma_ratio : float, optional
        Bound of the norm of the error over a period, or the bound as a multiple of the least one;
        by default 1.2 times the least.

    Returns
    -------
    FusedFilter
        Certified design; the Kalman filter where that meets the bound.

    Raises
    ------
    InfeasibleError
        If the bound is below the least gamma; the message names the least.
    SynthesisError
        As :func:`fused_kalman`.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=80, frame_rate_hz=1000)
    >>> own = lbt.tip_tilt_plant(frame_rate_hz=1000, turbulence=slow, noise_nm=75, modes=1)
    >>> second = lbt.models.WavefrontSensor(name="truth", rate_hz=250, delay_frames=2, noise_nm=4)
    >>> plant = lbt.models.fused_plant(own, lbt.models.SensorSuite(sensors=(second,)))
    >>> both = lbt.design.fused_mixed(plant, gamma_ratio=1.01)
    >>> both.rms < lbt.design.fused_hinf(plant, gamma_ratio=1.01).rms
    True
    """
    level = find_level(plant, gamma, gamma_ratio)
    if level.kalman <= level.bound:
        return make_design(plant, level.start)

    def excess(decades: float) -> float:
        found = central_filter(plant, level.bound * 10**decades, level.start)
        return float(np.log(error_norm(plant, found) / level.bound)) + _INSIDE

    decades = 0.0
    if excess(0.0) < 0 < excess(_DECADES):
        decades = brentq(excess, 0.0, _DECADES, xtol=1e-9)
    central = level.bound * 10**decades
    return make_design(
        plant,
        central_filter(plant, central, level.start),
        **level.claims,
        gamma_central=central,
    )
