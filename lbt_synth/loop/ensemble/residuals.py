"""The residuals of many loops by origin, and their Strehl ratios."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.loop.strehl import Imaging, jitter_spread_nm, jitter_strehls, widest_jitter_nm
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EnsembleResiduals:
    """Stationary residuals of p loops; nan where a loop is unstable.

    Attributes
    ----------
    stable : (p,) bool ndarray
        Whether each loop is stable.
    turbulence_nm2, noise_nm2, random_vibration_nm2 : (p, n, n) ndarray
        Covariances over the modes [nm^2].
    line_amplitudes_nm : (p, s, n) complex ndarray
        Complex amplitude that each sinusoid leaves on each mode [nm].
    """

    stable: BoolArray
    turbulence_nm2: FloatArray
    noise_nm2: FloatArray
    random_vibration_nm2: FloatArray
    line_amplitudes_nm: ComplexArray

    @property
    def turbulence_nm(self) -> FloatArray:
        """Residual turbulence over all modes [nm rms], (p,)."""
        return np.sqrt(_power(self.turbulence_nm2))

    @property
    def noise_nm(self) -> FloatArray:
        """Propagated noise over all modes [nm rms], (p,)."""
        return np.sqrt(_power(self.noise_nm2))

    @property
    def vibration_nm(self) -> FloatArray:
        """Residual vibration over all modes, the sinusoids by their mean power [nm rms], (p,)."""
        return np.sqrt(self._vibration_nm2())

    @property
    def rms_nm(self) -> FloatArray:
        """Residual over all modes [nm rms], (p,)."""
        return np.sqrt(_power(self.turbulence_nm2) + _power(self.noise_nm2) + self._vibration_nm2())

    def strehl(self, imaging: Imaging) -> FloatArray:
        """Strehl ratio of each loop.

        Parameters
        ----------
        imaging : Imaging
            The camera.

        Returns
        -------
        (p,) ndarray
            Strehl ratio in [0, 1]; nan where the loop is unstable, 0 where the image moves by
            more than 160 times its width.

        Raises
        ------
        DimensionError
            If the loops have more than two modes.
        """
        gaussian = self.turbulence_nm2 + self.noise_nm2 + self.random_vibration_nm2
        lines = self.line_amplitudes_nm
        out = np.full(self.stable.shape, np.nan)
        found = np.flatnonzero(self.stable)
        out[found] = 0.0
        spread = jitter_spread_nm(gaussian[found], lines[found])
        near = found[spread <= widest_jitter_nm(imaging)]
        out[near] = jitter_strehls(gaussian[near], imaging=imaging, line_amplitudes_nm=lines[near])
        return out

    def _vibration_nm2(self) -> FloatArray:
        lines = np.sum(np.abs(self.line_amplitudes_nm) ** 2, axis=(1, 2)) / 2
        return np.asarray(_power(self.random_vibration_nm2) + lines)


def _power(covariances: FloatArray) -> FloatArray:
    return np.asarray(np.trace(covariances, axis1=1, axis2=2), dtype=np.float64)
