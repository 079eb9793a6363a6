"""The tracking controller: it identifies and redesigns its filter while the loop runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import FilterDesign, kalman
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.identification.tracking.evidence import (
    LONGEST_S,
    Evidence,
    find_better,
    prediction_errors,
)
from lbt_synth.identification.tracking.glitches import bridge_frames, find_glitches, stand_alone
from lbt_synth.identification.tracking.identifiers import LoopIdentifier
from lbt_synth.identification.tracking.switching import (
    SwitchedController,
    plant_of_filter,
    require_same_loop,
)
from lbt_synth.identification.tracking.trend import LineTrack, match_tracks
from lbt_synth.loop import close_loop
from lbt_synth.models import TipTiltPlant, Vibration
from lbt_synth.models.plant.tip_tilt import with_vibrations
from lbt_synth.validation import FloatArray, number, require_instance

_MOST_LEFT_OUT = 0.01  # of the frames of a window; with more there is no fit
_LEAST_FRAMES = 16  # in a window
_JUDGE_S = 0.25  # time between two judgements, or less before an update
_NARROW = 0.1  # damping ratio; wider resonances belong to the background and have no trend


@runtime_checkable
class Identifier(Protocol):
    """Anything that makes a plant of a window of closed-loop data, or None where it cannot.

    It may also have a method ``reset()``, which is called when the loop is.
    """

    def __call__(self, measurements: FloatArray, corrections: FloatArray) -> TipTiltPlant | None:
        """Take y(k), (frames, q), and the corrections c(k) in them, (frames, n) [nm]."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingUpdate:
    """What one update found and did.

    Attributes
    ----------
    time_s : float
        Time since the reset of the loop [s]; the window ends here.
    middle_s : float
        Time of the middle of the window [s].
    fitted_hz : tuple of float
        Frequencies in the window [Hz], none if there was no fit.
    frequencies_hz : tuple of float
        Frequencies for which the filter that runs from now on was designed [Hz].
    rms_nm : tuple of float
        Their rms [nm].
    noise_nm : tuple of float
        Standard deviation of the noise that it assumes, one per measurement [nm].
    left_out : int
        Frames of the window that were left out: not finite, or outliers.
    switched : bool
        Whether a new filter was taken.
    reason : str
        Why not; empty if one was.
    identify_s, design_s, switch_s : float
        Time that the three steps took [s].
    """

    time_s: float
    middle_s: float
    fitted_hz: tuple[float, ...]
    frequencies_hz: tuple[float, ...]
    rms_nm: tuple[float, ...]
    noise_nm: tuple[float, ...]
    left_out: int
    switched: bool
    reason: str
    identify_s: float
    design_s: float
    switch_s: float


class _KeepFilterError(Exception):
    """The reason why the running filter is kept."""


@contextmanager
def _keep_filter_if_fails(step: str) -> Iterator[None]:
    """Turn any error of a step into the reason to keep the running filter: the loop goes on."""
    try:
        yield
    except Exception as error:
        reason = f"the {step} failed: {type(error).__name__}: {error}"
        raise _KeepFilterError(reason) from error


