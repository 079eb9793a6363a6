"""All stabilising controllers: the one of least variance and a filter of its innovations.

With ``u = u_least + R^(-1/2) q`` and ``q = Q S^(-1/2) innovation``, R and S the weights of control
and innovation, every stable Q gives a stabilising controller, and every such controller is
one of these. From w to z the loop is ``T11 + T12 Q T21``, affine in Q, with T12 inner and T21
co-inner, and its variance is the least one plus ``|Q|^2`` (D. C. Youla, H. A. Jabr,
J. J. Bongiorno, IEEE Trans. Autom. Control 21, 319 (1976), doi:10.1109/TAC.1976.1101223).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.output_feedback.central_controller import with_seen_controls
from lbt_synth.linear.output_feedback.least_level import TwoRiccati
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.validation import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FreeParameter:
    """The loop of a plant in discrete time as an affine function of Q."""

    plant: GeneralizedPlant
    feedback: FloatArray  # (m2, n), F
    injection: FloatArray  # (n, p2), of the innovation into the state
    through: FloatArray  # (m2, p2), of the innovation into the control, negative
    control_unit: FloatArray  # (m2, m2), R^(-1/2)
    innovation_unit: FloatArray  # (p2, p2), S^(-1/2)
    T11: StateSpace
    T12: StateSpace
    T21: StateSpace

    def controller(self, taps: FloatArray) -> StateSpace:
        """Return the controller of a Q with finite response, its taps (T, m2, p2)."""
        P, n = self.plant, len(self.plant.A)
        p2 = P.sizes[3]
        stored = (len(taps) - 1) * p2
        # the innovation, and the control, as functions of [x; past innovations; y]
        innovation = np.hstack([-P.C2, np.zeros((p2, stored)), np.eye(p2)])
        unit = self.innovation_unit @ innovation
        control = (self.control_unit @ taps[0]) @ unit - self.through @ innovation
        control[:, :n] -= self.feedback
        if stored:
            control[:, n : n + stored] += self.control_unit @ np.hstack(list(taps[1:]))
        rows = np.zeros((n + stored, n + stored + p2))
        rows[:n, :n] = P.A
        rows[:n] += P.B2 @ control + self.injection @ innovation
        if stored:
            rows[n : n + p2] = unit
            rows[n + p2 :, n : n + stored - p2] = np.eye(stored - p2)
        size = n + stored
        K = StateSpace(
            A=rows[:, :size],
            B=rows[:, size:],
            C=control[:, :size],
            D=control[:, size:],
            dt_s=P.dt_s,
        )
        return with_seen_controls(K, P.D22)


def free_parameter(equations: TwoRiccati) -> FreeParameter:
    """Return the affine form of the loop of a plant, by its least-variance solutions."""
    P, control, estimation = equations.plant, equations.control, equations.estimation
    F, state = control.feedback, estimation.feedback.T
    seen = F @ estimation.least @ P.C2.T + control.feedforward @ P.D21.T
    through = np.linalg.solve(estimation.weight, seen.T).T
    control_unit = np.linalg.inv(np.linalg.cholesky(control.weight).T)
    innovation_unit = np.linalg.inv(np.linalg.cholesky(estimation.weight))
    dt_s = P.dt_s
    B2, D12 = P.B2 @ control_unit, P.D12 @ control_unit
    C2, D21 = innovation_unit @ P.C2, innovation_unit @ P.D21
    return FreeParameter(
        plant=P,
        feedback=F,
        injection=state,
        through=np.asarray(through),
        control_unit=np.asarray(control_unit),
        innovation_unit=np.asarray(innovation_unit),
        T11=P.closed_loop(equations.least_variance()),
        T12=StateSpace(A=P.A - P.B2 @ F, B=B2, C=P.C1 - P.D12 @ F, D=D12, dt_s=dt_s),
        T21=StateSpace(A=P.A - state @ P.C2, B=P.B1 - state @ P.D21, C=C2, D=D21, dt_s=dt_s),
    )
