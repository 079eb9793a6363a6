"""Filters exchanged in a running loop without a bump.

The error of an estimator does not depend on the commands (:attr:`FilterDesign.estimator`): its
input is the pseudo-open-loop series ``ybar(k) = y(k) + sensor_matrix c(k)``. A new filter that
runs over the recorded ``ybar`` has the state that it would have if it had always run. The
correction c(k) follows from the commands that were given and the states of the mirror.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import FilterDesign
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear.block_filtering import last_state
from lbt_synth.models import LoopHardware, TipTiltPlant
from lbt_synth.validation import BoolArray, FloatArray, IntArray, float_array, number


@dataclass(frozen=True, slots=True, kw_only=True)
class SwitchReport:
    """How a filter was taken into a running loop.

    Attributes
    ----------
    copied : bool
        Whether the filter is the one that ran, and kept its state as it was.
    frames : int
        Recorded frames that the new filter was run over.
    left : float
        What is left of its unknown initial state: the spectral radius of its error to the power
        of ``frames``; 0 if the record reaches back to the reset.
    """

    copied: bool
    frames: int
    left: float


class SwitchedController:
    """A filter in the loop that can be exchanged for another one between two frames.

    A measurement that is not finite is not used: the command is held, the estimate goes on by
    the model alone, and the frame counts as spoilt.

    Parameters
    ----------
    design : FilterDesign
        The filter that begins, of a :class:`TipTiltPlant`.
    memory_s : float, optional
        How much of measurements and corrections is kept [s], at least one frame.

    Raises
    ------
    ProblemError
        If the design is of another kind, or the memory is out of range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1,))
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5, modes=1
    ... )
    >>> running = lbt.identification.SwitchedController(lbt.kalman(plant))
    >>> _ = [running.step([100.0]) for _ in range(50)]
    >>> report = running.switch(lbt.kalman(lbt.models.retuned_plant(plant, 1.0)))
    >>> report.copied, report.frames, report.left
    (False, 50, 0.0)
    """

    def __init__(self, design: FilterDesign, *, memory_s: float = 8.0) -> None:
        self._first, self._hardware = design, plant_of_filter(design).hardware
        frames = number(memory_s, "memory_s", above=0) * self._hardware.frame_rate_hz
        self._memory = int(number(frames, "memory_s in frames", at_least=1, at_most=1e7))
        self._mirror = self._hardware.mirror_system.whole
        self.reset()

    @property
    def design(self) -> FilterDesign:
        """The filter that runs."""
        return self._design

    @property
    def hardware(self) -> LoopHardware:
        """The loop; its sensor matrix is that of the first filter."""
        return self._hardware

    @property
    def frames(self) -> int:
        """Frames since the reset."""
        return self._frames

    @property
    def spoilt(self) -> int:
        """Frames since the reset whose measurement was not finite."""
        return self._spoilt

    def reset(self) -> None:
        """Return to the first filter, with zero states, and forget the record."""
        hw = self._hardware
        self._measurements = np.zeros((self._memory, hw.n_measurements))
        self._corrections = np.zeros((self._memory, hw.modes))
        self._usable = np.ones(self._memory, dtype=bool)
        self._frames = self._spoilt = 0
        self._position = np.zeros((self._mirror.n_states, hw.n_commands))
        self._command = np.zeros(hw.n_commands)
        self._take(self._first)
        self._state = np.zeros(self._plant.A.shape[0])

    def step(self, y: ArrayLike) -> FloatArray:
        """Take the measurements y(k), (q,), and return the command u(k), (m,).

        Parameters
        ----------
        y : (q,) array_like
            Measurements; where one of them is not finite the command is held.

        Returns
        -------
        (m,) ndarray
            The command.

        Raises
        ------
        ProblemError
            If they are no real numbers.
        DimensionError
            If there is another number of measurements.
        """
        F, K, C, S, to_command = self._filter
        measured = float_array(y, "y")
        if measured.shape != (len(S),):
            raise DimensionError(
                f"y must have shape ({len(S)},) to match the sensor matrix {S.shape}; got "
                f"{measured.shape}."
            )
        mirror, row = self._mirror, self._frames % self._memory
        seen = mirror.C @ self._position + mirror.D * self._command
        correction = self._hardware.influence @ seen
        self._position = mirror.A @ self._position + np.outer(mirror.B, self._command)
        known = S @ correction
        usable = bool(np.isfinite(measured).all())
        if not usable:  # what the filter expects leaves it without an innovation
            measured = C @ self._state - known
            self._spoilt += 1
        self._state = F @ self._state + K @ (measured + known)
        if usable:
            self._command = to_command @ self._state
        self._measurements[row], self._corrections[row] = measured, correction
        self._usable[row] = usable
        self._frames += 1
        return self._command.copy()

    def switch(self, design: FilterDesign) -> SwitchReport:
        """Let another filter run from the next frame on, as if it had always run.

        The same filter keeps its state to the last bit. Another one runs over the recorded
        pseudo-open-loop measurements. If ``left`` is small, its commands are those of a filter
        that has run in parallel all the time.

        Parameters
        ----------
        design : FilterDesign
            The filter, for the same loop; its sensor gain may be another.

        Returns
        -------
        SwitchReport
            What was done.

        Raises
        ------
        ProblemError
            If the design is of another kind, or for another loop.
        """
        require_same_loop(plant_of_filter(design), self._hardware)
        old = self._filter
        self._take(design)
        if all(np.array_equal(a, b) for a, b in zip(old, self._filter, strict=True)):
            return SwitchReport(copied=True, frames=0, left=0.0)
        F, K, _, S, _ = self._filter
        measurements, corrections = self.window()
        self._state = last_state(F, (measurements + corrections @ S.T) @ K.T)
        radius = float(np.max(np.abs(np.linalg.eigvals(F))))
        left = 0.0 if self._frames <= self._memory else radius ** len(measurements)
        return SwitchReport(copied=False, frames=len(measurements), left=left)

    def window(self, frames: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Return the last measurements and the corrections inside them, the oldest first.

        Parameters
        ----------
        frames : int, optional
            How many; all that are kept by default, and no more than there are.

        Returns
        -------
        measurements : (frames, q) ndarray
            y(k); in a spoilt frame what the filter expected.
        corrections : (frames, n) ndarray
            c(k) of ``y(k) = sensor_matrix (phi_tot(k-1) - c(k)) + noise(k)`` [nm].
        """
        rows = self._rows(frames)
        return self._measurements[rows], self._corrections[rows]

    def usable(self, frames: int | None = None) -> BoolArray:
        """Return of which of the last frames the measurement was finite, the oldest first.

        Parameters
        ----------
        frames : int, optional
            How many, as in :meth:`window`.

        Returns
        -------
        (frames,) ndarray of bool
            False where :meth:`window` has what the filter expected.
        """
        return np.asarray(self._usable[self._rows(frames)], dtype=np.bool_)

    def spoilt_fraction(self, frames: int | None = None) -> float:
        """Fraction of the last frames whose measurement was not finite.

        Parameters
        ----------
        frames : int, optional
            How many, as in :meth:`window`.

        Returns
        -------
        float
            From 0 to 1.
        """
        usable = self.usable(frames)
        return 1.0 - float(np.mean(usable)) if usable.size else 0.0

    def _rows(self, frames: int | None) -> IntArray:
        there = min(self._frames, self._memory)
        count = there if frames is None else min(frames, there)
        return np.arange(self._frames - count, self._frames, dtype=np.int64) % self._memory

    def _take(self, design: FilterDesign) -> None:
        """Set the filter: its matrices F, K, C, the sensor matrix, and from state to command."""
        self._design, self._plant = design, plant_of_filter(design)
        plant, hw, K = self._plant, self._plant.hardware, design.gain_predictor
        self._filter = plant.A - K @ plant.C, K, plant.C, hw.sensor, hw.projector @ plant.L


