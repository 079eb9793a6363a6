"""Kalman filters of all modes, designed and certified in one call.

The certificate goes by other means than the Riccati equation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.certificate import (
    GAIN_TOLERANCE,
    RESIDUAL_TOLERANCE,
    VARIANCE_TOLERANCE,
    Certificate,
    Check,
)
from lbt_synth.design.modal.banks import Bank, LoopBlock, LoopVariances, RunningBanks, close_bank
from lbt_synth.design.modal.plants import (
    Lines,
    ModalModels,
    PlantBatch,
    Vibrations,
    number_per_mode,
)
from lbt_synth.design.modal.reconstructor import name_modes
from lbt_synth.errors import DetectabilityError, NumericalError
from lbt_synth.linear import Controller, solve_dare
from lbt_synth.linear.lyapunov import stationary_covariances
from lbt_synth.linear.matrix_functions import frobenius_norms, transpose
from lbt_synth.linear.riccati.dare import DareSolution
from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.models import ARModel, LoopHardware, ModalTurbulence, PositionLoop
from lbt_synth.validation import ComplexArray, FloatArray, IntArray, frozen_copy, integer, read_only

_STABLE = 1 - STABILITY_MARGIN
_SQUARING = "relative, by squaring"
_RECOMPUTED = "gain recomputed from the Lyapunov covariance"
_TWICE, _SIZES = "relative, two Lyapunov equations", "relative, sizes of the terms of its variance"
_CHECKS = (  # what is checked, its limit, how it is computed
    ("spectral radius of the filter", _STABLE, "eigenvalues"),
    ("spectral radius of the closed loop", _STABLE, "eigenvalues"),
    ("residual of the Riccati equation", RESIDUAL_TOLERANCE, "relative, in extended precision"),
    ("residual of the Lyapunov equation", RESIDUAL_TOLERANCE, _SQUARING),
    ("variance, against the Riccati equation", VARIANCE_TOLERANCE, "relative, Lyapunov equation"),
    ("distance from the least-variance gain", GAIN_TOLERANCE, _RECOMPUTED),
    ("residual of the loop's Lyapunov equation", RESIDUAL_TOLERANCE, _SQUARING),
)
# of a loop that applies the estimate, whose residual is the estimation error, and of any other
_APPLIED = "residual of the closed loop, against the estimation error", VARIANCE_TOLERANCE, _TWICE
_NOT_APPLIED = "rounding in the residual of the closed loop", VARIANCE_TOLERANCE, _SIZES


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
        rate, delay = self.turbulence.frame_rate_hz, self.delay_frames
        return LoopHardware(frame_rate_hz=rate, delay_frames=delay, modes=1, mirror=self.mirror)

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
        i = integer(mode, "mode", at_least=0, at_most=self.n_modes - 1)
        s = int(self.controller_states[i])
        A, B, C = self.A[i, :s, :s], self.B[i, :s], self.C[i, :, :s]
        return Controller(A=A, B=B, C=C, D=self.D[i], dt_s=self.dt_s)

    def banks(self) -> tuple[Bank, ...]:
        """Return the controllers, those of the same size together."""
        out = []
        for s in np.unique(self.controller_states):
            modes = np.flatnonzero(self.controller_states == s)
            A, B, C = self.A[modes, :s, :s], self.B[modes, :s], self.C[modes, :, :s]
            out.append(Bank(modes[:, None], A, B, C, self.D[modes]))
        return tuple(out)

    def start(self) -> RunningBanks:
        """Return running controllers with zero states, to be stepped frame by frame."""
        return RunningBanks(self.banks(), self.n_modes)


def modal_filters(
    turbulence: ModalTurbulence | Sequence[ARModel],
    *,
    noise_nm: ArrayLike,
    vibrations: Vibrations | None = None,
    delay_frames: float = 2.0,
    sensor_gain: ArrayLike = 1.0,
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
    models = ModalModels.of(turbulence, noise_nm, vibrations)
    n, rate = models.turbulence.n_modes, models.turbulence.frame_rate_hz
    gain = number_per_mode(sensor_gain, "sensor_gain", n)
    hardware = LoopHardware(frame_rate_hz=rate, delay_frames=delay_frames, modes=1, mirror=mirror)
    delay, response = hardware.delay_frames, hardware.mirror_system.whole
    applied = mirror is None and delay >= 2 and delay == int(delay)
    batches = models.plants(delay, gain)
    states = np.zeros(n, dtype=np.int64)
    errors, residual_nm2, estimation_nm2 = np.zeros((8, n)), np.zeros(n), np.zeros(n)
    parts = []
    for batch in batches:
        modes, solution = batch.modes, _solve_filters(batch)
        gains = np.array(transpose(solution.gain_feedback))
        matrices = batch.controllers(gains, response)
        block = close_bank(Bank(modes[:, None], *matrices), gain, response)
        left = block.variances(models)
        found = batch_errors(batch, gains, solution, (block, left), applied=applied)
        errors[:, modes], estimation_nm2[modes] = found
        states[modes], residual_nm2[modes] = batch.A.shape[-1], left.variances[:, 0]
        parts.append((gains[..., 0], *matrices, solution.poles))
    certificate = modal_certificate(errors, estimation_nm2, applied=applied).require(
        "Scale the noise or the turbulence of these modes to sizes that occur."
    )
    names = ("gain_predictor", "A", "B", "C", "D", "poles")
    joined = (_join_batches(batches, each) for each in zip(*parts, strict=True))
    return ModalFilters(
        turbulence=models.turbulence,
        vibrations=models.lines,
        noise_nm=models.noise_nm,
        sensor_gain=gain,
        delay_frames=delay,
        mirror=mirror,
        states=read_only(states),
        controller_states=read_only(states + response.n_states),
        **dict(zip(names, joined, strict=True)),
        rms_nm=frozen_copy(np.sqrt(residual_nm2)),
        certificate=certificate,
    )


def _join_batches(batches: list[PlantBatch], arrays: tuple[Any, ...]) -> Any:
    """Join arrays of batches, (N, ...), as one of all modes, with zeros behind the smaller ones."""
    shape = np.max([array.shape[1:] for array in arrays], axis=0)
    out = np.zeros((sum(len(array) for array in arrays), *shape), dtype=arrays[0].dtype)
    for batch, array in zip(batches, arrays, strict=True):
        own: tuple[Any, ...] = (batch.modes, *(slice(size) for size in array.shape[1:]))
        out[own] = array
    return read_only(out)


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


def batch_errors(
    batch: PlantBatch,
    gains: FloatArray,
    solution: DareSolution,
    loops: tuple[LoopBlock, LoopVariances],
    *,
    applied: bool,
) -> tuple[FloatArray, FloatArray]:
    """Numbers to be checked of some filters and their loops, (8, N), and estimation variances.

    ``applied``: the loops apply the estimate itself, at once and a whole delay later.
    """
    block, left = loops
    A, drive = batch.error_systems(gains)
    P, residuals = stationary_covariances(A, drive)
    lyapunov = (batch.L @ P @ transpose(batch.L))[:, 0, 0]
    riccati = (batch.L @ solution.X @ transpose(batch.L))[:, 0, 0]
    seen = P @ transpose(batch.C)
    optimal = batch.A @ seen / (batch.R + batch.C @ seen)
    size = frobenius_norms(optimal)
    last = np.abs(left.variances[:, 0] - lyapunov) / lyapunov if applied else left.rounding
    rows = (
        np.abs(np.linalg.eigvals(A)).max(axis=-1),
        block.spectral_radii,
        solution.residuals,
        residuals,
        np.abs(lyapunov - riccati) / riccati,
        frobenius_norms(gains - optimal) / np.where(size > 0, size, 1.0),
        left.residuals,
        last,
    )
    return np.stack(rows), lyapunov


def modal_certificate(
    errors: FloatArray, estimation_nm2: FloatArray, *, applied: bool
) -> Certificate:
    """Check the worst mode of everything, (8, n); a check that fails names all modes that do."""
    kinds = (*_CHECKS, _APPLIED if applied else _NOT_APPLIED)
    checks = []
    for (name, limit, computed_by), values in zip(kinds, errors, strict=True):
        failing = np.flatnonzero(~(values < limit))
        text = f"{name} ({name_modes(failing)})" if failing.size else name
        checks.append(Check(text, float(np.max(values)), limit, computed_by))
    rms = frozen_copy(np.sqrt(np.maximum(estimation_nm2, 0)))
    return Certificate(checks=tuple(checks), gamma=np.nan, rms_per_output=rms)
