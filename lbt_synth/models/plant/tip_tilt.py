"""The plant of tip and tilt that filters are designed for (Agapito et al. 2008, eqs. 5-8).

The paper's state, for n modes, p vibrations and m commands::

    x(k) = [vib(k) (p), vib(k-1) (p), tur(k) (n), tot(k-1) (n), u(k-2) (m)]

with the errata corrected: the vibration row holds ``A1, -A2``, the estimated
signal is ``z = L x`` with ``L = [E 0 I 0 0]`` predicted one frame ahead, and
E (n, p) embeds the vibrations into the modes. Turbulence of order r has r
such blocks; a longer delay has a chain of past totals. The reduced form drops
the known input u, whose estimation error is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, EstimationProblem
from lbt_synth.linear.estimation_problem import LONGEST_HORIZON
from lbt_synth.linear.state_space import sigma_sparkline
from lbt_synth.models.ar_model import ARModel, padded_coefficients
from lbt_synth.models.disturbance_facts import disturbance_facts
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.mirror.position_loop import PositionLoop
from lbt_synth.models.plant.full_state import FullStatePlant
from lbt_synth.models.plant.parts import PlantParts, held_frames, noise_factor
from lbt_synth.models.vibration import Vibration
from lbt_synth.storage.rows import fact_table
from lbt_synth.storage.summaries import Summary
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, frozen_copy, integer, one_or_each


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TipTiltPlant(EstimationProblem):
    """Turbulence, vibrations, delay and noise as an estimation problem (reduced form).

    Made by :func:`tip_tilt_plant`. The measurement of this problem is
    ``ybar(k) = y(k) + sensor_matrix N u(k-d)``, without the known input.

    Parameters
    ----------
    hardware : LoopHardware
        The loop, with the sensor gain that the design assumes in its sensor matrix.
    turbulence : tuple of ARModel
        One model per mode.
    vibrations : tuple of Vibration
        The vibrations, possibly none.
    """

    hardware: LoopHardware
    turbulence: tuple[ARModel, ...]
    vibrations: tuple[Vibration, ...]

    def _brief(self) -> str:
        lines = count_text(len(self.vibrations), "vibration")
        return f"{self.hardware._brief()}, {count_text(self.n_states, 'state')}, {lines}"

    def _summarise(self) -> Summary:
        deviations = np.sqrt(np.diag(self.R))
        facts = disturbance_facts(self.turbulence, self.vibrations, deviations)
        system, caption = self._shown_system()
        return Summary(
            tables=[fact_table("Plant", self.hardware.facts(), facts)],
            curve=sigma_sparkline(system, caption),
        )

    def full(self) -> FullStatePlant:
        """Return the same plant with the mirror's states, which are past commands if it settles.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6)
        >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
        >>> plant = lbt.tip_tilt_plant(
        ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5
        ... )
        >>> plant.full().A.shape  # 2 p + 2 n + m = 2 + 4 + 2, the paper's case
        (8, 8)
        """
        hw = self.hardware
        mirror = hw.mirror_system.whole
        A_mirror, B_mirror, C_mirror = mirror.repeated(hw.n_commands)
        n, past = self.A.shape[0], mirror.n_states * hw.n_commands
        A = np.zeros((n + past, n + past))
        A[:n, :n], A[n:, n:] = self.A, A_mirror
        B_known = np.zeros((n + past, hw.n_commands))  # u(k-1) is the input
        B_known[n:] = B_mirror
        response = -hw.sensor @ hw.influence
        C = np.hstack([self.C, response @ C_mirror])
        pad = np.zeros((past, self.B.shape[1]))
        return FullStatePlant(
            A=A,
            B=np.vstack([self.B, pad]),
            C=C,
            D=self.D,
            L=np.hstack([self.L, np.zeros((self.L.shape[0], past))]),
            B_known=frozen_copy(B_known),
            D_known=frozen_copy(mirror.D * response),
            hardware=hw,
            dt_s=self.dt_s,
        )

    def controller(self, gain_predictor: FloatArray) -> Controller:
        """Return the controller from y(k) to u(k), the known input included, in new-state form.

        Its states are those of the reduced estimator, to which the gain (n, q) belongs, and the
        mirror's.
        """
        full = self.full()
        return full.controller(self._padded(gain_predictor, full))

    def estimator(self, gain_predictor: FloatArray) -> Controller:
        """Estimator of z from ``[y(k), u(k-1)]``, whatever gave that command, in new-state form.

        The known input is removed exactly, so the estimation error does not depend on it. The
        predictor gain is over the reduced state, (n, q).
        """
        full = self.full()
        return full.estimator(self._padded(gain_predictor, full))

    def ahead(self, frames: int) -> TipTiltPlant:
        """Plant of the estimate of ``z(k + frames)`` from y up to k: a loop of another delay.

        A prediction that reaches one frame further serves a loop that is one frame later, so the
        plant returned has a delay of ``delay_frames + frames - 1``. A delay below one frame, or
        ``frames`` that are no integer, raise a ProblemError.

        Examples
        --------
        >>> import lbt_synth as lbt
        >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
        >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=15.5)
        >>> [plant.ahead(frames).hardware.delay_frames for frames in (0, 1, 2)]
        [1.0, 2.0, 3.0]
        """
        steps = integer(frames, "horizon", at_least=-LONGEST_HORIZON)
        if steps == 1:
            return self
        hw = self.hardware
        delay = hw.delay_frames + steps - 1
        if not 1 <= delay <= LONGEST_HORIZON:
            raise ProblemError(
                f"horizon must leave the loop a delay of 1 to {LONGEST_HORIZON} frames; got "
                f"{steps}, which makes {delay:g}.",
                in_python="For an estimate without a loop, make an EstimationProblem of the "
                "plant's matrices.",
            )
        return assemble(replace(self.parts(), hardware=replace(hw, delay_frames=delay)))

    def parts(self) -> PlantParts:
        """Return what the plant was assembled from.

        A plant that holds the memory of a mixed filter raises a ProblemError.
        """
        q = self.hardware.n_measurements
        parts = PlantParts(
            hardware=self.hardware,
            turbulence=self.turbulence,
            vibrations=self.vibrations,
            noise_factor=self.D[:, -q:],
        )
        if self.n_states != parts.size:
            raise ProblemError(
                "this plant holds the memory of a mixed filter, and cannot be assembled again; "
                "take the plant that the filter was designed for."
            )
        return parts

    def _padded(self, gain_predictor: FloatArray, full: FullStatePlant) -> FloatArray:
        """Gain over the full state; the known input has no error and needs no gain."""
        gain = self._checked_gain(gain_predictor)
        return np.vstack([gain, np.zeros((len(full.A) - len(gain), gain.shape[1]))])


def tip_tilt_plant(
    *,
    frame_rate_hz: float,
    turbulence: ARModel | Sequence[ARModel],
    noise_nm: ArrayLike,
    vibrations: Sequence[Vibration] | None = None,
    delay_frames: float = 2.0,
    sensor_matrix: ArrayLike | None = None,
    influence_matrix: ArrayLike | None = None,
    sensor_gain: float | Sequence[float] | FloatArray = 1.0,
    modes: int = 2,
    mirror: PositionLoop | None = None,
) -> TipTiltPlant:
    """Assemble the plant of a tip/tilt loop from its parts.

    Parameters
    ----------
    frame_rate_hz : float
        Frame rate [Hz].
    turbulence : ARModel or sequence of ARModel
        Turbulence of each mode; one model serves all modes.
    noise_nm : float, (q,) or (q, q) array_like
        Standard deviation of the measurement noise per frame, one for all measurements or one
        per measurement [nm], or its covariance [nm^2].
    vibrations : sequence of Vibration, optional
        The vibrations; None for a plant without any.
    delay_frames : float, optional
        Total delay of the loop [frames], at least 1, fractions allowed. For a
        fractional delay the estimated signal is interpolated between two frames.
    sensor_matrix : (q, n) array_like, optional
        Sensor response; the identity by default.
    influence_matrix : (n, m) array_like, optional
        Mirror response; the identity by default.
    sensor_gain : float or (q,) array_like, optional
        Sensor (optical) gain that the design assumes; multiplies the sensor matrix, row by
        row where there is one per measurement.
    modes : int, optional
        Number of modes n when no matrix gives it.
    mirror : PositionLoop, optional
        Dynamics of the mirror. The estimated signal is the one for a mirror that settles at
        once; :func:`lqg` commands the mirror so that it gets there.

    Returns
    -------
    TipTiltPlant
        The reduced estimation problem, with ``w = [v_vib, v_tur, noise]``.

    Raises
    ------
    ProblemError
        If a value is not finite, out of range, or sizes clash.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1,))
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5, modes=1
    ... )
    >>> plant.A.shape
    (4, 4)
    """
    hardware = LoopHardware(
        frame_rate_hz=frame_rate_hz,
        delay_frames=delay_frames,
        sensor_matrix=cast("FloatArray | None", sensor_matrix),  # checked there
        influence_matrix=cast("FloatArray | None", influence_matrix),
        modes=modes,
        mirror=mirror,
    )
    gains = one_or_each(sensor_gain, "sensor_gain", hardware.n_measurements, above=0)
    if np.any(gains != 1):
        sensor = np.reshape(gains, (-1, 1)) * hardware.sensor
        hardware = replace(hardware, sensor_matrix=sensor)
    if vibrations is not None and not tuple(vibrations):
        raise ProblemError(
            "vibrations is empty; expected at least one Vibration, or None (leave it out) "
            "for a plant without vibrations."
        )
    models = (turbulence,) * hardware.modes if isinstance(turbulence, ARModel) else turbulence
    return assemble(
        PlantParts(
            hardware=hardware,
            turbulence=tuple(models),
            vibrations=tuple(vibrations or ()),
            noise_factor=noise_factor(noise_nm, hardware.n_measurements),
        )
    )


def assemble(parts: PlantParts) -> TipTiltPlant:
    """Assemble a plant from its parts."""
    hardware, p, n = parts.hardware, len(parts.vibrations), parts.hardware.modes
    ar2 = [line.ar_model(hardware.frame_rate_hz) for line in parts.vibrations]
    lines = np.array([model.coefficients for model in ar2]).reshape(p, 2)
    air = padded_coefficients(parts.turbulence)

    tur, tot, size = 2 * p, 2 * p + air.size, parts.size  # where parts of the state begin, and end
    total = np.zeros((n, size))
    total[:, :p] = np.array([line.direction for line in parts.vibrations]).reshape(p, n).T
    total[:, tur : tur + n] = np.eye(n)
    A = np.zeros((size, size))
    A[:tur, :tur], A[tur:tot, tur:tot] = _companion(lines), _companion(air)
    A[tot : tot + n], A[tot + n :, tot : size - n] = total, np.eye(size - tot - n)

    q = hardware.n_measurements
    B = np.zeros((size, p + n + q))
    B[:p, :p] = np.diag([m.driving_rms_nm for m in ar2])
    B[tur : tur + n, p : p + n] = np.diag([m.driving_rms_nm for m in parts.turbulence])
    C = np.zeros((q, size))
    C[:, size - n :] = hardware.sensor
    late = held_frames(hardware) + 1 - hardware.delay_frames  # weight of the frame before
    return TipTiltPlant(
        A=A,
        B=B,
        C=C,
        D=np.hstack([np.zeros((q, p + n)), parts.noise_factor]),
        L=(1 - late) * total + late * np.eye(n, size, k=tot),
        dt_s=hardware.dt_s,
        hardware=hardware,
        turbulence=parts.turbulence,
        vibrations=parts.vibrations,
    )


def _companion(coefficients: FloatArray) -> FloatArray:
    """State matrix (k order, k order) of k AR processes with coefficients (k, order)."""
    k, order = coefficients.shape
    A = np.eye(k * order, k=-k)
    A[:k] = np.hstack([np.diag(lag) for lag in coefficients.T])
    return A


def retuned_plant(
    plant: TipTiltPlant, shift_hz: float | Sequence[float], *, hold: str = "rms"
) -> TipTiltPlant:
    """Return a plant whose model has every vibration at another frequency, by shifts [Hz].

    One shift is for all vibrations, several are for one each. ``hold`` says what stays: the "rms"
    of each vibration, or that of its "driving" noise. A shifted frequency that leaves (0, Nyquist),
    or a plant without a vibration, raises a ProblemError.
    """
    shifts = np.broadcast_to(one_or_each(shift_hz, "shift_hz"), (len(plant.vibrations),))
    rate = plant.hardware.frame_rate_hz
    return with_vibrations(
        plant,
        [
            line.retuned(line.frequency_hz + float(shift), frame_rate_hz=rate, hold=hold)
            for line, shift in zip(plant.vibrations, shifts, strict=True)
        ],
    )


def with_vibrations(plant: TipTiltPlant, vibrations: Sequence[Vibration]) -> TipTiltPlant:
    """Return a plant with other vibrations, all else being the same."""
    return assemble(replace(plant.parts(), vibrations=tuple(vibrations)))
