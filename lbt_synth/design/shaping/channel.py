"""One mode of the loop: responses that are affine in the coefficients of its parameter.

With ``u = Q ybar`` and ``Q = sum c_i Phi_i``, at unit sensor gain::

    T = z^-1 M Q    (complementary sensitivity),    S = 1 - T
    residual = S phi - M Q w,    u = Q (z^-1 phi + w)

M is the mirror's delay. At the sensor gain g all of it is divided by ``1 - (1 - g) T``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lbt_synth.design.shaping.basis import Basis
from lbt_synth.models import LoopHardware
from lbt_synth.validation import ComplexArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Channel:
    """One mode: the delay of the loop, and a basis of parameters."""

    hardware: LoopHardware  # of one mode, with unit sensor and mirror
    basis: Basis  # coordinates of the parameter
    _responses: dict[bytes, ComplexArray] = field(default_factory=dict)

    @property
    def nyquist_hz(self) -> float:
        """Highest frequency [Hz]."""
        return self.hardware.frame_rate_hz / 2

    def command_rows(self, frequency_hz: FloatArray) -> ComplexArray:
        """Slopes of Q, (f, n)."""
        key = frequency_hz.tobytes()
        if key not in self._responses:  # terms and demands share their frequencies
            self._responses[key] = self.basis.response(frequency_hz)
        return self._responses[key]

    def noise_rows(self, frequency_hz: FloatArray) -> ComplexArray:
        """Slopes of M Q, (f, n)."""
        return self.command_rows(frequency_hz) * self.mirror(frequency_hz)[:, None]

    def complementary_rows(self, frequency_hz: FloatArray) -> ComplexArray:
        """Slopes of T, (f, n)."""
        return self.noise_rows(frequency_hz) / self._z(frequency_hz)[:, None]

    def mirror(self, frequency_hz: FloatArray) -> ComplexArray:
        """Response M of the mirror's delay, (f,)."""
        taps = self.hardware.mirror_taps
        powers = self._z(frequency_hz)[:, None] ** -np.arange(len(taps))
        return np.asarray(powers @ taps)

    def _z(self, frequency_hz: FloatArray) -> ComplexArray:
        return np.asarray(np.exp(2j * np.pi * frequency_hz * self.hardware.dt_s))
