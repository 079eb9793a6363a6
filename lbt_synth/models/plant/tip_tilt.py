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
from typing import ClassVar, cast

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, EstimationProblem
from lbt_synth.linear.estimation_problem import LONGEST_HORIZON
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.mirror.position_loop import PositionLoop
from lbt_synth.models.plant.assembly import PlantParts, known_states, plant_matrices
from lbt_synth.models.sensor_suite import Motions, SensorSuite, noise_factor
from lbt_synth.models.spectra import ARModel, spectrum_groups
from lbt_synth.models.truth import Entering
from lbt_synth.models.vibration import Vibration, spread_lines
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, integer, one_or_each, require_instance, sequence


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FullForm:
    """The paper's full form of a plant: with the mirror's states, past commands if it settles.

    ``x(k+1) = A x(k) + B_known u(k-1) + B w(k)``, ``y(k) = C x(k) + D_known u(k-1) + D w(k)``;
    ``L`` is the paper's F. Where sensors have a longer period, all but D and L are stacks of a
    matrix for each phase.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    L: FloatArray
    B_known: FloatArray
    D_known: FloatArray  # zero from a delay of two frames up
    dt_s: float

    @property
    def n_states(self) -> int:
        """Number of states n."""
        return int(self.L.shape[1])

    def controller(self, gain_predictor: FloatArray, to_command: FloatArray) -> Controller:
        """Return the controller ``u(k) = to_command x_hat(k+1 | k)``, in new-state form.

        The past command u(k-1) is ``to_command x_hat(k | k-1)`` and needs no state of its own. The
        known input has no error, so that the gain is over the reduced state, (r, q).
        """
        past = self.n_states - gain_predictor.shape[-2]
        gain = np.pad(gain_predictor, [(0, 0)] * (gain_predictor.ndim - 2) + [(0, past), (0, 0)])
        applied = self.B_known - gain @ self.D_known
        A = self.A - gain @ self.C + applied @ to_command
        D = np.zeros((len(to_command), gain.shape[-1]))
        return Controller(A=A, B=gain, C=to_command, D=D, dt_s=self.dt_s, applied=applied)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TipTiltPlant(EstimationProblem):
    """Turbulence, vibrations, delay and noise as an estimation problem (reduced form).

    Made by :func:`tip_tilt_plant`. The measurement of this problem is
    ``ybar(k) = y(k) + sensor_matrix N u(k-d)``, without the known input; that of each sensor, where
    the loop has several. Its period is that of all sensors.
    """

    hardware: LoopHardware  # with the sensor gain that the design assumes in its sensor matrix
    turbulence: tuple[ARModel, ...]  # one model per mode
    vibrations: tuple[Vibration, ...]
    motions: Motions = ()  # of each channel that a vibration moves, for each vibration
    memory: int = 0  # states that hold past innovations, of a mixed filter

    def _brief(self) -> str:
        counts = [(self.n_states, "state"), (len(self.vibrations), "vibration")]
        if self.hardware.suite.sensors:
            counts.append((len(self.hardware.suite.units), "sensor"))
        return ", ".join([self.hardware._brief(), *(count_text(*count) for count in counts)])

    def full(self) -> FullForm:
        """Return the same plant with the mirror's states, which are past commands if it settles."""
        A_known, B_known, C_known, D_known = known_states(self.hardware)
        (A, B, C, _), n, past = self.stacks(), self.n_states, A_known.shape[-1]
        A_full = np.zeros((self.period, n + past, n + past))
        A_full[:, :n, :n], A_full[:, n:, n:] = A, A_known
        entry = np.concatenate([np.zeros((self.period, n, B_known.shape[-1])), B_known], axis=1)
        stacks = {
            "A": A_full,
            "B": np.concatenate([B, np.zeros((self.period, past, B.shape[-1]))], axis=1),
            "C": np.concatenate([C, C_known], axis=2),
            "B_known": entry,  # u(k-1) is the input
            "D_known": D_known,
        }
        return FullForm(
            **{name: stack[0] if self.period == 1 else stack for name, stack in stacks.items()},
            D=self.D,
            L=np.hstack([self.L, np.zeros((len(self.L), past))]),
            dt_s=self.dt_s,
        )

    def controller(self, gain_predictor: FloatArray) -> Controller:
        """Return the controller from y(k) to u(k), the known input included, in new-state form.

        Its states are those of the reduced estimator, to which the gain (n, q) belongs, and the
        mirror's; ``u(k) = N^+ L x_hat(k+1 | k)``.
        """
        full = self.full()
        return full.controller(self.checked_gain(gain_predictor), self.hardware.projector @ full.L)

    def ahead(self, frames: int) -> TipTiltPlant:
        """Plant of the estimate of ``z(k + frames)`` from y up to k: a loop of another delay.

        A prediction that reaches one frame further serves a loop that is one frame later, so the
        plant returned has a delay of ``delay_frames + frames - 1``. A delay below one frame, or
        ``frames`` that are no integer, raise a ProblemError.
        """
        steps = integer(frames, "frames", at_least=-LONGEST_HORIZON)
        if steps == 1:
            return self
        hw = self.hardware
        delay = hw.delay_frames + steps - 1
        if not 1 <= delay <= LONGEST_HORIZON:
            raise ProblemError(
                f"frames must leave the loop a delay of 1 to {LONGEST_HORIZON} frames; got "
                f"{steps}, which makes {delay:g}.",
                in_python="For an estimate without a loop, make an EstimationProblem of the "
                "plant's matrices.",
            )
        later = replace(hw, delay_frames=delay, suite=hw.suite.later(steps - 1, hw))
        return assemble(replace(self.parts(), hardware=later))

    def parts(self) -> PlantParts:
        """Return what the plant was assembled from.

        A plant that holds the memory of a mixed filter raises a ProblemError.
        """
        if self.memory:
            raise ProblemError(
                "this plant holds the memory of a mixed filter, and cannot be assembled again; "
                "take the plant that the filter was designed for."
            )
        return PlantParts(
            hardware=self.hardware,
            turbulence=self.turbulence,
            vibrations=self.vibrations,
            noise_factor=self.own_noise_factor,
            motions=self.motions,
        )

    @property
    def own_noise_factor(self) -> FloatArray:
        """Square root of the noise covariance of the loop's own sensor, (q, q)."""
        q, D = self.hardware.n_measurements, self.stacks()[3][0]
        first = D.shape[1] - self.hardware.n_readings
        return np.asarray(D[:q, first : first + q])

    is_of_means: ClassVar[bool] = True  # whether the rms of a resonance is of means over frames

    def entering(self, hardware: LoopHardware, *, sensor_gain: float) -> Entering:
        """Return what enters any loop where the plant's model is the truth; see :class:`Truth`."""
        return spectrum_groups(self.turbulence), self.vibrations, self.own_noise_factor

    def with_memory(self, taps: FloatArray) -> TipTiltPlant:
        """Add the past innovations of a filter as states; see :class:`EstimationProblem`."""
        longer = cast("TipTiltPlant", EstimationProblem.with_memory(self, taps))
        return replace(longer, memory=longer.n_states - self.n_states + self.memory)

    def require_own_sensor(self, what: str) -> None:
        """Refuse a loop with other sensors beside its own, for what reads that alone."""
        if self.hardware.suite.sensors:
            others = ", ".join(self.hardware.suite.units[1:])
            raise ProblemError(
                f"{what} reads the loop's own sensor alone; got a plant that {others} see, too. "
                "Take plant.own_sensor_alone(); kalman, hinf and mixed read all."
            )

    def own_sensor_alone(self) -> TipTiltPlant:
        """Return the plant of the loop's own sensor, without the others."""
        if not self.hardware.suite.sensors:
            return self
        alone = replace(self.parts(), hardware=self.hardware.own_sensor_alone(), motions=())
        return assemble(alone)

    def with_sensors(self, suite: SensorSuite, motions: Motions = ()) -> TipTiltPlant:
        """Return the plant of the loop with other sensors beside its own, of their common period.

        ``motions`` hold, for each vibration of the plant in order, the :class:`Motion` of each
        channel that it moves; by default no channel moves. A rate that is no fraction of the frame
        rate, a delay that is too short, and names or sizes that clash raise a ProblemError.
        """
        require_instance(suite, SensorSuite, "suite")
        hardware = replace(self.hardware, suite=suite)
        return assemble(replace(self.parts(), hardware=hardware, motions=motions))


