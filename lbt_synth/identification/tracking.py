"""Tracking: identify the last seconds of a running loop again, design again, and change over.

The error of an estimator does not depend on the commands (:attr:`FilterDesign.estimator`): its
input is the pseudo-open-loop series ``ybar(k) = y(k) + sensor_matrix c(k)``, whose correction c(k)
follows from the commands that were given and the states of the mirror. A new filter that runs over
the recorded ``ybar`` has the state that it would have if it had always run: no bump.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import FilterDesign, kalman
from lbt_synth.errors import DimensionError, LbtSynthError, ProblemError
from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.fit.identify import axis_periodogram, find_axis
from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT
from lbt_synth.identification.records.record import FEW
from lbt_synth.linear.block_filtering import series_states
from lbt_synth.loop import close_loop
from lbt_synth.models import TipTiltPlant
from lbt_synth.validation import FloatArray, float_array, number, require_instance

_LEAST_FRAMES = 2 * SHORTEST_SEGMENT  # in a window: fewer are no spectrum


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingUpdate:
    """What one update found and did."""

    time_s: float  # since the reset of the loop; the window ends here
    frequencies_hz: tuple[float, ...]  # of the filter that runs from now on
    rms_nm: tuple[float, ...]  # of these lines
    noise_nm: tuple[float, ...]  # standard deviation that the filter assumes, one per measurement
    reason: str  # why the running filter stayed; empty if a new one runs


class TrackingController:
    """A filter in the loop that is identified and designed again while it runs.

    Every ``update_s`` seconds the fit of :func:`identify` finds turbulence, lines and noise of
    each axis in the last ``window_s`` seconds; the sensor gain stays that of the plant. The filter
    for them runs over the record, and takes over between two frames.

    No update can stop the loop: if more than 1 % of the window's frames have no finite measurement,
    the fit fails, the design does not pass its certificate, or its loop would be unstable, the
    running filter stays, and :attr:`history` says why.

    Parameters
    ----------
    plant : TipTiltPlant
        The plant of the first filter, with one measurement per axis.
    window_s : float, optional
        Length of the window [s], at least 512 frames.
    update_s : float, optional
        Time between updates [s], at least a frame.
    design : callable, optional
        From plant to :class:`FilterDesign`; :func:`kalman` by default.

    Raises
    ------
    ProblemError
        If a measurement sees more than its own axis, a time is out of range, or the design is of
        another kind.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10, frame_rate_hz=500)
    >>> line = lbt.Vibration(frequency_hz=40, damping=0.01, rms_nm=100, direction=(1,))
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=500, turbulence=slow, vibrations=[line], noise_nm=15.5, modes=1
    ... )
    >>> moved = lbt.Vibration(frequency_hz=43, damping=0.01, rms_nm=100, direction=(1,))
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(moved,), noise_nm=15.5)
    >>> tracker = lbt.identification.TrackingController(plant)
    >>> run = lbt.simulate(tracker, truth, hardware=plant.hardware, frames=2000)
    >>> any(abs(hz - 43) < 0.5 for hz in tracker.history[-1].frequencies_hz)
    True
    """

    def __init__(
        self,
        plant: TipTiltPlant,
        *,
        window_s: float = 4.0,
        update_s: float = 1.0,
        design: Callable[[TipTiltPlant], FilterDesign] = kalman,
    ) -> None:
        require_instance(plant, TipTiltPlant)
        hardware = plant.hardware
        rate, gains = hardware.frame_rate_hz, np.diag(hardware.sensor)
        if not np.array_equal(hardware.sensor, np.diag(gains)) or np.any(gains <= 0):
            raise ProblemError(
                "each measurement must be of one axis, with a gain above 0; got a sensor matrix "
                f"{hardware.sensor.tolist()}. Recombine the measurements into axes first."
            )
        self._window = round(number(window_s, "window_s", at_least=_LEAST_FRAMES / rate) * rate)
        self._every = round(number(update_s, "update_s", at_least=1 / rate) * rate)
        self._hardware, self._gains = hardware, gains.tolist()
        self._most_lines = 1 + len(plant.vibrations)  # a new one may appear
        self._design_filter, self._first = design, design(plant)
        self.reset()

    @property
    def design(self) -> FilterDesign:
        """The filter that runs."""
        return self._design

    @property
    def history(self) -> tuple[TrackingUpdate, ...]:
        """Every update since the reset."""
        return tuple(self._history)

    def reset(self) -> None:
        """Return to the first filter, with zero states, and forget everything."""
        hw, self._mirror = self._hardware, self._hardware.mirror_system.whole
        # measurements, corrections, and whether they are spoilt, of the last frames
        self._past: deque[FloatArray] = deque(maxlen=self._window)
        self._frames = 0
        self._position = np.zeros((self._mirror.n_states, hw.n_commands))
        self._command = np.zeros(hw.n_commands)
        self._history: list[TrackingUpdate] = []
        self._take(self._first)
        self._state = np.zeros(len(self._filter[0]))

    def step(self, y: ArrayLike) -> FloatArray:
        """Take the measurements y(k), (q,), return the command u(k), (m,); update if it is time.

        Where a measurement is not finite the command is held.
        """
        F, K, C, to_command = self._filter
        S, mirror = self._hardware.sensor, self._mirror
        measured = float_array(y, "y")
        if measured.shape != (len(S),):
            raise DimensionError(
                f"y must have shape ({len(S)},) to match the sensor matrix {S.shape}; got "
                f"{measured.shape}."
            )
        seen = mirror.C @ self._position + mirror.D * self._command
        correction = self._hardware.influence @ seen
        self._position = mirror.A @ self._position + np.outer(mirror.B, self._command)
        spoilt = not np.all(np.isfinite(measured))
        if spoilt:  # what the filter expects leaves it without an innovation
            measured = C @ self._state - S @ correction
        self._state = F @ self._state + K @ (measured + S @ correction)
        if not spoilt:
            self._command = to_command @ self._state
        self._past.append(np.concatenate([measured, correction, [spoilt]]))
        self._frames += 1
        since_full = self._frames - self._window
        if since_full >= 0 and since_full % self._every == 0:
            self._update()
        return self._command.copy()

    def _update(self) -> None:
        """Change over to the filter for the last window, and record the update."""
        reason = ""
        try:
            self._change_over(self._design_filter(self._identify()))
        except (LbtSynthError, np.linalg.LinAlgError) as error:
            reason = f"{type(error).__name__}: {error}"
        plant = _plant_of(self._design)
        update = TrackingUpdate(
            time_s=self._frames / self._hardware.frame_rate_hz,
            frequencies_hz=tuple(line.frequency_hz for line in plant.vibrations),
            rms_nm=tuple(line.rms_nm for line in plant.vibrations),
            noise_nm=tuple(np.sqrt(np.diag(plant.R)).tolist()),
            reason=reason,
        )
        self._history.append(update)

    def _identify(self) -> TipTiltPlant:
        """Return the plant of the last window."""
        hw, window = self._hardware, np.array(self._past)
        share = float(np.mean(window[:, -1]))
        if share > FEW:
            raise ProblemError(
                f"at most {100 * FEW:g} % of a window's measurements may be missing; got "
                f"{100 * share:.3g} %. The next window may have fewer."
            )
        axes = []
        for i, gain in enumerate(self._gains):
            y, c = window[:, i], window[:, hw.n_measurements + i]
            data = axis_periodogram(y, c, hw.frame_rate_hz, None)
            axes.append(find_axis(Search(data=data, gain=gain, most_lines=self._most_lines)))
        model = IdentifiedModel(
            axes=tuple(axes),
            frame_rate_hz=hw.frame_rate_hz,
            delay_frames=hw.delay_frames,
            mirror=hw.mirror,
        )
        return replace(model.plant(), hardware=hw)

    def _change_over(self, design: FilterDesign) -> None:
        """Let another filter run from the next frame on, as if it had always run."""
        if not close_loop(self._hardware, design.controller).is_stable:
            raise ProblemError("the loop must be stable with the new filter; it is not.")
        self._take(design)
        F, K, *_ = self._filter
        measured, corrections, _ = np.split(np.array(self._past), [len(K.T), -1], axis=1)
        drive = (measured + corrections @ self._hardware.sensor.T) @ K.T
        self._state = series_states(F, drive)[-1]

    def _take(self, design: FilterDesign) -> None:
        """Set the filter: its matrices F, K and C, and from state to command."""
        plant, K = _plant_of(design), design.gain_predictor
        self._design = design
        self._filter = plant.A - K @ plant.C, K, plant.C, self._hardware.projector @ plant.L


def _plant_of(design: object) -> TipTiltPlant:
    """Return the plant of a filter; refuse a design that is none, or of another problem."""
    plant: TipTiltPlant | None = getattr(design, "plant", None)
    if plant is None or not hasattr(design, "gain_filter"):
        kind = getattr(design, "method", type(design).__name__)
        raise ProblemError(
            "only filters of a TipTiltPlant can take over in a running loop (kalman, hinf, mixed, "
            f"central); got {kind!r}. Their estimate does not depend on the commands."
        )
    return plant
