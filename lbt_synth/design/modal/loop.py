"""Closed loops of many modes: exact residuals, and long series.

The frames are those of :class:`LoopHardware` with a unit sensor and mirror.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.modal.banks import Bank, filter_phase
from lbt_synth.design.modal.mixed_controller import MixedController
from lbt_synth.design.modal.per_mode import (
    Lines,
    Vibrations,
    lines_per_mode,
    name_modes,
    number_per_mode,
)
from lbt_synth.design.modal.stack import ModalFilters
from lbt_synth.errors import (
    DimensionError,
    NonFiniteError,
    ProblemError,
    UnstableLoopError,
)
from lbt_synth.linear.block_filtering import BatchedSystems
from lbt_synth.loop import EnsembleVibration, LoopEnsemble
from lbt_synth.loop.closed_loop import STABILITY_MARGIN, require_loop_rate
from lbt_synth.loop.ensemble.evaluation import residuals_from_matrices
from lbt_synth.loop.ensemble.loop_ensemble import turbulence_rows
from lbt_synth.models import ARModel, LoopHardware, ModalTurbulence
from lbt_synth.validation import FloatArray, float_array, read_only, real_array, require_instance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalRun:
    """Series of a modal loop."""

    residual_nm: FloatArray  # (n, frames): residual phase [nm]
    # (n, frames): commands u(k) and measurements y(k) [nm], with ``all_series``
    commands: FloatArray | None
    measurements: FloatArray | None
    rms_nm: FloatArray  # (n,): residual of each mode [nm rms]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalLoop:
    """Closed loops of n modes, made by :func:`modal_loop`.

    Attributes
    ----------
    hardware : LoopHardware
        Delay, mirror and frame rate: the loop of one mode with a unit sensor.
    sensor_gain : (n,) ndarray
        Real sensor (optical) gain of each mode.
    spectral_radii : (n,) ndarray
        Largest modulus of the poles of the loop that each mode belongs to.
    controllers, loops : tuple of Bank
        Controllers and their loops, those of the same size together.
    systems : tuple
        The loops from the phase to the residual, ready for long series.
    """

    hardware: LoopHardware
    sensor_gain: FloatArray
    spectral_radii: FloatArray
    controllers: tuple[Bank, ...]
    loops: tuple[Bank, ...]
    systems: tuple[BatchedSystems, ...]

    @property
    def n_modes(self) -> int:
        """Number of modes n."""
        return int(self.sensor_gain.size)

    @property
    def is_stable(self) -> bool:
        """Whether every loop's poles lie inside the unit circle, by more than 1e-9."""
        return bool(np.all(self.spectral_radii < 1 - STABILITY_MARGIN))

    def require_stable(self) -> None:
        """Raise if a loop is unstable or marginally stable.

        Raises
        ------
        UnstableLoopError
            With the modes and the largest spectral radius.
        """
        if not self.is_stable:
            bad = np.flatnonzero(~(self.spectral_radii < 1 - STABILITY_MARGIN))
            worst = float(self.spectral_radii.max())
            raise UnstableLoopError(
                f"the loop of every mode must be stable; got unstable or marginal ones, "
                f"{name_modes(bad)} (spectral radius up to {worst:.12g}). Lower their gains, or "
                "design for this delay and sensor gain.",
                spectral_radius=worst,
            )

    def residual_rms_nm(
        self,
        turbulence: ModalTurbulence | Sequence[ARModel],
        *,
        noise_nm: ArrayLike,
        vibrations: Vibrations | None = None,
    ) -> FloatArray:
        """Exact stationary residual of each mode, as :func:`ensemble_residuals` computes it.

        Parameters
        ----------
        turbulence : ModalTurbulence or sequence of ARModel
            Turbulence of the modes.
        noise_nm : float or (n,) array_like
            Measurement noise of each mode per frame [nm], at least 0.
        vibrations : mapping of int to Vibration or list of them, optional
            Vibrations of some modes; their directions play no part.

        Returns
        -------
        (n,) ndarray
            Residual of each mode [nm rms].

        Raises
        ------
        UnstableLoopError
            If a loop is unstable.
        ProblemError
            If sizes clash, a value is out of its range, or the models are sampled at another
            frame rate than the loop's.
        """
        self.require_stable()
        if not isinstance(turbulence, ModalTurbulence):
            turbulence = ModalTurbulence.of(turbulence)
        if turbulence.n_modes != self.n_modes:
            raise DimensionError(
                f"turbulence must have {self.n_modes} modes; got {turbulence.n_modes}."
            )
        noise = number_per_mode(noise_nm, "noise_nm", self.n_modes, zero=True)
        lines = lines_per_mode(vibrations, self.n_modes)
        require_loop_rate(turbulence.frame_rate_hz, self.hardware)
        out = np.zeros(self.n_modes)
        for bank in self.controllers:
            counts = np.array([len(lines[mode]) for mode in bank.modes[:, 0]])
            for count in np.unique(counts):  # of vibrations, the same in an ensemble
                some = bank.take(np.flatnonzero(counts == count))
                out[some.modes] = _residuals(
                    some, self.hardware, self.sensor_gain, turbulence, noise, lines
                )
        return read_only(out)

    def run(
        self,
        total_nm: ArrayLike,
        noise_nm: ArrayLike,
        *,
        all_series: bool = False,
    ) -> ModalRun:
        """Run the loop over given series, from zero states.

        Parameters
        ----------
        total_nm : (n, frames) array_like
            Total phase of each mode [nm].
        noise_nm : (n, frames) array_like
            Measurement noise of each mode [nm].
        all_series : bool, optional
            Whether to return commands and measurements, too.

        Returns
        -------
        ModalRun
            The series: those of the frame-by-frame loop, up to rounding.

        Raises
        ------
        UnstableLoopError
            If a loop is unstable.
        ProblemError
            If sizes clash, or a value is no number or not finite.

        Examples
        --------
        >>> import numpy as np
        >>> import lbt_synth as lbt
        >>> loop = lbt.design.modal.modal_loop(
        ...     lbt.design.modal.MixedController(gains=[0.5, 0.25]),
        ...     hardware=lbt.LoopHardware(frame_rate_hz=800),
        ... )
        >>> step = np.ones((2, 40))
        >>> loop.run(step, 0 * step).residual_nm[:, [0, 2, 39]].round(3).tolist()
        [[1.0, 0.5, 0.0], [1.0, 0.75, 0.0]]
        """
        self.require_stable()
        total, noise = float_array(total_nm, "total_nm"), float_array(noise_nm, "noise_nm")
        if total.ndim != 2 or total.shape != noise.shape or len(total) != self.n_modes:
            raise DimensionError(
                f"total_nm and noise_nm must both be ({self.n_modes}, frames); got {total.shape} "
                f"and {noise.shape}."
            )
        if not total.shape[1]:
            raise DimensionError("total_nm must have at least one frame; got none.")
        scaled = noise if np.all(self.sensor_gain == 1) else noise / self.sensor_gain[:, None]
        with np.errstate(all="ignore"):  # what is not finite is refused below
            residual = filter_phase(self.loops, self.systems, total, scaled)
            residual[:, :-1] -= scaled[:, 1:]
        rms = np.sqrt(np.einsum("mf,mf->m", residual, residual) / residual.shape[1])
        if not np.isfinite(residual[:, -1]).all() or not np.isfinite(rms).all():
            real_array(total, "total_nm"), real_array(noise, "noise_nm")
            raise NonFiniteError("the residual must be finite; its numbers ran out of range.")
        commands = measurements = None
        if all_series:
            measurements = noise.copy()
            measurements[:, 1:] += self.sensor_gain[:, None] * residual[:, :-1]
            measurements = read_only(measurements)
            systems = tuple(loop.phase_systems()[1] for loop in self.loops)
            commands = read_only(filter_phase(self.loops, systems, total, scaled))
        return ModalRun(
            residual_nm=read_only(residual),
            commands=commands,
            measurements=measurements,
            rms_nm=read_only(rms),
        )


