"""Closed loops of many modes: exact residuals, and long series.

The frames are those of :class:`LoopHardware` with a unit sensor and mirror.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design.certificate import RESIDUAL_TOLERANCE, VARIANCE_TOLERANCE
from lbt_synth.design.modal.banks import LoopBlock, close_bank, filter_phase
from lbt_synth.design.modal.filters import ModalFilters
from lbt_synth.design.modal.mixed_controller import MixedController
from lbt_synth.design.modal.plants import ModalModels, Vibrations, number_per_mode
from lbt_synth.design.modal.reconstructor import name_modes
from lbt_synth.errors import (
    DimensionError,
    NonFiniteError,
    NumericalError,
    ProblemError,
    UnstableLoopError,
)
from lbt_synth.linear.block_filtering import BatchedSystems
from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.models import ARModel, LoopHardware, ModalTurbulence, PositionLoop
from lbt_synth.validation import FloatArray, float_array, integer, number, read_only, real_array


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
    delay_frames : float
        Total delay [frames].
    frame_rate_hz : float or None
        Frame rate [Hz]; None where nothing says it, a loop for any.
    mirror : PositionLoop or None
        Dynamics of the mirror; None: it settles at once.
    sensor_gain : (n,) ndarray
        Real sensor (optical) gain of each mode.
    spectral_radii : (n,) ndarray
        Largest modulus of the poles of the loop that each mode belongs to.
    blocks : tuple
        Matrices of the loops, those of the same size together.
    systems : tuple
        The same from the phase to the residual, ready for long series.
    """

    delay_frames: float
    frame_rate_hz: float | None
    mirror: PositionLoop | None
    sensor_gain: FloatArray
    spectral_radii: FloatArray
    blocks: tuple[LoopBlock, ...]
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
        """Exact stationary residual of each mode, by Lyapunov equations.

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
        NumericalError
            If rounding leaves too few digits: a process that is nearly a random walk.
        """
        self.require_stable()
        models = ModalModels.of(turbulence, noise_nm, vibrations, modes=self.n_modes)
        own, rate = models.turbulence.frame_rate_hz, self.frame_rate_hz
        if rate is not None and not np.isclose(own, rate, rtol=1e-9):
            got = f"{rate:.6g} Hz; got {own:.6g} Hz"
            raise ProblemError(f"turbulence must be sampled at the loop's frame rate, {got}.")
        out = np.zeros(self.n_modes)
        for block in self.blocks:
            left = block.variances(models)
            for what, error, limit in (
                ("the residual of the Lyapunov equation", left.residuals, RESIDUAL_TOLERANCE),
                ("rounding of the variance", left.rounding, VARIANCE_TOLERANCE),
            ):
                bad = np.flatnonzero(~(error < limit))
                if bad.size:
                    raise NumericalError(
                        f"{what} must be below {limit:g}, relative; got {np.max(error):.3g} in "
                        f"{name_modes(np.unique(block.modes[bad]))}. A process with a pole this "
                        "close to 1 is a random walk: move the pole inwards.",
                        status="lyapunov",
                        residual=float(np.max(error)),
                    )
            out[block.modes] = np.sqrt(np.maximum(left.variances, 0))
        return read_only(out)

    def run(
        self,
        total_nm: ArrayLike,
        noise_nm: ArrayLike,
        *,
        settle_frames: int = 0,
        all_series: bool = False,
    ) -> ModalRun:
        """Run the loop over given series, from zero states.

        Parameters
        ----------
        total_nm : (n, frames) array_like
            Total phase of each mode [nm].
        noise_nm : (n, frames) array_like
            Measurement noise of each mode [nm].
        settle_frames : int, optional
            Frames at the beginning that are run and dropped.
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
        ...     lbt.design.modal.MixedController.integrators([0.5, 0.25])
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
        frames = total.shape[1]
        settle = integer(settle_frames, "settle_frames", at_least=0)
        if not settle < frames:
            got = f"{frames} and {settle}"
            raise ProblemError(f"there must be more frames than settle_frames; got {got}.")
        scaled = noise if np.all(self.sensor_gain == 1) else noise / self.sensor_gain[:, None]
        with np.errstate(all="ignore"):  # what is not finite is refused below
            systems = self.systems
            residual, commands = filter_phase(self.blocks, systems, total, scaled, all_series)
        measurements = noise.copy() if all_series else None
        if measurements is not None:
            measurements[:, 1:] += self.sensor_gain[:, None] * residual[:, :-1]
        kept = residual[:, settle:]
        rms = np.sqrt(np.einsum("mf,mf->m", kept, kept) / kept.shape[1])
        if not np.isfinite(residual[:, -1]).all() or not np.isfinite(rms).all():
            real_array(total, "total_nm"), real_array(noise, "noise_nm")
            raise NonFiniteError("the residual must be finite; its numbers ran out of range.")
        named = {"residual_nm": residual, "commands": commands, "measurements": measurements}
        series: dict[str, Any] = {
            name: None if each is None else read_only(each)[:, settle:]
            for name, each in named.items()
        }
        return ModalRun(**series, rms_nm=read_only(rms))


def modal_loop(
    controller: MixedController | ModalFilters,
    *,
    delay_frames: float | None = None,
    sensor_gain: ArrayLike = 1.0,
    mirror: PositionLoop | None = None,
    frame_rate_hz: float | None = None,
) -> ModalLoop:
    """Close the loop of every mode, with a unit sensor and a mirror of unit gain.

    Parameters
    ----------
    controller : MixedController or ModalFilters
        Controllers of the modes, without a reconstructor: y are modal coefficients.
    delay_frames : float, optional
        Real total delay [frames]; by default that of the filters, or of the design that is the
        mixed controller's filter, or 2.
    sensor_gain : float or (n,) array_like, optional
        Real sensor (optical) gain, of all modes or of each.
    mirror : PositionLoop, optional
        Real dynamics of the mirror, the same for all modes; by default those that the filters
        or the design know, or none.
    frame_rate_hz : float, optional
        Frame rate [Hz]; by default that of the filters or of the design. Only a mirror with
        dynamics needs it.

    Returns
    -------
    ModalLoop
        The loops, stable or not.

    Raises
    ------
    ProblemError
        If the controller has a reconstructor or is of another kind, a value is out of its
        range, or the frame rate is not that of the filters.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> loop = lbt.design.modal.modal_loop(lbt.design.modal.MixedController.integrators([0.5, 1.2]))
    >>> loop.is_stable, loop.spectral_radii.round(3).tolist()
    (False, [0.707, 1.095])
    >>> air = lbt.models.ModalTurbulence(
    ...     coefficients=[[0.99]], driving_rms_nm=[10.0], frame_rate_hz=800
    ... )
    >>> one = lbt.design.modal.modal_loop(lbt.design.modal.MixedController.integrators([0.5]))
    >>> one.residual_rms_nm(air, noise_nm=5.0).round(2).tolist()
    [15.98]
    """
    if not isinstance(controller, MixedController | ModalFilters):
        raise ProblemError(
            "controller must be a MixedController or ModalFilters; got "
            f"{type(controller).__name__}. Try MixedController.integrators(gains)."
        )
    if isinstance(controller, MixedController) and controller.reconstructor is not None:
        raise ProblemError(
            "a modal loop is that of modal coefficients; got a controller with a "
            "reconstructor. Leave it out, or use simulate with the sensor's matrix."
        )
    hardware, rate = _path(controller, delay_frames, mirror, frame_rate_hz)
    n = controller.n_modes
    gain = number_per_mode(sensor_gain, "sensor_gain", n)
    response = hardware.mirror_system.whole
    blocks = tuple(close_bank(bank, gain, response) for bank in controller.banks())
    radii = np.zeros(n)
    for block in blocks:
        radii[block.modes] = block.spectral_radii[:, None]
    return ModalLoop(
        delay_frames=hardware.delay_frames,
        frame_rate_hz=rate,
        mirror=hardware.mirror,
        sensor_gain=gain,
        spectral_radii=read_only(radii),
        blocks=blocks,
        systems=tuple(block.phase_system(block.width) for block in blocks),
    )


def _path(
    controller: MixedController | ModalFilters,
    delay_frames: float | None,
    mirror: PositionLoop | None,
    frame_rate_hz: float | None,
) -> tuple[LoopHardware, float | None]:
    """Return the hardware of one mode, from what is given or else designed for, and its rate."""
    designed = controller.hardware
    rate = None if controller.dt_s is None else 1 / controller.dt_s
    if frame_rate_hz is not None:
        given = number(frame_rate_hz, "frame_rate_hz", above=0)
        if rate is not None and not np.isclose(given, rate, rtol=1e-9):
            raise ProblemError(
                f"frame_rate_hz must be that of the filters, {rate:.6g} Hz; got {given:.6g} Hz."
            )
        rate = given
    if mirror is None and designed is not None:
        mirror = designed.mirror
    if delay_frames is None:
        delay_frames = 2.0 if designed is None else designed.delay_frames
    if mirror is not None and rate is None:
        raise ProblemError("a mirror with dynamics needs frame_rate_hz; got none.")
    sampling = 1.0 if rate is None else rate
    path = LoopHardware(frame_rate_hz=sampling, delay_frames=delay_frames, modes=1, mirror=mirror)
    return path, rate
