"""Tracking: identify the last seconds of a running loop again, design again, and change over.

The error of an estimator (:func:`~lbt_synth.linear.estimator_form`) does not depend on the
commands. A new filter that runs over the recorded measurements and commands has the state that it
would have if it had always run: no bump.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import FilterDesign, kalman
from lbt_synth.errors import DimensionError, LbtSynthError, ProblemError
from lbt_synth.identification.fit.identify import identify
from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT
from lbt_synth.identification.records.record import FEW, LoopRecord
from lbt_synth.linear import estimator_form
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
        self._hardware = hardware
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
        # measurements, the commands before them, and whether they are spoilt, of the last frames
        self._past: deque[FloatArray] = deque(maxlen=self._window)
        self._frames = 0
        self._command = np.zeros(self._hardware.n_commands)
        self._history: list[TrackingUpdate] = []
        self._take(self._first)

    def step(self, y: ArrayLike) -> FloatArray:
        """Take the measurements y(k), (q,), return the command u(k), (m,); update if it is time.

        Where a measurement is not finite the command is held.
        """
        measured, q = float_array(y, "y"), self._hardware.n_measurements
        if measured.shape != (q,):
            raise DimensionError(f"y must have shape ({q},), one per axis; got {measured.shape}.")
        spoilt = not np.all(np.isfinite(measured))
        if spoilt:  # what the filter expects leaves it without an innovation
            full = _plant_of(self._design).full()
            measured = full.C @ self._filter.state + full.D_known @ self._command
        self._past.append(np.concatenate([measured, self._command, [spoilt]]))
        command = self._filter.step(measured, self._command)
        if not spoilt:
            self._command = command
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
        hw, q = self._hardware, self._hardware.n_measurements
        y, before, spoilt = np.split(np.array(self._past), [q, -1], axis=1)
        if (share := float(np.mean(spoilt))) > FEW:
            raise ProblemError(
                f"at most {100 * FEW:g} % of a window's measurements may be missing; got "
                f"{100 * share:.3g} %. The next window may have fewer."
            )
        every = np.ones(len(y), dtype=np.bool_)
        record = LoopRecord(
            frame_rate_hz=hw.frame_rate_hz,
            measurements=y,
            commands=np.vstack([before[1:], self._command]) @ hw.influence.T,
            delay_frames=hw.delay_frames,
            mirror=hw.mirror,
            measured=every,
            commanded=every,
        )
        gains = np.diag(hw.sensor).tolist()
        model = identify(record, sensor_gain=gains, most_lines=self._most_lines)
        return replace(model.plant(), hardware=hw)

    def _change_over(self, design: FilterDesign) -> None:
        """Let another filter run from the next frame on, as if it had always run."""
        if not close_loop(self._hardware, design.controller).is_stable:
            raise ProblemError("the loop must be stable with the new filter; it is not.")
        self._take(design)
        form, q = self._filter.controller, self._hardware.n_measurements
        measured, commands, _ = np.split(np.array(self._past), [q, -1], axis=1)
        driven = measured @ form.B.T + commands @ form.applied.T
        self._filter.state = series_states(form.A, driven)[-1]

    def _take(self, design: FilterDesign) -> None:
        """Set the filter, with a zero state."""
        _plant_of(design)
        self._design, self._filter = design, estimator_form(design).start()


def _plant_of(design: object) -> TipTiltPlant:
    """Return the plant of a filter; refuse a design that is none, or of another problem."""
    if isinstance(design, FilterDesign) and isinstance(design.problem, TipTiltPlant):
        return design.problem
    raise ProblemError(
        "only filters of a TipTiltPlant can take over in a running loop (kalman, hinf, mixed, "
        f"central); got {getattr(design, 'method', type(design).__name__)!r}. Their estimate does "
        "not depend on the commands."
    )
