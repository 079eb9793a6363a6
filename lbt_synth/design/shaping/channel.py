"""One mode of the loop: responses that are affine in the coefficients of its parameter.

With ``u = Q ybar`` and ``Q = sum c_i Phi_i``, at unit sensor gain::

    T = z^-1 M Q    (complementary sensitivity),    S = 1 - T
    residual = S phi - M Q w,    u = Q (z^-1 phi + w)

M is the delay of the mirror. At the sensor gain g all of it is divided by ``1 - (1 - g) T``.

What is minimised is the residual while a command holds. At a fraction p of the delay, and where the
mirror settles at once, a hold lies in two frames; its mean is interpolated between those of the
frames, as the targets of the filters are. With j whole frames before the arrival and the
denominator above it is, at any gain::

    (p + (1 - p) z^-1) (1 - (1 - g) T) phi - z^-(j + 1) Q (g z^-1 phi + w)

The functions Phi are orthonormal: the Laguerre functions of one repeated real pole, which are the
taps of an impulse response where it is zero, or fewer that span a part of their states.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import solve_discrete_lyapunov, toeplitz

from lbt_synth.linear import Controller, StateSpace
from lbt_synth.loop import ClosedLoop, close_loop
from lbt_synth.loop.closed_loop import youla_controller
from lbt_synth.models import LoopHardware
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Basis:
    """Orthonormal functions ``Phi(z) = z (z I - A)^-1 B``, ``A A' + B B' = I``."""

    A: FloatArray  # (n, n)
    B: FloatArray  # (n, 1)
    dt_s: float

    @property
    def size(self) -> int:
        """Number of functions."""
        return len(self.A)

    @property
    def poles(self) -> ComplexArray:
        """The poles, (n,)."""
        return np.linalg.eigvals(self.A).astype(np.complex128)

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Responses of the functions, (f, n)."""
        newest = StateSpace(A=self.A, B=self.B, C=self.A, D=self.B, dt_s=self.dt_s)
        return newest.frequency_response(frequency_hz)[:, :, 0]

    def parameter(self, coefficients: FloatArray) -> Controller:
        """Return the filter ``sum of c_i Phi_i`` in new-state form."""
        C = coefficients[None, :]
        return Controller(A=self.A, B=self.B, C=C, D=np.zeros((1, 1)), dt_s=self.dt_s)

    def truncated(
        self, coefficients: FloatArray, size: int, frequency_hz: FloatArray, weight: FloatArray
    ) -> tuple[Basis, FloatArray]:
        """Return a few functions, and coefficients, that are close to a parameter where it counts.

        The states are balanced inputs already, so that those kept are the axes of which a weighted
        output shows most: a balanced truncation (D. F. Enns, Proc. 23rd IEEE Conf. Decision and
        Control, 127 (1984), doi:10.1109/CDC.1984.272286). The functions are stable.
        """
        C, D = np.eye(self.size), np.zeros((self.size, 1))
        dual = StateSpace(A=self.A.T, B=coefficients[:, None], C=C, D=D, dt_s=self.dt_s)
        seen = weight[:, None] * dual.frequency_response(frequency_hz)[:, :, 0]
        axes = np.linalg.eigh(np.real(seen.conj().T @ seen))[1][:, -size:]
        A, B = axes.T @ self.A @ axes, axes.T @ self.B
        root = np.linalg.cholesky(solve_discrete_lyapunov(A, B @ B.T))
        inverse = np.linalg.inv(root)
        few = Basis(A=frozen_copy(inverse @ A @ root), B=frozen_copy(inverse @ B), dt_s=self.dt_s)
        return few, coefficients @ axes @ root


