"""Plants whose vibration has an unknown frequency within an interval.

At a fixed decay rate the coefficient a2 of an AR2 process is fixed, and a1 falls as the
frequency rises. The state matrix is affine in a1, so the plants of an interval are a segment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, EstimationProblem, StateSpace
from lbt_synth.models.plant.tip_tilt import TipTiltPlant
from lbt_synth.models.vibration.resonance import Vibration
from lbt_synth.validation import FloatArray, NotNegative, check_fields


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrequencyInterval:
    """The plants of an interval of frequencies, all with the same driving noise."""

    plant: TipTiltPlant  # at the centre; its vibrations share frequency and damping
    half_width_hz: NotNegative  # [Hz]; 0 for the plant alone

    def __post_init__(self) -> None:
        plant = self.plant
        if not isinstance(plant, TipTiltPlant):
            raise ProblemError(
                "an interval of frequencies needs a TipTiltPlant; got "
                f"{type(plant).__name__}. Try tip_tilt_plant(...)."
            )
        plant.parts()  # refuses the memory of a mixed filter
        if not plant.vibrations:
            raise ProblemError(
                "an interval of frequencies needs a vibration; got a plant without any."
            )
        first = plant.vibrations[0]
        for line in plant.vibrations:
            pair = (line.frequency_hz, line.damping)
            if not np.allclose(pair, (first.frequency_hz, first.damping), rtol=1e-9):
                raise ProblemError(
                    "one uncertain frequency at a time: the vibrations must share frequency and "
                    f"damping; got {first.frequency_hz:.6g} Hz with {first.damping:.6g} and "
                    f"{line.frequency_hz:.6g} Hz with {line.damping:.6g}. Keep one of "
                    "them in the model, without spread_hz.",
                    in_python="spread_plant covers several of them for a Kalman filter.",
                )
        check_fields(self)
        for end in (self.low_hz, self.high_hz):
            first.at_frequency(end).ar_model(plant.hardware.frame_rate_hz)

    @property
    def low_hz(self) -> float:
        """Lowest frequency [Hz]."""
        return self._line.frequency_hz - self.half_width_hz

    @property
    def high_hz(self) -> float:
        """Highest frequency [Hz]."""
        return self._line.frequency_hz + self.half_width_hz

    @property
    def retention(self) -> float:
        """``-a2``, the factor of decay over two frames, below 1."""
        return -float(self._line.ar_model(self.plant.hardware.frame_rate_hz).coefficients[1])

    @property
    def coefficients(self) -> tuple[float, float]:
        """Least and greatest a1, those of the highest and the lowest frequency."""
        return self.coefficient(self.high_hz), self.coefficient(self.low_hz)

    def coefficient(self, frequency_hz: float) -> float:
        """Return the coefficient a1 at a frequency."""
        model = self._line.at_frequency(frequency_hz).ar_model(self.plant.hardware.frame_rate_hz)
        return float(model.coefficients[0])

    def frequency_hz(self, coefficient: float) -> float:
        """Frequency [Hz] with a coefficient a1."""
        line, rate = self._line, self.plant.hardware.frame_rate_hz
        cosine = np.clip(coefficient / (2 * np.sqrt(self.retention)), -1, 1)
        turning = float(np.arccos(cosine)) * rate / (2 * np.pi)
        return float(np.hypot(turning, line.damping * line.frequency_hz))

    def state_matrix(self, coefficient: float) -> FloatArray:
        """State matrix of the plant with a coefficient a1."""
        return self._with_block(coefficient, -self.retention)

    def error_system(self, coefficient: float, estimator: Controller) -> StateSpace:
        """System from w to the error of an estimator, in the plant with a coefficient a1."""
        return error_system(self.plant, estimator, A=self.state_matrix(coefficient))

    def envelope(self, estimator: Controller) -> tuple[StateSpace, float, float]:
        """System whose response is the error at the worst a1 of each frequency, and its band.

        At the angle t the vibration's response ``1 / |z^2 - a1 z - a2|`` is the inverse distance
        of a1 from the point ``((1 - a2) cos t, (1 + a2) sin t)``. Where its first coordinate is
        an a1 of the interval this one is the worst, with ``2 / ((1 + a2) |z^2 - 1|)``, the response
        of an oscillator with poles at 1 and -1. Elsewhere an end of the interval is the worst.
        """
        p, retained = len(self.plant.vibrations), self.retention
        B = self.plant.B.copy()
        B[:p] *= 2 / (1 - retained)
        system = error_system(self.plant, estimator, A=self._with_block(0.0, 1.0), B=B)
        angles = np.arccos(np.array(self.coefficients) / (1 + retained))
        high, low = angles / (2 * np.pi * self.plant.dt_s)
        return system, float(low), float(high)

    @property
    def _line(self) -> Vibration:
        return self.plant.vibrations[0]

    def _with_block(self, first: float, second: float) -> FloatArray:
        p = len(self.plant.vibrations)
        A = self.plant.A.copy()
        A[:p, : 2 * p] = np.hstack([first * np.eye(p), second * np.eye(p)])
        return A


def error_system(
    plant: EstimationProblem,
    estimator: Controller,
    *,
    A: FloatArray | None = None,
    B: FloatArray | None = None,
) -> StateSpace:
    """System from w to ``z - zf`` of an estimator ``xf+ = Af xf + Bf y``, ``zf = Cf xf``."""
    A, B = plant.A if A is None else A, plant.B if B is None else B
    return StateSpace(
        A=np.block(
            [[A, np.zeros((len(A), estimator.n_states))], [estimator.B @ plant.C, estimator.A]]
        ),
        B=np.vstack([B, estimator.B @ plant.D]),
        C=np.hstack([plant.L, -estimator.C]),
        D=np.zeros((len(plant.L), B.shape[1])),
        dt_s=plant.dt_s,
    )
