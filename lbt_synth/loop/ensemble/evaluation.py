"""Evaluates controllers in an ensemble of loops: exact residuals by origin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError
from lbt_synth.linear import Controller
from lbt_synth.loop.closed_loop import require_matching_controller
from lbt_synth.loop.ensemble.closed_loops import ClosedLoops
from lbt_synth.loop.ensemble.covariances import turbulence_and_noise_nm2, vibration_residuals
from lbt_synth.loop.ensemble.loop_ensemble import LoopEnsemble, turbulence_rows
from lbt_synth.loop.strehl import Imaging, jitter_spread_nm, jitter_strehls, widest_jitter_nm
from lbt_synth.models import LoopHardware
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, read_only, require_instance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EnsembleResiduals:
    """Stationary residuals of p loops; nan where a loop is unstable.

    Attributes
    ----------
    stable : (p,) bool ndarray
        Whether each loop is stable.
    turbulence_nm2, noise_nm2, random_vibration_nm2 : (p, n, n) ndarray
        Covariances over the modes [nm^2].
    line_amplitudes_nm : (p, s, n) complex ndarray
        Complex amplitude that each sinusoid leaves on each mode [nm].
    """

    stable: BoolArray
    turbulence_nm2: FloatArray
    noise_nm2: FloatArray
    random_vibration_nm2: FloatArray
    line_amplitudes_nm: ComplexArray

    @property
    def turbulence_nm(self) -> FloatArray:
        """Residual turbulence over all modes [nm rms], (p,)."""
        return np.sqrt(_power(self.turbulence_nm2))

    @property
    def noise_nm(self) -> FloatArray:
        """Propagated noise over all modes [nm rms], (p,)."""
        return np.sqrt(_power(self.noise_nm2))

    @property
    def vibration_nm(self) -> FloatArray:
        """Residual vibration over all modes, the sinusoids by their mean power [nm rms], (p,)."""
        return np.sqrt(self._vibration_nm2())

    @property
    def rms_nm(self) -> FloatArray:
        """Residual over all modes [nm rms], (p,)."""
        return np.sqrt(_power(self.turbulence_nm2) + _power(self.noise_nm2) + self._vibration_nm2())

    def strehl(self, imaging: Imaging) -> FloatArray:
        """Strehl ratio of each loop.

        Parameters
        ----------
        imaging : Imaging
            The camera.

        Returns
        -------
        (p,) ndarray
            Strehl ratio in [0, 1]; nan where the loop is unstable, 0 where the image moves by
            more than 160 times its width.

        Raises
        ------
        DimensionError
            If the loops have more than two modes.
        """
        gaussian = self.turbulence_nm2 + self.noise_nm2 + self.random_vibration_nm2
        lines = self.line_amplitudes_nm
        out = np.full(self.stable.shape, np.nan)
        found = np.flatnonzero(self.stable)
        out[found] = 0.0
        spread = jitter_spread_nm(gaussian[found], lines[found])
        near = found[spread <= widest_jitter_nm(imaging)]
        out[near] = jitter_strehls(gaussian[near], imaging=imaging, line_amplitudes_nm=lines[near])
        return out

    def _vibration_nm2(self) -> FloatArray:
        lines = np.sum(np.abs(self.line_amplitudes_nm) ** 2, axis=(1, 2)) / 2
        return np.asarray(_power(self.random_vibration_nm2) + lines)


def _power(covariances: FloatArray) -> FloatArray:
    return np.asarray(np.trace(covariances, axis1=1, axis2=2), dtype=np.float64)


def ensemble_residuals(
    controller: Any, hardware: LoopHardware, ensemble: LoopEnsemble
) -> EnsembleResiduals:
    """Evaluate a controller exactly in many loops, or many controllers in one loop each.

    The answers are those of :func:`residual_budget`, loop by loop: stability by eigenvalues,
    spectra and noise by quadrature refined around the closed loops' poles, auto-regressive
    processes by Lyapunov equations, sinusoids by the closed loops' response. Independent tip and
    tilt are evaluated separately, and only once if they are equal.

    Parameters
    ----------
    controller : Controller or sequence of Controller
        One controller for all loops, or one per loop, all with as many states.
    hardware : LoopHardware
        Sensor and mirror of all loops; the ensemble may have other delays.
    ensemble : LoopEnsemble
        What the loops meet, p of them.

    Returns
    -------
    EnsembleResiduals
        Stability and covariances by origin.

    Raises
    ------
    ProblemError
        If the controller, a vibration, the turbulence or the noise does not fit the loop.
    NumericalError
        If an equation was not solved.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.005, rms_nm=797)
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5
    ... )
    >>> ensemble = lbt.loop.LoopEnsemble(
    ...     sensor_gain=[0.8, 1.0, 4.0],
    ...     turbulence=slow,
    ...     noise_nm=15.5,
    ...     vibrations=[lbt.loop.EnsembleVibration(frequency_hz=[19.0, 20.0, 20.0], rms_nm=797)],
    ... )
    >>> found = lbt.loop.ensemble_residuals(lbt.kalman(plant).controller, plant.hardware, ensemble)
    >>> found.rms_nm.round(1).tolist()
    [195.4, 181.9, nan]
    """
    require_instance(hardware, LoopHardware)
    require_instance(ensemble, LoopEnsemble)
    each = [controller] if isinstance(controller, Controller) else list(controller)
    for one in each:
        require_instance(one, Controller)
        require_matching_controller(hardware, one)
    sizes, count = sorted({one.n_states for one in each}), ensemble.loops
    if len(each) not in (1, count) or len(sizes) != 1:
        raise DimensionError(
            f"give one controller, or one per loop ({count}) with as many states each; got "
            f"{len(each)} with {sizes} states."
        )
    return residuals_from_matrices(textbook_matrices(each), hardware, ensemble)


def residuals_from_matrices(
    matrices: tuple[FloatArray, ...], hardware: LoopHardware, ensemble: LoopEnsemble
) -> EnsembleResiduals:
    """Evaluate controllers ``A, B, C, D`` in textbook form, (1 or p, ., .) each."""
    turbulence, lines = ensemble.groups(hardware), ensemble.lines(hardware)
    # loops that differ only in their vibrations are closed once
    points, which = ensemble.distinct(hardware, apart=len(matrices[0]) > 1)
    gains, delays = ensemble.gains()[points], ensemble.delays(hardware)[points]
    loops = ClosedLoops.of(matrices, hardware, gains, delays)
    distinct = [(turbulence_rows(spectrum, points), modes) for spectrum, modes in turbulence]
    noise_nm = ensemble.noise(hardware)[points]
    turbulence_nm2, noise_nm2 = turbulence_and_noise_nm2(loops, distinct, noise_nm)
    random_nm2, amplitudes = vibration_residuals(loops, which, lines)
    return EnsembleResiduals(
        stable=read_only(loops.stable[which]),
        turbulence_nm2=turbulence_nm2[which],
        noise_nm2=noise_nm2[which],
        random_vibration_nm2=random_nm2,
        line_amplitudes_nm=amplitudes,
    )


def textbook_matrices(controllers: Sequence[Controller]) -> tuple[FloatArray, ...]:
    """Return controllers with equal numbers of states as balanced ``A, B, C, D``, textbook form.

    Only in states of comparable units does an entry that is tiny beside the others do nothing.
    """
    systems = [controller.to_statespace() for controller in controllers]
    systems = [system.balanced() if system.n_states else system for system in systems]
    return tuple(np.stack([getattr(system, name) for system in systems]) for name in "ABCD")
