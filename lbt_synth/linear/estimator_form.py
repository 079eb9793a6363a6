"""A controller as a stable estimator that is given the commands which were applied.

A controller ``x(k+1) = A x(k) + B y(k)``, ``u(k) = C x(k+1)`` reads its last command from its own
state, ``u(k-1) = C x(k)``. The estimator form takes the applied command in its place::

    x(k+1) = (A - L C) x(k) + B y(k) + L u_applied(k-1),        u(k) = C x(k+1)

Where all commands are applied it is the same controller. ``A - L C`` is stable, so it forgets
what clipping or an open loop has put into its state. For an estimator of the disturbance, L is
how the command enters its model. For any other controller L is that of the conditioning
technique, ``A B (C B)^-1``: the state becomes the one with which the applied command would have
been the controller's own answer, and the zeros of the controller are the poles that are left
(R. Hanus, M. Kinnaert, J.-L. Henrotte, Automatica 23, 729 (1987),
doi:10.1016/0005-1098(87)90029-X).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.linear.held_controller import HasController, as_controller
from lbt_synth.linear.state_space import Controller, RunningController
from lbt_synth.validation import FloatArray, frozen_copy

_STABLE = 1 - 1e-9  # largest modulus of a pole
_ROUNDED = 4 * float(np.finfo(np.float64).eps)  # of the terms of a difference that is zero


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EstimatorForm:
    """A controller that is given the last applied command; made by :func:`estimator_form`."""

    A: FloatArray  # (n, n): state matrix, stable
    B: FloatArray  # (n, q): measurements to state
    applied: FloatArray  # (n, m): commands that were applied in the last frame to state
    C: FloatArray  # (m, n): new state to commands
    dt_s: float  # sampling period [s]

    @property
    def spectral_radius(self) -> float:
        """Largest modulus of its poles: how fast it forgets."""
        return float(np.max(np.abs(np.linalg.eigvals(self.A))))

    def stacks(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return A, B, C, D of the samples of its period, which is one."""
        return self.A[None], self.B[None], self.C[None], np.zeros((1, len(self.C), self.B.shape[1]))

    def start(self) -> RunningController:
        """Return a running copy with a zero state: ``step(y, applied) -> u`` sample by sample."""
        return RunningController(self, form="estimator")


def estimator_form(controller: Controller | HasController) -> EstimatorForm:
    """Return the estimator form of a controller: stable, and fed with the applied commands.

    Parameters
    ----------
    controller : Controller or Design
        The controller, or a design with one.

    Returns
    -------
    EstimatorForm
        With the states of the controller; with its commands as further states if it has a
        feedthrough.

    Raises
    ------
    NumericalError
        If the controller is no estimator and has a zero that is not inside the unit circle;
        ``residual`` is its modulus.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1,))
    >>> kalman = lbt.kalman(
    ...     lbt.tip_tilt_plant(
    ...         frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5, modes=1
    ...     )
    ... )
    >>> round(kalman.controller.to_statespace().spectral_radius, 3)
    1.032
    >>> round(lbt.linear.estimator_form(kalman).spectral_radius, 3)
    0.962
    """
    given = as_controller(controller)
    own = _with_command_state(given) if np.any(given.D) else given
    applied = _conditioning_gain(own) if own.applied is None else own.applied
    A = own.A - applied @ own.C
    terms = np.abs(own.A) + np.abs(applied) @ np.abs(own.C)
    form = EstimatorForm(
        A=frozen_copy(np.where(np.abs(A) > _ROUNDED * terms, A, 0.0)),
        B=own.B,
        applied=frozen_copy(applied),
        C=own.C,
        dt_s=own.dt_s,
    )
    if not form.spectral_radius < _STABLE:
        raise NumericalError(
            "an estimator form must be stable; that of this controller would keep a pole of "
            f"modulus {form.spectral_radius:.6g}, a zero of the controller. Use the plain form, "
            "and reset it where its commands were not applied.",
            residual=form.spectral_radius,
        )
    return form


def _with_command_state(controller: Controller) -> Controller:
    """Return the same controller with its last commands as states instead of a feedthrough."""
    A, B, C, D = (getattr(controller, name) for name in "ABCD")
    m, n = C.shape
    return Controller(
        A=np.block([[A, np.zeros((n, m))], [C @ A, np.zeros((m, m))]]),
        B=np.vstack([B, C @ B + D]),
        C=np.eye(m, n + m, k=n),
        D=np.zeros_like(D),
        dt_s=controller.dt_s,
    )


def _conditioning_gain(controller: Controller) -> FloatArray:
    """Return L (n, m) of the conditioning technique."""
    A, B, C = controller.A, controller.B, controller.C
    return np.asarray(A @ B @ np.linalg.pinv(C @ B))