def tip_tilt_plant(
    *,
    frame_rate_hz: float,
    turbulence: ARModel | Sequence[ARModel],
    noise_nm: ArrayLike,
    vibrations: Sequence[Vibration] = (),
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
        Turbulence of each mode, as :func:`ar1_turbulence` makes it; one model serves all modes.
    noise_nm : float, (q,) or (q, q) array_like
        Standard deviation of the measurement noise per frame, one for all measurements or one
        per measurement [nm], or its covariance [nm^2].
    vibrations : sequence of Vibration, optional
        The vibrations; none by default.
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
    models = turbulence if isinstance(turbulence, list | tuple) else (turbulence,)
    if isinstance(turbulence, ARModel):
        models = turbulence.separate()
        if turbulence.coefficients.ndim == 1:
            models *= hardware.modes
    return assemble(
        PlantParts(
            hardware=hardware,
            turbulence=tuple(models),
            vibrations=sequence(vibrations, "vibrations"),
            noise_factor=noise_factor(noise_nm, hardware.n_measurements),
        )
    )


def assemble(parts: PlantParts) -> TipTiltPlant:
    """Assemble a plant from its parts."""
    A, B, C, D, L = plant_matrices(parts)
    return TipTiltPlant(
        A=A,
        B=B,
        C=C,
        D=D,
        L=L,
        read=parts.hardware.suite.read(parts.hardware),
        dt_s=parts.hardware.dt_s,
        hardware=parts.hardware,
        turbulence=parts.turbulence,
        vibrations=parts.vibrations,
        motions=parts.motions,
    )


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


def spread_plant(plant: TipTiltPlant, *, half_width_hz: float, lines: int = 5) -> TipTiltPlant:
    """Return a plant whose vibrations have a distribution of frequencies.

    Each vibration becomes several of the same direction, decay rate and rms. Their sum has the mean
    spectrum of the plants with one of these frequencies each, so :func:`kalman` of the result has
    the least variance on average over the distribution.

    Parameters
    ----------
    plant : TipTiltPlant
        The plant.
    half_width_hz : float
        The frequencies are the mid-points of equal parts of [f - h, f + h], for each f [Hz].
    lines : int, optional
        Number of parts, at most 64.

    Returns
    -------
    TipTiltPlant
        The plant, with as many vibrations for each one.

    Raises
    ------
    ProblemError
        If there is no vibration, or a frequency leaves (0, Nyquist).

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6)
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5
    ... )
    >>> spread = lbt.models.spread_plant(plant, half_width_hz=1.0, lines=4)
    >>> [line.frequency_hz for line in spread.vibrations]
    [19.25, 19.75, 20.25, 20.75]
    """
    parts = plant.parts()  # refuses the memory of a mixed filter
    if not plant.vibrations:
        raise ProblemError(
            "a frequency prior needs a plant with a vibration; got one without any. Try "
            "tip_tilt_plant(..., vibrations=[Vibration(...)])."
        )
    shares = [spread_lines(line, half_width_hz, lines) for line in plant.vibrations]
    spread = tuple(line for share in shares for line in share)
    motions = tuple(motion for motion in plant.motions for _ in range(lines))
    return assemble(replace(parts, vibrations=spread, motions=motions))


def mean_plant(plants: Sequence[TipTiltPlant], weights: Sequence[float]) -> TipTiltPlant:
    """Return the plant whose spectra are the weighted means of those of plants of one loop.

    Lines that overlap become one of their power, and the turbulence has the shape of that plant
    whose driving noise weighs most. The sensor gain is the geometric mean.
    """
    shares, hardware = np.array(weights) / np.sum(weights), plants[0].hardware
    gains = np.array([np.diag(plant.hardware.sensor) for plant in plants])
    gain = np.exp(np.mean(np.log(gains), axis=0))
    noises = [p.R * np.outer(gain / own, gain / own) for p, own in zip(plants, gains, strict=True)]
    air = []
    for models in zip(*(plant.turbulence for plant in plants), strict=True):
        powers = shares * [model.driving_rms_nm**2 for model in models]
        strongest = models[int(np.argmax(powers))]
        air.append(replace(strongest, driving_rms_nm=float(np.sqrt(np.sum(powers)))))
    lines = [
        replace(line, rms_nm=float(np.sqrt(share)) * line.rms_nm)
        for share, plant in zip(shares, plants, strict=True)
        for line in plant.vibrations
    ]
    return assemble(
        PlantParts(
            hardware=replace(hardware, sensor_matrix=np.diag(gain)),
            turbulence=tuple(air),
            vibrations=tuple(_merge(lines)),
            noise_factor=np.linalg.cholesky(np.tensordot(shares, noises, 1)),
        )
    )


def _merge(lines: Sequence[Vibration]) -> list[Vibration]:
    """Return lines, with one for those of a direction that are nearer than their half widths."""
    merged = list[Vibration]()
    for line in sorted(lines, key=lambda one: (one.direction, one.sections, one.frequency_hz)):
        last = merged[-1] if merged else line
        half_hz, wider_hz = sorted(one.damping * one.frequency_hz for one in (last, line))
        same = (last.direction, last.sections) == (line.direction, line.sections)
        is_near = line.frequency_hz - last.frequency_hz < half_hz and wider_hz < 2 * half_hz
        if merged and same and is_near:
            weak, strong = sorted((merged.pop(), line), key=lambda one: one.rms_nm)
            rms_nm = float(np.hypot(weak.rms_nm, strong.rms_nm))
            move_hz = (weak.rms_nm / rms_nm) ** 2 * (weak.frequency_hz - strong.frequency_hz)
            line = replace(strong, frequency_hz=strong.frequency_hz + move_hz, rms_nm=rms_nm)
        merged.append(line)
    return merged
