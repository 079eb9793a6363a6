"""The loop closed around one controller, as a linear system."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError, UnstableLoopError
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.linear.controller import HasController, as_controller
from lbt_synth.models import LoopHardware
from lbt_synth.models.mirror.frame_rate_system import Response
from lbt_synth.models.plant.assembly import sensor_memory
from lbt_synth.models.sensor_suite import OWN_SENSOR
from lbt_synth.storage.rows import fact, fact_table, facts
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import ComplexArray, FloatArray, number, require_instance

# what sensors remember of a signal, A and B, and their measurements ``(C0 + g C1)`` times that
Readings: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

# A loop whose slowest pole is closer to the unit circle than this is called marginal.
STABILITY_MARGIN = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClosedLoop(Summarised):
    """Closed loop from ``[phi_tot (n), noise (q)]`` to ``[phi_res (n), u (m), y (q)]``.

    Made by :func:`close_loop`. The measurements are those that the controller reads: of the loop's
    own sensor, or of all.
    """

    system: StateSpace
    hardware: LoopHardware  # sensor, mirror and delay
    controller: Controller
    sensor_gain: float  # real gain of the loop's own sensor relative to its matrix
    blind: tuple[str, ...] = ()  # sensors and channels whose readings are zero, or frozen

    def _brief(self) -> str:
        return f"{self.hardware._brief()}, sensor gain {self.sensor_gain:.4g}"

    def _summarise(self) -> Summary:
        own = facts(
            sensor_gain=fact(self.sensor_gain, "sensor gain over the assumed one"),
            is_stable=fact(self.is_stable, "stable"),
            spectral_radius=fact(self.spectral_radius, "largest modulus of a pole"),
        )
        return Summary(tables=[fact_table("Loop", self.hardware.facts(), own)])

    @property
    def reads_others(self) -> bool:
        """Whether the controller reads other sensors beside the loop's own."""
        return reads_others(self.hardware, self.controller)

    def feedback(self) -> ClosedLoop:
        """Return the loop of its own sensor alone where it reads accelerometers beside that.

        No command moves what accelerometers read: margins are those of the loop without them. A
        loop of other wavefront sensors, or of a longer period, is returned as it is.
        """
        hardware, k = self.hardware, self.controller
        if not self.reads_others or hardware.suite.wavefront or k.period > 1:
            return self
        q = hardware.n_measurements
        own = replace(k, B=k.B[:, :q], D=k.D[:, :q])
        return close_loop(hardware.own_sensor_alone(), own, sensor_gain=self.sensor_gain)

    @property
    def spectral_radius(self) -> float:
        """Largest modulus of the closed loop's poles: of a period."""
        return self.system.spectral_radius

    @property
    def radius_per_frame(self) -> float:
        """What the slowest mode keeps from one frame to the next."""
        return self.system.radius_per_frame

    @property
    def is_stable(self) -> bool:
        """Whether every pole lies inside the unit circle, by more than 1e-9 per frame."""
        return self.radius_per_frame < 1 - STABILITY_MARGIN

    def require_stable(self) -> None:
        """Raise UnstableLoopError if the loop is unstable or marginally stable."""
        if not self.is_stable:
            radius = self.radius_per_frame
            word = "a marginally stable" if radius < 1 + STABILITY_MARGIN else "an unstable"
            raise UnstableLoopError(
                f"the closed loop must be stable; got {word} one (spectral radius "
                f"{radius:.12g} at sensor gain {self.sensor_gain:.6g}). Design for this sensor "
                "gain and delay; lbt-synth show prints the gains that are stable.",
                spectral_radius=radius,
            )

    def path(self, source: str, end: str) -> StateSpace:
        """Return the system from "phase", "noise" or "all" to "residual", "command" or "reading".

        From the noise to the readings it is ``(I + loop)^-1``.
        """
        s, n, m = self.system, self.hardware.modes, self.hardware.n_commands
        inputs = {"phase": slice(n), "noise": slice(n, None), "all": slice(None)}[source]
        ends = {"residual": slice(n), "command": slice(n, n + m), "reading": slice(n + m, None)}
        B, C = s.B[..., inputs], s.C[..., ends[end], :]
        return replace(s, B=B, C=C, D=s.D[..., ends[end], inputs])

    def sensitivity(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Transfer from the total phase to the residual (the rejection), (f, n, n)."""
        return self.path("phase", "residual").frequency_response(frequency_hz)


def close_loop(
    hardware: LoopHardware,
    controller: Controller | HasController,
    *,
    sensor_gain: float = 1.0,
    blind: tuple[str, ...] = (),
) -> ClosedLoop:
    """Close the loop of :class:`LoopHardware` around a controller.

    A controller of the measurements of all sensors closes the loop of all, with their common
    period; one of the loop's own sensor leaves the others unread.

    Parameters
    ----------
    hardware : LoopHardware
        Sensor, mirror and delay.
    controller : Controller or Design
        From y(k) to u(k), or a design that holds it.
    sensor_gain : float, optional
        Real gain of the loop's own sensor relative to its matrix.
    blind : tuple of str, optional
        Sensors and channels whose readings do not follow the phase: they are zero, or frozen.

    Returns
    -------
    ClosedLoop
        The loop, stable or not.

    Raises
    ------
    ProblemError
        If the controller has other sizes or another sampling period than the loop.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> lazy = lbt.Controller(A=1.0, B=0.5, C=1.0, D=0.0, dt_s=1 / 800)
    >>> lbt.close_loop(path, lazy).is_stable
    True
    """
    require_instance(hardware, LoopHardware, "hardware")
    gain = number(sensor_gain, "sensor_gain", above=0)
    plain = as_controller(controller, any_period=bool(hardware.suite.sensors))
    A0, A1, B, C0, C1, D = checked_loop_matrices(hardware, plain, tuple(blind))
    system = StateSpace(A=A0 + gain * A1, B=B, C=C0 + gain * C1, D=D, dt_s=hardware.dt_s)
    return ClosedLoop(
        system=system, hardware=hardware, controller=plain, sensor_gain=gain, blind=tuple(blind)
    )


def reads_others(hardware: LoopHardware, controller: Controller) -> bool:
    """Return whether a controller reads other sensors beside the loop's own."""
    return bool(hardware.suite.sensors) and controller.D.shape[-1] != hardware.n_measurements


def checked_loop_matrices(
    hardware: LoopHardware, controller: Controller, blind: tuple[str, ...] = ()
) -> tuple[FloatArray, ...]:
    """Return the matrices of :func:`loop_matrices`, for a controller that matches the loop."""
    require_matching_controller(hardware, controller)
    k, mirror = controller.to_statespace(), hardware.mirror_system.whole
    readings = last_frame(hardware.sensor)
    if reads_others(hardware, controller):
        readings = _readings_of_all(hardware, blind)
    return loop_matrices(
        k.A, k.B, k.C, k.D, mirror=mirror, readings=readings, influence=hardware.influence
    )


def last_frame(sensor: FloatArray) -> Readings:
    """Return the readings of a sensor (q, n) of the residual of the last frame."""
    n = sensor.shape[1]
    return np.zeros((n, n)), np.eye(n), np.zeros_like(sensor), sensor


def _readings_of_all(hardware: LoopHardware, blind: tuple[str, ...]) -> Readings:
    """Return the readings of all sensors of a loop, of which some follow nothing."""
    suite, rows = hardware.suite, hardware.suite.rows(hardware)
    A, B, C = sensor_memory(hardware, own=True)
    others, own = np.zeros((2, hardware.period, hardware.n_readings, A.shape[1]))
    others[:, : C.shape[1]] = C
    others[:, suite.marked(blind, hardware)] = 0.0
    own[:, rows[OWN_SENSOR]] = others[:, rows[OWN_SENSOR]]
    return A, B, others - own, own


def require_matching_controller(hardware: LoopHardware, controller: Controller) -> None:
    """Raise if a controller does not have a loop's sizes, period and sampling period."""
    m, q, period = hardware.n_commands, hardware.n_measurements, 1
    if reads_others(hardware, controller):
        q, period = hardware.n_readings, hardware.period
    if controller.D.shape[-2:] != (m, q) or controller.period != period:
        raise DimensionError(
            f"the controller must map {q} measurements to {m} commands in a period of {period}; "
            f"got {controller.D.shape[-1]} to {controller.D.shape[-2]} in {controller.period}."
        )
    if not np.isclose(controller.dt_s, hardware.dt_s, rtol=1e-9):
        raise ProblemError(
            f"the controller must run at the loop's {hardware.frame_rate_hz:.6g} Hz; got one "
            f"designed for {1 / controller.dt_s:.6g} Hz. Design it for this frame rate."
        )


def loop_matrices(
    A: FloatArray,
    B: FloatArray,
    C: FloatArray,
    D: FloatArray,
    *,
    mirror: Response,
    readings: Readings,
    influence: FloatArray,
) -> tuple[FloatArray, ...]:
    """Close the loop around a controller in the textbook form, each of a stack, or each phase.

    ``influence`` is (n, m). Return ``A0, A1, B, C0, C1, D``, affine in the sensor gain g as in
    ``A0 + g A1``. The state is that of the controller, of the mirror (its past commands, if it
    settles), and what sensors remember of the residual: phi_res(k-1).
    """
    held_A, held_B, *measuring = readings
    stack, order = np.broadcast_shapes(A.shape[:-2], held_A.shape[:-2]), A.shape[-1]
    (n, m), q = influence.shape, D.shape[-1]
    states = order + mirror.n_states * m + held_A.shape[-1]
    x = slice(order)  # state of the controller
    v = slice(order, states - held_A.shape[-1])  # state of the mirror, one response per command
    r = slice(states - held_A.shape[-1], states)  # what sensors remember
    mirror_A, mirror_B, mirror_C = mirror.repeated(m)
    direct_influence = mirror.D * influence  # from u(k) to phi_cor(k) without a delay

    # with s the whole state: y = (measured0 + g measured1) s + noise
    measured0, measured1 = np.zeros((2, *measuring[0].shape[:-1], states))
    measured0[..., r], measured1[..., r] = measuring
    # u = (command0 + g command1) s + D noise
    command0 = np.zeros((*stack, m, states))
    command0[..., x] = C
    command0 += D @ measured0
    command1 = D @ measured1
    # phi_res = (residual0 + g residual1) s + phi_tot - direct_influence D noise
    residual0 = -direct_influence @ command0
    residual0[..., v] -= influence @ mirror_C
    residual1 = -direct_influence @ command1
    entry = np.zeros((*stack, n, n + q))
    entry[..., :n], entry[..., n:] = np.eye(n), -direct_influence @ D

    A0, A1 = np.zeros((2, *stack, states, states))
    inputs = np.zeros((*stack, states, n + q))
    A0[..., x, :], A1[..., x, :], inputs[..., x, n:] = B @ measured0, B @ measured1, B
    A0[..., v, :], A1[..., v, :] = mirror_B @ command0, mirror_B @ command1
    inputs[..., v, n:] = mirror_B @ D
    A0[..., r, :], A1[..., r, :] = held_B @ residual0, held_B @ residual1
    inputs[..., r, :] = held_B @ entry
    A0[..., x, x] += A
    A0[..., v, v] += mirror_A
    A0[..., r, r] += held_A
    outputs0, outputs1 = np.zeros((2, *stack, n + m + q, states))
    outputs0[..., :n, :], outputs0[..., n : n + m, :] = residual0, command0
    outputs1[..., :n, :], outputs1[..., n : n + m, :] = residual1, command1
    outputs0[..., n + m :, :], outputs1[..., n + m :, :] = measured0, measured1
    direct = np.zeros((*stack, n + m + q, n + q))
    direct[..., :n, :] = entry
    direct[..., n : n + m, n:] = D
    direct[..., n + m :, n:] = np.eye(q)
    return A0, A1, inputs, outputs0, outputs1, direct


def youla_controller(
    hardware: LoopHardware, parameter: Controller, *, sign: float = 1.0, stored: bool = False
) -> Controller:
    """Return the controller from y to u of a filter from the pseudo-open-loop ybar to u.

    The measurement that there would be without any correction is known, ``ybar(k) = y(k) +
    sensor_matrix influence_matrix (c[0] u(k-1) + c[1] u(k-2) + ...)`` with the mirror's taps c.
    Every controller that stabilises the loop is a stable filter from it to u, in which the closed
    loop is affine (D. C. Youla, H. A. Jabr, J. J. Bongiorno, IEEE Trans. Autom. Control 21, 319
    (1976), doi:10.1109/TAC.1976.1101223). Readings of other sensors, which no command moves, may
    follow ybar. Stored, the last command is a state of its own, whichever output it was. With the
    sign -1 it is the filter of a controller.
    """
    m, q, readings = hardware.n_commands, hardware.n_measurements, parameter.B.shape[1]
    if len(parameter.C) != m or readings < q:
        raise DimensionError(
            f"the filter must map {q} measurements to {m} commands; got "
            f"{readings} to {len(parameter.C)}."
        )
    A, B, C, D = parameter.A, parameter.B, parameter.C, parameter.D
    mirror, n = hardware.mirror_system.whole, len(A)
    A_mirror, B_mirror, C_mirror = mirror.repeated(m)
    # Without feedthrough the last command is read from the state: u(k-1) = C x(k)
    held = m if stored or np.any(D) else 0
    size = n + held + mirror.n_states * m
    last = np.zeros((m, size))  # reads u(k-1) from the state [x, u(k-1) if held, mirror]
    if held:
        last[:, n : n + m] = np.eye(m)
    else:
        last[:, :n] = C
    position = mirror.D * last
    position[:, n + held :] += C_mirror
    seen = np.zeros((readings, m))
    seen[:q] = sign * hardware.sensor @ hardware.influence
    correction = seen @ position  # ybar = y + correction s
    next_mirror = B_mirror @ last
    next_mirror[:, n + held :] += A_mirror
    next_filter = np.hstack([A, np.zeros((n, size - n))]) + B @ correction
    rows, entry = [next_filter], np.zeros((size, readings))
    entry[:n] = B
    if held:
        rows.append(C @ next_filter + D @ correction)
        entry[n : n + m] = C @ B + D
    applied = entry @ (mirror.D * seen)
    applied[n + held :] += B_mirror
    # the rows that read u(k-1) from the old state read u(k) from the new one
    whole, D = np.vstack([*rows, next_mirror]), np.zeros((m, readings))
    return Controller(A=whole, B=entry, C=last, D=D, dt_s=hardware.dt_s, applied=applied)
