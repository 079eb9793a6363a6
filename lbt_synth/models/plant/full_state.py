"""The plant with its past commands as states, as the paper (Agapito et al. 2008) writes it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, EstimationProblem
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.validation import FloatArray

if TYPE_CHECKING:
    from lbt_synth.models.plant.tip_tilt import TipTiltPlant


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FullStatePlant(EstimationProblem):
    """The plant with its past commands as states (the paper's full form).

    ``x(k+1) = A x(k) + B_known u(k-1) + B w(k)``,
    ``y(k) = C x(k) + D_known u(k-1) + D w(k)``; ``D_known`` is zero from a
    delay of two frames up. ``L`` is the paper's F.

    Parameters
    ----------
    B_known : (n, m) array_like
        Known input to state.
    D_known : (q, m) array_like
        Known input to measurement.
    reduced : TipTiltPlant
        The same plant without its past commands.
    """

    B_known: FloatArray
    D_known: FloatArray
    reduced: TipTiltPlant

    @property
    def hardware(self) -> LoopHardware:
        """The loop."""
        return self.reduced.hardware

    def controller(self, gain_predictor: FloatArray) -> Controller:
        """Return the controller from y(k) to u(k), the known input included, in new-state form.

        ``u(k) = N^+ L x_hat(k+1 | k)``; the past command u(k-1) is therefore
        ``N^+ L x_hat(k | k-1)`` and needs no state of its own. The predictor gain is over the full
        state, (n, q).
        """
        gain = self.checked_gain(gain_predictor)
        to_command = self.hardware.projector @ self.L
        applied = self.B_known - gain @ self.D_known
        A = self.A - gain @ self.C + applied @ to_command
        D = np.zeros((to_command.shape[0], gain.shape[-1]))
        return Controller(A=A, B=gain, C=to_command, D=D, dt_s=self.dt_s, applied=applied)

    def estimator(self, gain_predictor: FloatArray) -> Controller:
        """Estimator of z from ``[y(k), u(k-1)]``, whatever gave that command, in new-state form.

        The predictor gain is over the full state, (n, q).
        """
        gain = self.checked_gain(gain_predictor)
        B = np.concatenate([gain, self.B_known - gain @ self.D_known], axis=-1)
        D = np.zeros((self.L.shape[0], B.shape[-1]))
        return Controller(A=self.A - gain @ self.C, B=B, C=self.L, D=D, dt_s=self.dt_s)

    def ahead(self, frames: int) -> EstimationProblem:
        """Refuse any horizon but one; the reduced plant has the others."""
        if frames != 1:
            raise ProblemError(
                f"a plant with its commands as states has a horizon of 1; got {frames!r}. "
                "Try plant.ahead(frames).full() on the reduced plant."
            )
        return self

    def with_memory(self, taps: FloatArray) -> EstimationProblem:
        """Return the plant with past innovations as states, which no command reaches.

        The taps (l, T q) weight the innovations, the newest first.
        """
        bare = EstimationProblem(A=self.A, B=self.B, C=self.C, D=self.D, L=self.L)
        longer = bare.with_memory(taps)
        more = longer.n_states - self.n_states
        return replace(
            self,
            **{name: getattr(longer, name) for name in "ABCL"},
            reduced=self.reduced.with_memory(taps),
            B_known=np.vstack([self.B_known, np.zeros((more, self.B_known.shape[1]))]),
        )

    def generalised(self) -> tuple[FloatArray, FloatArray]:
        """Matrices of the H-infinity filter's generalised plant (eq. 8, errata 2 and 7).

        The first (n + l + q, n + p + l) maps ``[x(k), w(k), z_hat(k)]`` to
        ``[x(k+1), z_hat(k) - z(k), y(k)]``; the second holds the columns of the known input u(k-1).
        """
        self.require_one_phase("the generalised plant", "that of a phase")
        n, p = self.B.shape
        outputs, q = self.L.shape[0], self.C.shape[0]
        plant = np.block(
            [
                [self.A, self.B, np.zeros((n, outputs))],
                [-self.L, np.zeros((outputs, p)), np.eye(outputs)],
                [self.C, self.D, np.zeros((q, outputs))],
            ]
        )
        known = np.vstack([self.B_known, np.zeros((outputs, self.B_known.shape[1])), self.D_known])
        return plant, known
