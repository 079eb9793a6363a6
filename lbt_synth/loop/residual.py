"""What a loop leaves of the disturbances and of the noise, by origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import fact, fact_table, facts
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy

_ORIGINS = {"turbulence": "turbulence", "vibration": "vibrations", "noise": "noise"}
_ORIGINS |= {"within": "within frames"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualBudget(Summarised):
    """Stationary residual of a loop, by origin; of p loops, all have a first axis (p,).

    Attributes
    ----------
    turbulence_nm2, noise_nm2, random_vibration_nm2 : (n, n) ndarray
        Covariances over the modes [nm^2], of means over the hold of a command.
    within_nm2 : (n, n) ndarray
        Covariance of what moves within the hold of a command [nm^2]; zero in means over frames.
    line_amplitudes_nm : (s, n) complex ndarray
        Complex amplitude that each sinusoid leaves on each mode [nm], of such means.
    stable : bool
        Whether the loop is stable; what an unstable one leaves is nan.
    """

    turbulence_nm2: FloatArray
    noise_nm2: FloatArray
    random_vibration_nm2: FloatArray
    within_nm2: FloatArray
    line_amplitudes_nm: ComplexArray
    stable: Any = True

    def _brief(self) -> str:
        modes, loops = self.noise_nm2.shape[-1], self.noise_nm2.shape[:-2]
        if loops:
            return f"{loops[0]} loops, {modes} modes"
        return f"{nm_text(self.rms_nm, '.4g')} rms, {modes} modes"

    def _summarise(self) -> Summary:
        headings = {"rms_nm": "residual"} | {
            f"{name}_nm": f"  {heading}" for name, heading in _ORIGINS.items()
        }
        nm = {"unit": "nm rms", "format": ".1f"}
        named = {name: fact(getattr(self, name), text, **nm) for name, text in headings.items()}
        rows = facts(**named)
        return Summary(tables=[fact_table("Residual", rows)])

    @property
    def gaussian_nm2(self) -> FloatArray:
        """Covariance of all that is Gaussian [nm^2]."""
        steady = self.turbulence_nm2 + self.noise_nm2 + self.random_vibration_nm2
        return frozen_copy(steady + self.within_nm2)

    @property
    def vibration_nm2(self) -> FloatArray:
        """Covariance of all vibrations, the sinusoids by their mean power [nm^2]."""
        a = self.line_amplitudes_nm
        return frozen_copy(self.random_vibration_nm2 + np.real(transpose(a) @ a.conj()) / 2)

    @property
    def total_nm2(self) -> FloatArray:
        """Covariance of the residual [nm^2]."""
        steady = self.turbulence_nm2 + self.noise_nm2 + self.vibration_nm2
        return frozen_copy(steady + self.within_nm2)

    @property
    def rms_nm(self) -> Any:
        """Residual over all modes [nm rms]."""
        return _rms(self.total_nm2)

    @property
    def turbulence_nm(self) -> Any:
        """Residual turbulence over all modes [nm rms]."""
        return _rms(self.turbulence_nm2)

    @property
    def vibration_nm(self) -> Any:
        """Residual vibration over all modes [nm rms]."""
        return _rms(self.vibration_nm2)

    @property
    def noise_nm(self) -> Any:
        """Propagated noise over all modes [nm rms]."""
        return _rms(self.noise_nm2)

    @property
    def within_nm(self) -> Any:
        """What moves within frames over all modes, which no command follows [nm rms]."""
        return _rms(self.within_nm2)


def _rms(covariance: FloatArray) -> Any:
    root = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
    return root if root.ndim else float(root)
