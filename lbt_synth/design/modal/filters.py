"""Kalman filters of all modes, designed and certified in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.design.certificate import Certificate
from lbt_synth.design.modal.banks import Bank, RunningBanks
from lbt_synth.design.modal.certificate import ModalChecks
from lbt_synth.design.modal.closed_loops import block_variances, close_bank, spectral_radii
from lbt_synth.design.modal.plants import (
    Lines,
    PlantBatch,
    as_modal_turbulence,
    lines_per_mode,
    number_per_mode,
    plant_batches,
)
from lbt_synth.design.modal.reconstructor import name_modes
from lbt_synth.errors import DetectabilityError, NumericalError, ProblemError
from lbt_synth.linear import Controller, DareSolution, solve_dare
from lbt_synth.linear.batched import transpose
from lbt_synth.models import ARModel, LoopHardware, ModalTurbulence, PositionLoop, Vibration
from lbt_synth.validation import ComplexArray, FloatArray, IntArray, frozen_copy, integer


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalFilters:
    """A Kalman filter and its controller for each of n modes, made by :func:`modal_filters`.

    Modes with fewer states than others have zeros behind their own.

    Attributes
    ----------
    turbulence : ModalTurbulence
        Models of the turbulence.
    vibrations : tuple of tuple of Vibration
        Vibrations of each mode.
    noise_nm, sensor_gain : (n,) ndarray
        Measurement noise and sensor gain of each mode that the design assumes.
    delay_frames : float
        Total delay [frames].
    mirror : PositionLoop or None
        Dynamics of the mirror that the controllers know; None: it settles at once.
    states, controller_states : (n,) ndarray
        Number of states of each filter, and of each controller.
    gain_predictor : (n, s) ndarray
        Predictor gain of each filter.
    A, B, C, D : (n, c, c), (n, c, 1), (n, 1, c), (n, 1, 1) ndarray
        Controllers from y(k) to u(k), the known input included, in new-state form.
    poles : (n, s) complex ndarray
        Poles of each estimation error.
    rms_nm : (n,) ndarray
        Residual that each mode's loop leaves under its own model [nm rms].
    certificate : Certificate
        Checks that all modes passed; ``rms_per_output`` is each mode's estimation error.
    """

    turbulence: ModalTurbulence
    vibrations: Lines
    noise_nm: FloatArray
    sensor_gain: FloatArray
    delay_frames: float
    mirror: PositionLoop | None
    states: IntArray
    controller_states: IntArray
    gain_predictor: FloatArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    poles: ComplexArray
    rms_nm: FloatArray
    certificate: Certificate

    @property
    def n_modes(self) -> int:
        """Number of modes n."""
        return int(self.noise_nm.size)

    @property
    def dt_s(self) -> float:
        """Frame period [s]."""
        return 1 / self.turbulence.frame_rate_hz

    @property
    def hardware(self) -> LoopHardware:
        """Loop that the filters are designed for, of one mode with a unit sensor."""
        return LoopHardware(
            frame_rate_hz=self.turbulence.frame_rate_hz,
            delay_frames=self.delay_frames,
            modes=1,
            mirror=self.mirror,
        )

    def controller(self, mode: int) -> Controller:
        """Return the controller of one mode.

        Parameters
        ----------
        mode : int
            The mode, from 0.

        Returns
        -------
        Controller
            From its y(k) to its u(k).

        Raises
        ------
        ProblemError
            If there is no such mode.
        """
        i = integer(mode, "mode", at_least=0)
        if i >= self.n_modes:
            raise ProblemError(f"mode must be from 0 to {self.n_modes - 1}; got {i}.")
        s = int(self.controller_states[i])
        return Controller(
            A=self.A[i, :s, :s],
            B=self.B[i, :s],
            C=self.C[i, :, :s],
            D=self.D[i],
            dt_s=self.dt_s,
        )

    def banks(self) -> tuple[Bank, ...]:
        """Return the controllers, those of the same size together."""
        out = []
        for s in np.unique(self.controller_states):
            modes = np.flatnonzero(self.controller_states == s)
            A, B, C = self.A[modes, :s, :s], self.B[modes, :s], self.C[modes, :, :s]
            out.append(Bank(modes=modes[:, None], A=A, B=B, C=C, D=self.D[modes]))
        return tuple(out)

    def start(self) -> RunningBanks:
        """Return running controllers with zero states, to be stepped frame by frame."""
        return RunningBanks(self.banks(), self.n_modes)


def modal_filters(
    turbulence: ModalTurbulence | Sequence[ARModel],
    *,
    noise_nm: Any,
    vibrations: Mapping[int, Vibration | Sequence[Vibration]] | None = None,
    delay_frames: float = 2.0,
    sensor_gain: Any = 1.0,
    mirror: PositionLoop | None = None,
) -> ModalFilters:
    """Design a Kalman filter for every mode, all at once.

    Each mode is the plant of :func:`tip_tilt_plant` for a single mode. Modes are independent:
    neither their turbulence nor their noise is correlated.

    A mirror with dynamics is treated as :func:`kalman` does: what it really did is taken out of
    the measurements, so that every loop is stable, but the command is the estimate itself, as if
    the mirror were there at once; ``rms_nm`` holds the lag that this leaves. :func:`lqg`
    designs commands that lead the mirror, one or two modes at a time.

    Parameters
    ----------
    turbulence : ModalTurbulence or sequence of ARModel
        Turbulence of each mode.
    noise_nm : float or (n,) array_like
        Standard deviation of the measurement noise of each mode per frame [nm].
    vibrations : mapping of int to Vibration or list of them, optional
        Vibrations of some modes; their directions play no part.
    delay_frames : float, optional
        Total delay of the loop [frames], at least 1, fractions allowed.
    sensor_gain : float or (n,) array_like, optional
        Sensor (optical) gain that the design assumes.
    mirror : PositionLoop, optional
        Dynamics of the mirror, the same for all modes; one that settles at once by default.

    Returns
    -------
    ModalFilters
        Certified filters and controllers.

    Raises
    ------
    ProblemError
        If a value is not finite, out of range, or sizes clash.
    NumericalError
        If an equation was not solved.
    CertificateError
        If a mode does not pass its checks; the message names the modes.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> air = lbt.models.ModalTurbulence(
    ...     coefficients=[[0.9886], [0.98]], driving_rms_nm=[89.1, 20.0], frame_rate_hz=800
    ... )
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6)
    >>> filters = lbt.design.modal.modal_filters(air, noise_nm=15.5, vibrations={0: [line]})
    >>> filters.rms_nm.round(1).tolist(), filters.certificate.passed
    ([135.9, 30.6], True)
    """
    air = as_modal_turbulence(turbulence)
    n = air.n_modes
    noise = number_per_mode(noise_nm, "noise_nm", n)
    gain = number_per_mode(sensor_gain, "sensor_gain", n)
    hardware = LoopHardware(
        frame_rate_hz=air.frame_rate_hz, delay_frames=delay_frames, modes=1, mirror=mirror
    )
    lines = lines_per_mode(vibrations, n)
    response = hardware.mirror_system.whole
    batches = plant_batches(
        air, lines, noise_nm=noise, delay_frames=hardware.delay_frames, sensor_gain=gain
    )
    s = max(batch.A.shape[-1] for batch in batches)
    c = s + response.n_states
    parts = {
        "gain_predictor": np.zeros((n, s)),
        "A": np.zeros((n, c, c)),
        "B": np.zeros((n, c, 1)),
        "C": np.zeros((n, 1, c)),
        "D": np.zeros((n, 1, 1)),
    }
    poles = np.zeros((n, s), dtype=np.complex128)
    states = np.zeros(n, dtype=np.int64)
    checks = ModalChecks(n)
    for batch in batches:
        modes, size = batch.modes, batch.A.shape[-1]
        solution = _solve_filters(batch)
        gains = np.array(transpose(solution.gain_feedback))
        A, B, C, D = batch.controllers(gains, response)
        used = A.shape[-1]
        states[modes], poles[modes, :size] = size, solution.poles
        parts["gain_predictor"][modes, :size] = gains[..., 0]
        parts["A"][modes, :used, :used], parts["B"][modes, :used] = A, B
        parts["C"][modes, :, :used], parts["D"][modes] = C, D
        bank = Bank(modes=modes[:, None], A=A, B=B, C=C, D=D)
        block = close_bank(bank, gain, response)
        checks.add_filters(batch, gains, solution)
        checks.add_loops(modes, spectral_radii(block.A), *block_variances(block, air, lines, noise))
    whole = hardware.delay_frames >= 2 and hardware.delay_frames == int(hardware.delay_frames)
    certificate = checks.certificate(applied=whole and mirror is None).require(
        "Scale the noise or the turbulence of these modes to sizes that occur."
    )
    controller_states = states + response.n_states
    for array in (poles, states, controller_states):
        array.setflags(write=False)
    return ModalFilters(
        turbulence=air,
        vibrations=lines,
        noise_nm=noise,
        sensor_gain=gain,
        delay_frames=hardware.delay_frames,
        mirror=mirror,
        states=states,
        controller_states=controller_states,
        poles=poles,
        rms_nm=frozen_copy(np.sqrt(checks.residual)),
        certificate=certificate,
        **{name: frozen_copy(part) for name, part in parts.items()},
    )


def _solve_filters(batch: PlantBatch) -> DareSolution:
    """Solve the filter equations of a batch."""
    try:
        return solve_dare(transpose(batch.A), transpose(batch.C), batch.Q, batch.R)
    except (DetectabilityError, NumericalError) as error:
        raise NumericalError(
            f"the filters of {name_modes(batch.modes)} were not all found (their equations are "
            f"counted from 0 in this order): {error}",
            status="riccati",
        ) from error
