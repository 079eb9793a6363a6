"""Controllers in the form in which they run, and as estimators that know what was applied.

A real-time computer updates the state first and reads the output from the *new* state:
``u(k) = C x(k+1) + D y(k)``. Such a controller ``x(k+1) = A x(k) + B y(k)``, ``u(k) = C x(k+1)``
reads its last command from its own
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

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, NonFiniteError, NumericalError, ProblemError
from lbt_synth.linear.state_space import LinearSystem, StateSpace
from lbt_synth.validation import FloatArray, float_array, frozen_copy, matrix, suggest_part

_STABLE = 1 - 1e-9  # largest modulus of a pole
_ROUNDED = 4 * float(np.finfo(np.float64).eps)  # of the terms of a difference that is zero


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Controller(LinearSystem):
    """Controller in new-state form: ``x(k+1) = A x(k) + B y(k)``, ``u(k) = C x(k+1) + D y(k)``.

    As in :class:`StateSpace`, each matrix may be a stack of one matrix per phase.

    Parameters
    ----------
    A : (n, n) or (N, n, n) array_like
        State matrix.
    B : (n, q) or (N, n, q) array_like
        Input matrix; y(k) has q measurements.
    C : (m, n) or (N, m, n) array_like
        Output matrix, applied to the state *after* its update.
    D : (m, q) or (N, m, q) array_like
        Feedthrough matrix.
    dt_s : float, optional
        Sampling period [s].
    applied : (n, m) or (N, n, m) array_like, optional
        How the last command enters the new state, where A has it as ``applied C``: what
        :func:`estimator_form` takes out of A again.

    Raises
    ------
    ProblemError
        If a matrix is not finite or the sizes clash.

    Examples
    --------
    An integrator ``u(k) = u(k-1) + 0.5 y(k)``:

    >>> import lbt_synth as lbt
    >>> integrator = lbt.Controller(A=[[1.0]], B=[[0.5]], C=[[1.0]], D=[[0.0]])
    >>> run = integrator.start()
    >>> [float(run.step([1.0])[0]) for _ in range(3)]
    [0.5, 1.0, 1.5]
    """

    applied: FloatArray | None = None

    def __post_init__(self) -> None:
        LinearSystem.__post_init__(self)
        if self.applied is not None:
            rows, cols = (self.n_states, "to match A"), (self.C.shape[-2], "to match C")
            applied = matrix(self.applied, "applied", rows=rows, cols=cols, stacked=True)
            parts = {name: getattr(self, name) for name in "ABCD"}
            self._set_phases(1, **parts, applied=applied)

    def to_statespace(self) -> StateSpace:
        """Return the same input-output map in the textbook (current-state) form."""
        return StateSpace(
            A=self.A, B=self.B, C=self.C @ self.A, D=self.C @ self.B + self.D, dt_s=self.dt_s
        )

    def start(
        self, fallbacks: Mapping[frozenset[str], Controller] | None = None
    ) -> RunningController:
        """Return a running copy with a zero state, to be stepped sample by sample.

        The fall-backs are the controllers for sets of sensors that are not read.
        """
        return RunningController(self, fallbacks=fallbacks or {})


@dataclass(slots=True, eq=False)
class RunningController:
    """A controller with its state: call ``step(y) -> u`` once per sample, or ``reset()``.

    The plain form assumes that its commands are applied; an estimator form is given those that
    were. Fall-backs share the states, so that a switch is without a jump.
    """

    controller: Any  # a Controller, or an estimator form
    fallbacks: Mapping[frozenset[str], Controller] = field(default_factory=dict)
    state: FloatArray = field(init=False)
    phase: int = field(init=False)  # of the next sample
    _phases: list[tuple[FloatArray, ...]] = field(init=False, repr=False)  # A, B, C, D of each

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Set the state to zero; the next sample is the first of a period, all sensors are read."""
        self._phases = list(zip(*self.controller.stacks(), strict=True))
        self.state, self.phase = np.zeros(len(self._phases[0][0])), 0

    def miss(self, missing: Iterable[str]) -> None:
        """Go on with the fall-back for sensors that are not read; with all for none.

        Of those that read none of them, it is the one that reads most.
        """
        names = frozenset(missing)
        enough = sorted((known for known in self.fallbacks if names <= known), key=len)
        if names and not enough:
            raise ProblemError(f"there is no filter without {', '.join(sorted(names))}.")
        controller = self.fallbacks[enough[0]] if names else self.controller
        self._phases = list(zip(*controller.stacks(), strict=True))

    def step(self, y: ArrayLike, applied: ArrayLike | None = None) -> FloatArray:
        """Take the measurements y(k), (q,), and return the command u(k), (m,).

        Cases side by side have (q, c) and (m, c). An estimator form takes the command that was
        applied in the last sample, too; without it the last one of its own counts. A value that is
        not finite raises a NonFiniteError and leaves the state as it is: hold the last command.
        """
        A, B, C, D = self._phases[self.phase]
        measured = _signal(y, "y", B)
        state = self.state[:, None] if measured.ndim > self.state.ndim else self.state
        drive = B @ measured
        if isinstance(self.controller, EstimatorForm):
            last = C @ state if applied is None else _signal(applied, "applied", C.T)
            drive = drive + self.controller.applied @ last
        self.state = A @ state + drive
        self.phase = (self.phase + 1) % len(self._phases)
        return np.asarray(C @ self.state + D @ measured)