def plant_of_filter(design: object) -> TipTiltPlant:
    """Return the plant of a filter; refuse a design that is none, or of another problem."""
    if not isinstance(design, FilterDesign) or not isinstance(design.problem, TipTiltPlant):
        kind = getattr(design, "method", type(design).__name__)
        raise ProblemError(
            "only filters of a TipTiltPlant can be exchanged in a running loop (kalman, hinf, "
            f"mixed, central); got {kind!r}. Their estimate does not depend on the commands."
        )
    return design.problem


def require_same_loop(plant: TipTiltPlant, hardware: LoopHardware) -> None:
    """Refuse a plant of another loop; its sensor gain may differ."""
    theirs = plant.hardware
    if (
        (theirs.frame_rate_hz, theirs.delay_frames)
        != (hardware.frame_rate_hz, hardware.delay_frames)
        or theirs.mirror != hardware.mirror
        or not np.array_equal(theirs.influence, hardware.influence)
        or theirs.sensor.shape != hardware.sensor.shape
    ):
        raise ProblemError(
            f"the filter must be for the running loop ({hardware.frame_rate_hz:g} Hz, "
            f"{hardware.delay_frames:g} frames, {hardware.n_measurements} measurements, the same "
            f"mirror and influence matrix); got one for {theirs.frame_rate_hz:g} Hz, "
            f"{theirs.delay_frames:g} frames and {theirs.n_measurements} measurements."
        )