def _residuals(
    bank: Bank,
    hardware: LoopHardware,
    sensor_gain: FloatArray,
    turbulence: ModalTurbulence,
    noise_nm: FloatArray,
    lines: Lines,
) -> FloatArray:
    """Residuals (N, w) of the loops of a bank, as an ensemble; hardware is that of one mode."""
    w, gain, columns = bank.width, sensor_gain[bank.modes], list(bank.modes.T)
    vibrations = [
        EnsembleVibration(
            frequency_hz=[lines[mode][i].frequency_hz for mode in column],
            rms_nm=[lines[mode][i].rms_nm for mode in column],
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
    left = residuals_from_matrices(bank.textbook(), hardware, conditions, in_image=False)
    power = left.turbulence_nm2 + left.noise_nm2 + left.random_vibration_nm2
    return np.sqrt(np.diagonal(power, axis1=1, axis2=2))


def modal_loop(
    controller: MixedController | ModalFilters,
    *,
    hardware: LoopHardware | None = None,
    sensor_gain: ArrayLike = 1.0,
) -> ModalLoop:
    """Close the loop of every mode, with a unit sensor and a mirror of unit gain.

    Parameters
    ----------
    controller : MixedController or ModalFilters
        Controllers of the modes, without a reconstructor: y are modal coefficients.
    hardware : LoopHardware, optional
        Real delay, mirror and frame rate; its matrices play no part. By default that of the
        filters, or of the design that is the mixed controller's filter.
    sensor_gain : float or (n,) array_like, optional
        Real sensor (optical) gain, of all modes or of each.

    Returns
    -------
    ModalLoop
        The loops, stable or not.

    Raises
    ------
    ProblemError
        If the controller has a reconstructor or is of another kind, a value is out of its
        range, no filter has a loop and none is given, or its frame rate is not the filters'.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> control = lbt.design.modal.MixedController(gains=[0.5, 1.2])
    >>> loop = lbt.design.modal.modal_loop(control, hardware=path)
    >>> loop.is_stable, loop.spectral_radii.round(3).tolist()
    (False, [0.707, 1.095])
    >>> air = lbt.models.ModalTurbulence(
    ...     coefficients=[[0.99]], driving_rms_nm=[10.0], frame_rate_hz=800
    ... )
    >>> control = lbt.design.modal.MixedController(gains=[0.5])
    >>> one = lbt.design.modal.modal_loop(control, hardware=path)
    >>> one.residual_rms_nm(air, noise_nm=5.0).round(2).tolist()
    [15.98]
    """
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
    path = path.single_mode()
    if dt_s is not None and not np.isclose(path.dt_s, dt_s, rtol=1e-9):
        raise ProblemError(
            f"hardware must have the frame rate of the filters, {1 / dt_s:.6g} Hz; got "
            f"{path.frame_rate_hz:.6g} Hz."
        )
    gain = number_per_mode(sensor_gain, "sensor_gain", controller.n_modes)
    controllers = controller.banks()
    loops = tuple(bank.close(gain, path.mirror_system.whole) for bank in controllers)
    radii = np.zeros(controller.n_modes)
    for loop in loops:
        radii[loop.modes] = np.abs(np.linalg.eigvals(loop.A)).max(axis=-1)[:, None]
    return ModalLoop(
        hardware=path,
        sensor_gain=gain,
        spectral_radii=read_only(radii),
        controllers=controllers,
        loops=loops,
        systems=tuple(loop.phase_systems()[0] for loop in loops),
    )