def _signal(values: ArrayLike, name: str, matrix: FloatArray) -> FloatArray:
    """Return a signal that a matrix takes, (q,) or (q, c)."""
    signal = float_array(values, name)
    if signal.ndim not in (1, 2) or len(signal) != matrix.shape[1]:
        raise DimensionError(
            f"{name} must have shape ({matrix.shape[1]},) to match a matrix {matrix.shape}; got "
            f"{signal.shape}."
        )
    if not np.isfinite(signal).all():
        raise NonFiniteError(f"{name} must be finite; got {signal}. Hold the last command.")
    return signal


class HasController(Protocol):
    """Anything that holds a controller, such as a design."""

    @property
    def controller(self) -> Controller:
        """The controller."""
        ...


def as_controller(
    given: Controller | HasController, *, others: str = "", any_period: bool = False
) -> Controller:
    """Return a controller, or that of a design; refuse anything else."""
    found = given if isinstance(given, Controller) else getattr(given, "controller", None)
    if isinstance(found, Controller) and found.period > 1 and not any_period:
        raise ProblemError(
            "this needs a controller of the loop's own sensor; got one of several sensors. "
            "simulate, limits, show, verify and export to C take it."
        )
    if not isinstance(found, Controller):
        raise ProblemError(
            f"controller must be a Controller{others}, or a design; got {type(given).__name__}."
            f"{suggest_part(given, Controller)}"
        )
    return found


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

    def to_controller(self) -> Controller:
        """Return the plain form, the same where all commands are applied."""
        D = np.zeros((len(self.C), self.B.shape[1]))
        A = self.A + self.applied @ self.C
        return Controller(A=A, B=self.B, C=self.C, D=D, dt_s=self.dt_s, applied=self.applied)

    def start(self) -> RunningController:
        """Return a running copy with a zero state: ``step(y, applied) -> u`` sample by sample."""
        return RunningController(self)


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
    >>> integrator = lbt.Controller(A=1.0, B=0.5, C=1.0, D=0.0)
    >>> lbt.linear.estimator_form(integrator).spectral_radius
    0.0
    """
    plain = as_controller(controller)
    delayed = _with_command_state(plain) if np.any(plain.D) else plain
    applied, entry = delayed.applied, delayed.B
    if applied is None:
        applied = delayed.A @ entry @ np.linalg.pinv(delayed.C @ entry)
    A = delayed.A - applied @ delayed.C
    terms = np.abs(delayed.A) + np.abs(applied) @ np.abs(delayed.C)
    form = EstimatorForm(
        A=frozen_copy(np.where(np.abs(A) > _ROUNDED * terms, A, 0.0)),
        B=entry,
        applied=frozen_copy(applied),
        C=delayed.C,
        dt_s=delayed.dt_s,
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