def laguerre_basis(size: int, pole: float, *, dt_s: float) -> Basis:
    """Return Laguerre functions: one real pole, repeated; taps where it is zero."""
    k = np.arange(size)
    powers = (-pole) ** np.arange(size)
    A = toeplitz(np.append(pole, (1 - pole**2) * powers[:-1]), np.where(k == 0, pole, 0.0))
    B = np.sqrt(1 - pole**2) * powers[:, None]
    return Basis(A=frozen_copy(A), B=frozen_copy(B), dt_s=dt_s)


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

    def residual_rows(
        self, frequency_hz: FloatArray, sensor_gain: float
    ) -> tuple[ComplexArray, ComplexArray]:
        """Slopes of a hold's residual over the denominator, (f, n), and its value at Q = 0."""
        late = held_fraction(self.hardware)
        if not late:
            return -self.complementary_rows(frequency_hz), np.ones(len(frequency_hz), complex)
        z = self._z(frequency_hz)
        target = late + (1 - late) / z
        steered = (1 - sensor_gain) * target[:, None] * self.complementary_rows(frequency_hz)
        measured = sensor_gain / z[:, None] * self.residual_noise_rows(frequency_hz)
        return -steered - measured, target

    def residual_noise_rows(self, frequency_hz: FloatArray) -> ComplexArray:
        """Slopes of the noise in the residual of a hold over the denominator, (f, n)."""
        if not held_fraction(self.hardware):
            return self.noise_rows(frequency_hz)
        arrival = self._z(frequency_hz) ** -(self.hardware.mirror_system.lead + 1.0)
        return np.asarray(arrival[:, None] * self.command_rows(frequency_hz))

    def steering_rows(self, frequency_hz: FloatArray, sensor_gain: float) -> ComplexArray | None:
        """Slopes of the denominator at a sensor gain, (f, n); None at 1, where it is 1."""
        rest = 1 - sensor_gain
        return rest * self.complementary_rows(frequency_hz) if rest else None

    def mirror(self, frequency_hz: FloatArray) -> ComplexArray:
        """Response M of the mirror's delay, (f,)."""
        taps = self.hardware.mirror_taps
        powers = self._z(frequency_hz)[:, None] ** -np.arange(len(taps))
        return np.asarray(powers @ taps)

    def _z(self, frequency_hz: FloatArray) -> ComplexArray:
        return np.asarray(np.exp(2j * np.pi * frequency_hz * self.hardware.dt_s))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SingleModeLoop:
    """What a loop does to one mode, at any sensor gain: of a controller that couples no modes."""

    hardware: LoopHardware  # of all modes
    controller: Controller
    mode: int = 0
    in_frames: bool = False  # whether its outputs stand for frames, and not for holds
    _loops: dict[float, ClosedLoop] = field(default_factory=dict)

    def at(self, sensor_gain: float) -> ClosedLoop:
        """Return the loop of the mode at a sensor gain, with a unit sensor and influence."""
        if sensor_gain not in self._loops:
            loop = close_loop(self.hardware, self.controller, sensor_gain=sensor_gain)
            self._loops[sensor_gain] = mode_of(loop, self.mode)
        return self._loops[sensor_gain]

    def held(self, sensor_gain: float) -> ClosedLoop:
        """Return the loop at a sensor gain, its residual that of holds as in the module."""
        loop = self.at(sensor_gain)
        late = 0.0 if self.in_frames else held_fraction(self.hardware)
        return replace(loop, system=_held_system(loop, late)) if late else loop

    @property
    def parameter(self) -> StateSpace:
        """The Youla parameter: from the noise to the command at unit sensor gain."""
        return self.at(1.0).path("noise", "command")

    def complementary(self, sensor_gain: float = 1.0) -> StateSpace:
        """Return ``T = 1 - S`` at a sensor gain."""
        s = self.at(sensor_gain).path("phase", "residual")
        return replace(s, C=-s.C, D=1 - s.D)


def mode_of(loop: ClosedLoop, mode: int) -> ClosedLoop:
    """Return what a loop does to one mode: noise enters as the mode's own sensor."""
    hardware, s, n = loop.hardware, loop.system, loop.hardware.modes
    if all(np.array_equal(matrix, [[1.0]]) for matrix in (hardware.sensor, hardware.influence)):
        return loop
    noise, row = hardware.sensor[:, mode], np.zeros((3, len(s.C)))
    row[0, mode] = 1.0
    row[1, n : n + hardware.n_commands] = hardware.influence[mode]
    row[2, n + hardware.n_commands :] = np.linalg.pinv(hardware.sensor)[mode]
    B, D = (np.stack([M[:, mode], M[:, n:] @ noise], axis=1) for M in (s.B, s.D))
    system = replace(s, B=B, C=row @ s.C, D=row @ D)
    return replace(loop, system=system, hardware=hardware.single_mode())


def held_fraction(hardware: LoopHardware) -> float:
    """Part of a frame by which a hold begins within one; 0 for a mirror that moves within it."""
    return hardware.delay_frames % 1 if hardware.mirror is None else 0.0


def _held_system(loop: ClosedLoop, late: float) -> StateSpace:
    """Return the loop of one mode whose residual is that of the hold which ends in the frame."""
    # further states are the phase of the frame before, and the commands since the one that held
    s, n, count = loop.system, loop.system.n_states, loop.hardware.mirror_system.lead + 1
    A, B = np.zeros((n + 1 + count, n + 1 + count)), np.zeros((n + 1 + count, s.B.shape[1]))
    A[:n, :n], B[:n] = s.A, s.B
    B[n, 0] = 1.0
    A[n + 1, :n], B[n + 1] = s.C[1], s.D[1]
    A[n + 2 :, n + 1 : -1] = np.eye(count - 1)
    C, D = np.zeros((len(s.C), len(A))), s.D.copy()
    C[:, :n] = s.C
    C[0], D[0] = 0.0, 0.0
    C[0, n], C[0, -1], D[0, 0] = 1 - late, -1.0, late
    return StateSpace(A=A, B=B, C=C, D=D, dt_s=s.dt_s)


def mode_loop(hardware: LoopHardware, parameter: Controller) -> SingleModeLoop:
    """Close the loop of one mode around its Youla parameter."""
    single = hardware.single_mode()
    return SingleModeLoop(hardware=single, controller=youla_controller(single, parameter))