class TrackingController(SwitchedController):
    """A controller that identifies and redesigns its filter while it runs.

    Every ``update_s`` seconds it identifies the last ``window_s`` seconds, designs a filter for
    them, and switches to it without a bump (:class:`SwitchedController`). A window shows the
    frequency of its middle, but the filter needs that of the middle of the time to the next
    update: the trend of the last fits is extrapolated as far as it is significant.

    It is guarded: the first filter runs until the newest ones have left clearly less, on frames
    after their windows, and it returns when they leave clearly more (:func:`find_better`). While
    they are better, each new one runs at once.

    No update can stop the loop: if a window has too few good measurements, the fit fails, the
    design does not pass its certificate, or its loop would be unstable at the sensor gain that the
    running filter assumes, the running filter stays, and :attr:`history` says why.
    Frames that are not finite are left out and the command held. Single outliers of the
    pseudo-open-loop series are left out of the fit in the same way, though the mirror has followed
    them.

    Parameters
    ----------
    plant : TipTiltPlant
        The plant of the first filter.
    identifier : Identifier, optional
        :class:`LoopIdentifier` by default, for the whole model; :class:`LineFollower` is quicker.
    window_s : float, optional
        Length of the window [s], at least 16 frames.
    update_s : float, optional
        Time between updates [s], at least a frame.
    extrapolate : bool, optional
        Whether the trend is followed; otherwise the frequencies are those of the window.
    trend_s : float, optional
        Time for which a fit counts for the trend [s]; by default twice the window, but at least
        5 updates.
    design : callable, optional
        From plant to :class:`FilterDesign`; :func:`kalman` by default.
    guarded : bool, optional
        Whether a filter must show that it is better before it runs; otherwise each one runs.

    Raises
    ------
    ProblemError
        If a value is out of its range, or the plant or its design of another kind.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1,))
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5, modes=1
    ... )
    >>> tracker = lbt.identification.TrackingController(
    ...     plant, lbt.identification.LineFollower(plant), window_s=2
    ... )
    >>> shake = lbt.models.DriftingVibration(
    ...     start_hz=20, end_hz=22, duration_s=8, rms_nm=563.6, direction=(1,)
    ... )
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(shake,), noise_nm=15.5)
    >>> run = lbt.simulate(tracker, truth, hardware=plant.hardware, frames=6400)
    >>> [evidence.rival for _, evidence in tracker.exchanges]  # the new filters took over
    [1]
    >>> bool(abs(tracker.history[-1].frequencies_hz[0] - 22) < 0.2)
    True
    """

    def __init__(
        self,
        plant: TipTiltPlant,
        identifier: Identifier | None = None,
        *,
        window_s: float = 4.0,
        update_s: float = 1.0,
        extrapolate: bool = True,
        trend_s: float | None = None,
        design: Callable[[TipTiltPlant], FilterDesign] = kalman,
        guarded: bool = True,
    ) -> None:
        require_instance(plant, TipTiltPlant)
        if identifier is None:
            identifier = LoopIdentifier(plant)
        _require_callable(identifier, "identifier", "(measurements, corrections) -> plant or None")
        _require_callable(design, "design", "plant -> FilterDesign, such as kalman")
        rate = plant.hardware.frame_rate_hz
        self._window_s = number(window_s, "window_s", at_least=_LEAST_FRAMES / rate)
        self._update_s = number(update_s, "update_s", at_least=1 / rate)
        longer = max(2 * self._window_s, 5 * self._update_s)
        self._trend_s = number(longer if trend_s is None else trend_s, "trend_s", at_least=0)
        self._window_frames = round(self._window_s * rate)
        self._update_frames = round(self._update_s * rate)
        self._rate, self._extrapolate = rate, bool(extrapolate)
        self._judge_frames = max(1, round(_JUDGE_S * rate))
        self._identifier, self._design_filter = identifier, design
        self._guarded = bool(guarded)
        super().__init__(design(plant), memory_s=2 * self._window_frames / rate)
        self._to_phase = np.linalg.pinv(self.hardware.sensor).T

    @property
    def history(self) -> tuple[TrackingUpdate, ...]:
        """Every update since the reset."""
        return tuple(self._history)

    @property
    def kept(self) -> int:
        """Updates since the reset at which the running filter was kept."""
        return sum(not update.switched for update in self._history)

    @property
    def exchanges(self) -> tuple[tuple[float, Evidence], ...]:
        """When the newest filters (rival 1) took over or the first (0) did [s], and why."""
        return tuple(self._exchanges)

    def reset(self) -> None:
        """Return to the first filter, and forget everything."""
        super().reset()
        self._newest: FilterDesign | None = None
        self._follows = not self._guarded  # whether the newest filters run
        self._judged, self._losses = 0, np.zeros((2, 0))
        self._exchanges: list[tuple[float, Evidence]] = []
        self._history: list[TrackingUpdate] = []
        self._tracks: list[LineTrack] = []
        reset = getattr(self._identifier, "reset", None)
        if callable(reset):
            reset()

    def step(self, y: ArrayLike) -> FloatArray:
        """Return the command as :meth:`SwitchedController.step` does, and update if it is time."""
        command = super().step(y)
        since_full = self.frames - self._window_frames
        is_due = since_full >= 0 and since_full % self._update_frames == 0
        if self._guarded and (is_due or since_full % self._judge_frames == 0):
            self._judge()
        if is_due:
            self._update(self.frames / self._rate)
        return command

    def _judge(self) -> None:
        """Compare first and newest filter on the frames since the last time, and run the better.

        What the newest filters leave is one series: it judges the tracking, not a single filter.
        """
        if self._newest is None:
            return
        rivals, since = (self._first, self._newest), self.frames - self._judged
        errors = np.array([prediction_errors(each, *self.window())[-since:] for each in rivals])
        losses = np.sum((errors @ self._to_phase) ** 2, axis=2)
        longest = round(LONGEST_S * self._rate)
        self._losses = np.concatenate([self._losses, losses], axis=1)[:, -longest:]
        self._judged = self.frames
        found = find_better(self._losses, int(self._follows), self._rate)
        if found is not None and self._is_stable(rivals[found.rival]):
            self.switch(rivals[found.rival])
            self._follows = bool(found.rival)
            self._losses = self._losses[:, :0]  # frames before a change are no evidence after it
            self._exchanges.append((self.frames / self._rate, found))

    def _update(self, time_s: float) -> None:
        """Identify the last window, switch to the filter designed for it, and record the update."""
        found: TipTiltPlant | None = None
        self._left_out = 0  # set by _clean_window
        reason = ""
        clock = [time.perf_counter()]  # before each step, and after the last
        try:
            found = self._identify_window()
            clock.append(time.perf_counter())
            plant = self._extrapolate_lines(found, time_s)
            with _keep_filter_if_fails("design"):
                designed = self._design_filter(plant)
            self._take_newest(designed)
            clock.append(time.perf_counter())
            self._run_newest()
        except _KeepFilterError as kept:
            reason = str(kept)
        except LbtSynthError as error:
            reason = f"{type(error).__name__}: {error}"
        clock += [time.perf_counter()] * (4 - len(clock))  # steps that were not reached take 0 s
        identify_s, design_s, switch_s = np.diff(clock).tolist()
        update = TrackingUpdate(
            time_s=time_s,
            middle_s=time_s - self._window_s / 2,
            fitted_hz=tuple(line.frequency_hz for line in found.vibrations) if found else (),
            frequencies_hz=tuple(line.frequency_hz for line in self._plant.vibrations),
            rms_nm=tuple(line.rms_nm for line in self._plant.vibrations),
            noise_nm=tuple(np.sqrt(np.diag(self._plant.R)).tolist()),
            left_out=self._left_out,
            switched=not reason,
            reason=reason,
            identify_s=identify_s,
            design_s=design_s,
            switch_s=switch_s,
        )
        self._history.append(update)

    def _is_stable(self, designed: FilterDesign) -> bool:
        """Return whether a filter's loop is stable at the sensor gain of the running one.

        A short window may be explained by a wrong gain. The real one is between updates where it
        was, so that it can still be followed in steps.
        """
        return close_loop(self._plant.hardware, designed.controller).is_stable

    def _take_newest(self, designed: FilterDesign) -> None:
        """Let a filter be the newest one."""
        require_same_loop(plant_of_filter(designed), self.hardware)
        if not self._is_stable(designed):
            raise _KeepFilterError(
                "the new filter's loop is unstable at the sensor gain that the running one assumes"
            )
        if self._newest is None:
            self._judged = self.frames
        self._newest = designed

    def _run_newest(self) -> None:
        """Switch to the newest filter if these run."""
        if self._newest is None or not self._follows:
            raise _KeepFilterError("the newest filters have not left clearly less than the first")
        self.switch(self._newest)

    def _identify_window(self) -> TipTiltPlant:
        """Return the plant of the last window."""
        window = self._clean_window()
        with _keep_filter_if_fails("fit"):
            found = self._identifier(*window)
        if found is None:
            raise _KeepFilterError("the fit found no plant")
        if not isinstance(found, TipTiltPlant):
            raise _KeepFilterError(f"the fit gave a {type(found).__name__}, not a TipTiltPlant")
        require_same_loop(found, self.hardware)
        return found

    def _clean_window(self) -> tuple[FloatArray, FloatArray]:
        """Return measurements and corrections of the last window, with single outliers bridged.

        Too many frames to leave out, or outliers in groups, keep the running filter.
        """
        measurements, corrections = self.window(self._window_frames)
        missing = ~self.usable(self._window_frames)
        seen = corrections @ self._plant.hardware.sensor.T  # with the sensor gain found last
        wrong = find_glitches(measurements + seen)
        self._left_out = int(np.count_nonzero(missing | wrong))
        share = 100 * self._left_out / len(missing)
        what = "not finite or outliers" if wrong.any() else "not finite"
        if share > 100 * _MOST_LEFT_OUT:
            raise _KeepFilterError(f"{share:.3g} % of the window's measurements are {what}")
        if wrong.any():
            if not stand_alone(wrong, self.hardware.delay_frames):
                raise _KeepFilterError(
                    f"{np.count_nonzero(wrong)} of the window's measurements are outliers that "
                    "do not stand alone"
                )
            measurements = bridge_frames(measurements + seen, wrong) - seen
        return measurements, corrections

    def _extrapolate_lines(self, found: TipTiltPlant, time_s: float) -> TipTiltPlant:
        """Return the plant with its lines as expected halfway to the next update."""
        if not self._extrapolate or not found.vibrations:
            return found
        middle_s = time_s - self._window_s / 2
        recent_s, ahead_s = middle_s - self._trend_s, time_s + self._update_s / 2
        tracks = match_tracks(self._tracks, found.vibrations)
        lines = []
        for track, line in zip(tracks, found.vibrations, strict=True):
            track.add(middle_s, line.frequency_hz, since_s=recent_s)
            expected = track.frequency_at(ahead_s, overlap=self._window_s / self._update_s)
            lines.append(_move_line(line, expected, self._rate))
        distinct = dict.fromkeys([*tracks, *self._tracks])
        self._tracks = [track for track in distinct if track.points[-1][0] >= recent_s]
        return with_vibrations(found, lines)


def _require_callable(value: object, name: str, kind: str) -> None:
    if not callable(value):
        raise ProblemError(f"{name} must be a callable {kind}; got {type(value).__name__}.")


def _move_line(line: Vibration, frequency_hz: float, frame_rate_hz: float) -> Vibration:
    """Return a narrow vibration at a frequency that it can have; else the vibration unchanged."""
    possible = line.damping * line.frequency_hz < frequency_hz < frame_rate_hz / 2
    return line.at_frequency(frequency_hz) if possible and line.damping <= _NARROW else line
