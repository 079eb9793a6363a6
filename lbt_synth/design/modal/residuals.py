"""What the loops of many modes leave, exactly: each mode is a loop of an ensemble."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.modal.banks import Bank
from lbt_synth.design.modal.mixed_controller import MixedController
from lbt_synth.design.modal.per_mode import (
    Lines,
    Vibrations,
    lines_per_mode,
    name_modes,
    number_per_mode,
)
from lbt_synth.design.modal.stack import ModalFilters
from lbt_synth.errors import DimensionError, ProblemError, UnstableLoopError
from lbt_synth.loop import EnsembleVibration, LoopEnsemble
from lbt_synth.loop.closed_loop import require_loop_rate
from lbt_synth.loop.ensemble import residuals_from_matrices, turbulence_rows
from lbt_synth.models import ARModel, LoopHardware, ModalTurbulence, Vibration
from lbt_synth.validation import BoolArray, FloatArray, read_only, require_instance


def modal_residuals(
    controller: MixedController | ModalFilters,
    turbulence: ModalTurbulence | Sequence[ARModel],
    *,
    noise_nm: ArrayLike,
    vibrations: Vibrations | None = None,
    hardware: LoopHardware | None = None,
    sensor_gain: ArrayLike = 1.0,
    frame_means: bool = False,
) -> FloatArray:
    """Exact stationary residual of each mode, with a unit sensor and a mirror of unit gain.

    Parameters
    ----------
    controller : MixedController or ModalFilters
        Controllers of the modes, without a reconstructor: y are modal coefficients.
    turbulence : ModalTurbulence or sequence of ARModel
        Turbulence of each mode, as means over frames.
    noise_nm : float or (n,) array_like
        Measurement noise of each mode per frame [nm], at least 0.
    vibrations : mapping of int to Vibration or list of them, optional
        Vibrations of some modes, as means over frames; their directions play no part.
    hardware : LoopHardware, optional
        Real delay, mirror and frame rate; its matrices play no part. By default that of the
        filters, or of the design that is the mixed controller's filter.
    sensor_gain : float or (n,) array_like, optional
        Real sensor (optical) gain, of all modes or of each.
    frame_means : bool, optional
        Whether to leave out what moves within frames, as :func:`residual_budget` does.

    Returns
    -------
    (n,) ndarray
        Residual of each mode [nm rms].

    Raises
    ------
    UnstableLoopError
        If a loop is unstable; the message names the modes.
    ProblemError
        If the controller has a reconstructor or is of another kind, sizes clash, a value is out of
        its range, no filter has a loop and none is given, or frame rates differ.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> air = lbt.models.ModalTurbulence(
    ...     coefficients=[[0.99], [0.99]], driving_rms_nm=[10.0, 5.0], frame_rate_hz=800
    ... )
    >>> control = lbt.design.modal.MixedController(gains=[0.5, 0.4])
    >>> left = lbt.design.modal.modal_residuals(control, air, noise_nm=5.0, hardware=path)
    >>> left.round(2).tolist()
    [16.44, 8.6]
    """
    path = _checked_path(controller, hardware)
    if not isinstance(turbulence, ModalTurbulence):
        turbulence = ModalTurbulence.of(turbulence)
    n = controller.n_modes
    if turbulence.n_modes != n:
        raise DimensionError(f"turbulence must have {n} modes; got {turbulence.n_modes}.")
    require_loop_rate(turbulence.frame_rate_hz, path)
    noise = number_per_mode(noise_nm, "noise_nm", n, zero=True)
    gain = number_per_mode(sensor_gain, "sensor_gain", n)
    lines = lines_per_mode(vibrations, n)
    residual, stable = np.zeros(n), np.zeros(n, dtype=np.bool_)
    for bank in controller.banks():
        counts = np.array([len(lines[mode]) for mode in bank.modes[:, 0]])
        for count in np.unique(counts):  # of vibrations, the same in an ensemble
            some = bank.take(np.flatnonzero(counts == count))
            left = _residuals(some, path, gain, turbulence, noise, lines, frame_means=frame_means)
            residual[some.modes], stable[some.modes] = left[0], left[1][:, None]
    if not stable.all():
        raise UnstableLoopError(
            "the loop of every mode must be stable; got unstable or marginal ones, "
            f"{name_modes(np.flatnonzero(~stable))}. Lower their gains, or design for this delay "
            "and sensor gain."
        )
    return read_only(residual)


def _checked_path(
    controller: MixedController | ModalFilters, hardware: LoopHardware | None
) -> LoopHardware:
    """Return the loop of one mode that a controller runs in."""
    if not hasattr(controller, "banks"):
        raise ProblemError(
            "controller must be a MixedController or ModalFilters; got "
            f"{type(controller).__name__}. Try MixedController(gains=gains)."
        )
    if getattr(controller, "reconstructor", None) is not None:
        raise ProblemError(
            "a modal loop is that of modal coefficients; got a controller with a "
            "reconstructor. Leave it out, or use simulate with the sensor's matrix."
        )
    path, dt_s = hardware or controller.hardware, controller.dt_s
    if path is None:
        raise ProblemError("hardware must be given where no filter has a loop; got None.")
    require_instance(path, LoopHardware, "hardware")
    if dt_s is not None and not np.isclose(path.dt_s, dt_s, rtol=1e-9):
        raise ProblemError(
            f"hardware must have the frame rate of the filters, {1 / dt_s:.6g} Hz; got "
            f"{path.frame_rate_hz:.6g} Hz."
        )
    return path.single_mode()


def _residuals(
    bank: Bank,
    hardware: LoopHardware,
    sensor_gain: FloatArray,
    turbulence: ModalTurbulence,
    noise_nm: FloatArray,
    lines: Lines,
    *,
    frame_means: bool,
) -> tuple[FloatArray, BoolArray]:
    """Residuals (N, w) of the loops of a bank, as an ensemble, and which loops are stable (N,).

    The hardware is that of one mode.
    """

    def share(line: Vibration) -> float:
        """Return how much of a line's rms is that of its means, if what moves within counts."""
        return 1.0 if frame_means else float(np.sinc(line.frequency_hz * hardware.dt_s))

    w, gain, columns = bank.width, sensor_gain[bank.modes], list(bank.modes.T)
    vibrations = [
        EnsembleVibration(
            frequency_hz=[lines[mode][i].frequency_hz for mode in column],
            rms_nm=[lines[mode][i].rms_nm / share(lines[mode][i]) for mode in column],
            damping=[lines[mode][i].damping for mode in column],
            direction=axis,
        )
        for axis, column in zip(np.eye(w), columns, strict=True)
        for i in range(len(lines[column[0]]))
    ]
    conditions = LoopEnsemble(
        loops=len(bank.modes),
        sensor_gain=gain[:, 0] if w == 1 else 1.0,
        noise_nm=noise_nm[bank.modes],
        turbulence=[turbulence_rows(turbulence, column) for column in columns],
        vibrations=tuple(vibrations),
    )
    if w > 1:
        sensor = np.diag(gain[0])
        hardware = replace(hardware, modes=w, sensor_matrix=sensor, influence_matrix=None)
    left = residuals_from_matrices(bank.textbook(), hardware, conditions, in_image=not frame_means)
    power = left.turbulence_nm2 + left.noise_nm2 + left.random_vibration_nm2 + left.within_nm2
    return np.sqrt(np.diagonal(power, axis1=1, axis2=2)), left.stable
