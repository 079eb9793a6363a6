"""Convert tip and tilt between milliarcseconds on the sky and nanometres of wavefront."""

from __future__ import annotations

from lbt_synth.models.turbulence.atmosphere import ARCSEC_RAD
from lbt_synth.validation import number


def nm_per_mas(diameter_m: float) -> float:
    """Root-mean-square wavefront of one milliarcsecond of tilt over a disc [nm].

    A tilt by theta has the Noll coefficient ``theta D / 4``.

    Parameters
    ----------
    diameter_m : float
        Telescope diameter [m].

    Returns
    -------
    float
        Nanometres of wavefront, rms over the pupil, per milliarcsecond.

    Raises
    ------
    ProblemError
        If the diameter is not a positive, finite number.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> round(lbt.models.nm_per_mas(8.22), 3)
    9.963
    """
    diameter = number(diameter_m, "diameter_m", above=0)
    return diameter / 4 * ARCSEC_RAD * 1e-3 * 1e9
