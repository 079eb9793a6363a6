"""Forward chaining: train on the past of a record, score on what follows, several times.

The usable frames after the first half are divided into as many tests as there are splits. What is
tested on one of them is trained on everything before it, sensor gain and noise included, so that
all that compete on a split see the same pseudo-open-loop series and the same frames.

Residuals of several controllers on the same frames, and errors of their differences.

The standard error of a mean of correlated values is that of a circular block bootstrap: blocks of
b neighbours, drawn with replacement from the series closed to a circle (D. N. Politis, J. P.
Romano, in R. LePage, L. Billard (eds.), Exploring the Limits of Bootstrap, Wiley (1992), p. 263).
The variance of the mean over all draws is that of the means of all blocks over the number of
blocks in the series: nothing has to be drawn. The length b is a second or, where the
autocorrelation asks for more, that of least error of this variance
(D. N. Politis, H. White, Econometric Reviews 23, 53 (2004), doi:10.1081/ETC-120028836; corrected
by A. Patton, D. N. Politis, H. White, ibid. 28, 372 (2009), doi:10.1080/07474930802459016).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Design
from lbt_synth.errors import DimensionError, LbtSynthError, ProblemError
from lbt_synth.identification.fit.both_axes import identify
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.prediction.residual import replay
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.stretches import Stretches, StretchesLike, checked_stretches
from lbt_synth.linear import Controller
from lbt_synth.linear.held_controller import as_controller
from lbt_synth.loop import close_loop
from lbt_synth.models import LoopHardware
from lbt_synth.validation import (
    FloatArray,
    frozen_copy,
    integer,
    number,
    real_array,
    require_instance,
    set_fields,
)

_LEAST_TEST_S = 1.0
_START_S = 0.5  # after the beginning of a stretch, where a controller has just started
CHUNK_S = 0.05  # mean squares are kept of so long: less than most blocks, more than most periods
_FEWEST = 8  # values that give an error
_FEWEST_BLOCKS = 4  # in a series
_LEAST_BLOCK = round(1.0 / CHUNK_S)  # chunks of a second
_QUIET_LAGS = 5  # insignificant autocorrelations in a row that end it


def forward_splits(
    stretches: StretchesLike | None, frames: int, *, splits: int = 3, first_share: float = 0.5
) -> tuple[tuple[Stretches, Stretches], ...]:
    """Divide a record into pairs of stretches, to train on and later ones to test on.

    Stretches are contiguous usable frames (start, stop), in order; None is the whole record. The
    first pair trains on ``first_share`` of the usable frames, in (0, 1); the rest is divided into
    tests of equal length, which begin where their training ends.
    """
    pairs = checked_stretches(stretches, integer(frames, "frames", at_least=1))
    count = integer(splits, "splits", at_least=1)
    share = number(first_share, "first_share", above=0, below=1)
    usable = sum(stop - start for start, stop in pairs)
    first = int(share * usable)  # as of split_halves
    cuts = first + (usable - first) * np.arange(count + 1) // count
    if cuts[0] < 1 or np.any(np.diff(cuts) < 1):
        raise ProblemError(
            f"a record must leave frames to train on and to test on; got {usable} usable frames "
            f"for {count} splits. Record more, or split less."
        )
    return tuple(
        (_cut(pairs, 0, int(start)), _cut(pairs, int(start), int(stop)))
        for start, stop in pairwise(cuts)
    )


def _cut(stretches: Stretches, first: int, last: int) -> Stretches:
    """Return the usable frames from one count of them to another."""
    out, before = [], 0
    for start, stop in stretches:
        low, high = max(first - before, 0), min(last - before, stop - start)
        if low < high:
            out.append((start + low, start + high))
        before += stop - start
    return tuple(out)


def record_splits(
    record: LoopRecord, splits: int, *, first_share: float = 0.5
) -> tuple[tuple[Stretches, Stretches], ...]:
    """Return the :func:`forward_splits` of a record; refuse tests of less than a second."""
    require_instance(record, LoopRecord)
    pairs = forward_splits(
        record.stretches(), record.frames, splits=splits, first_share=first_share
    )
    least = round(_LEAST_TEST_S * record.frame_rate_hz)
    shortest = min(sum(stop - start for start, stop in test) for _, test in pairs)
    if shortest < least:
        raise ProblemError(
            f"each test needs {least} usable frames ({_LEAST_TEST_S:g} s); with {splits} splits "
            f"the shortest has {shortest}. Record more, or split less."
        )
    return pairs


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ForwardSplit:
    """One split of a record: its past, with the model that it gives, and the frames after it.

    Attributes
    ----------
    record : LoopRecord
        The record.
    training, test : tuple of (start, stop)
        Frames to learn from; frames that count, all of them later.
    replayed : tuple of (start, stop)
        For each stretch of the test, the frames that a replay runs over: from where the usable
        frames before it begin.
    model : IdentifiedModel
        Identified from the training.
    open_loop : (frames, axes) ndarray
        The pseudo-open-loop series z(k) with the sensor gains of the model [nm].
    options : mapping
        Options of :func:`identify` that the model was identified with.
    """

    record: LoopRecord
    training: Stretches
    test: Stretches
    replayed: Stretches
    model: IdentifiedModel
    open_loop: FloatArray
    options: Mapping[str, Any]

    @property
    def hardware(self) -> LoopHardware:
        """The loop, with the sensor gains of the model."""
        return self.model.hardware

    @property
    def past(self) -> LoopRecord:
        """The record as it was when the training ended."""
        stop, record = self.training[-1][1], self.record
        names = ("measurements", "commands", "usable", "measured", "commanded")
        series = {name: getattr(record, name) for name in names}
        return replace(
            record, **{name: given[:stop] for name, given in series.items() if given is not None}
        )

    @property
    def noise_nm2(self) -> float:
        """Variance of the noise in the series, summed over the axes [nm^2]."""
        return sum((axis.noise_nm / axis.sensor_gain) ** 2 for axis in self.model.axes)

    def measured(self) -> FloatArray:
        """Return the residual that the loop measured in the test, (frames, axes) [nm]."""
        residual = self.record.measurements / np.array(self.model.sensor_gains)
        return np.concatenate([residual[start:stop] for start, stop in self.test])

    def replay(self, controller: Controller) -> FloatArray:
        """Return the measured residual of a controller in the test, (frames, axes) [nm].

        The controller, from y(k) to u(k), runs from the equilibrium for the first of the usable
        frames before the test. UnstableLoopError refuses one whose loop is unstable.
        """
        loop = close_loop(self.hardware, controller)
        loop.require_stable()
        run = replay(loop, self.open_loop, self.replayed, from_rest=False)
        return np.concatenate([run.residual[start:stop] for start, stop in self.test])


def forward_split(
    record: LoopRecord,
    training: Stretches,
    test: Stretches,
    *,
    model: IdentifiedModel | None = None,
    **options: Any,
) -> ForwardSplit:
    """Identify the past of a split, and find the frames of its test that count.

    Training and test are a pair of :func:`forward_splits`; the model is that of the training, if it
    is known. The first half second of each stretch does not count, where a controller has just
    started.
    """
    require_instance(record, LoopRecord)
    settle = round(_START_S * record.frame_rate_hz)
    kept, replayed = [], []
    for start, stop in test:
        first = max((a for a, _ in record.stretches() if a <= start), default=start)
        begin = max(start, first + settle)
        if begin < stop:
            kept.append((begin, stop))
            replayed.append((first, stop))
    if not kept:
        raise ProblemError(
            f"a test needs a stretch of more than {settle} frames ({_START_S:g} s); got "
            f"{max(stop - start for start, stop in test)}. Record more, or split less."
        )
    if model is None:
        model = identify(record, stretches=training, **options)
    return ForwardSplit(
        record=record,
        training=training,
        test=tuple(kept),
        replayed=tuple(replayed),
        model=model,
        open_loop=record.pseudo_open_loop(model.sensor_gains),
        options=options,
    )


def forward_chain(
    record: LoopRecord,
    designs: Mapping[str, Callable[[ForwardSplit], Controller | Design]],
    *,
    splits: int = 3,
    first_share: float = 0.5,
    progress: Callable[[int], None] | None = None,
    **options: Any,
) -> PairedResiduals:
    """Design controllers from the past of a record, and compare them on what followed.

    Parameters
    ----------
    record : LoopRecord
        The record; its delay must be known.
    designs : mapping of str to callable
        From a :class:`ForwardSplit`, of which they may use the training, to a controller. One that
        fails on a split, or whose loop is unstable, is left out.
    splits : int, optional
        Pairs of training and test.
    first_share : float, optional
        Part of the usable frames that the first pair trains on, in (0, 1); tests share the rest.
    progress : callable, optional
        Called with 1 after each split.
    **options
        Those of :func:`identify`.

    Returns
    -------
    PairedResiduals
        What they leave of all tests, one after the other, and why others are not among them.

    Raises
    ------
    ProblemError
        If a value is out of range, frames are too few, or no design is left.
    NumericalError
        If a fit fails.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=500)
    >>> line = lbt.Vibration(frequency_hz=40, damping=0.005, rms_nm=50)
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(line,), noise_nm=5.0)
    >>> path = lbt.LoopHardware(frame_rate_hz=500)
    >>> ran = lbt.integrator(path, gain=0.3)
    >>> run = lbt.simulate(ran.controller, truth, hardware=path, frames=20_000)
    >>> record = lbt.identification.loop_record(
    ...     run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ... )
    >>> chain = lbt.identification.forward_chain(
    ...     record, {"ran": lambda _: ran, "filter": lambda split: lbt.kalman(split.model.plant())}
    ... )
    >>> difference, error = chain.above("ran", chain.best)
    >>> chain.best, bool(difference > 2 * error)
    ('filter', True)
    """
    pairs = record_splits(record, splits, first_share=first_share)
    found = (forward_split(record, training, test, **options) for training, test in pairs)
    return compare_on_splits(found, designs, progress=progress)


def compare_on_splits(
    splits: Iterable[ForwardSplit],
    designs: Mapping[str, Callable[[ForwardSplit], Controller | Design]],
    *,
    progress: Callable[[int], None] | None = None,
) -> PairedResiduals:
    """Compare designs as :func:`forward_chain` does, on splits that are already identified."""
    squares: dict[str, list[FloatArray]] = {name: [] for name in designs}
    failures: dict[str, str] = {}
    noise: list[tuple[float, int]] = []
    for split in splits:
        for name, build in designs.items():
            if name in failures:
                continue
            try:
                made = build(split)
                measured = split.replay(as_controller(made))
            except LbtSynthError as error:
                failures[name] = str(error)
                continue
            squares[name].append(chunk_squares(measured, split.hardware.frame_rate_hz))
        noise.append((split.noise_nm2, sum(stop - start for start, stop in split.test)))
        if progress is not None:
            progress(1)
    left = {name: np.concatenate(squares[name]) for name in designs if name not in failures}
    if not left:
        reasons = "; ".join(f"{name}: {why}" for name, why in failures.items())
        raise ProblemError(f"no design can be compared on this record: {reasons or 'none given.'}")
    values, frames = zip(*noise, strict=True)
    noise_nm2 = float(np.average(values, weights=frames))
    return PairedResiduals(squares_nm2=left, noise_nm2=noise_nm2, failures=failures)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairedResiduals:
    """What several controllers leave of the same frames, in chunks of equal length.

    Parameters
    ----------
    squares_nm2 : mapping of str to (chunks,) array_like
        Mean square of the measured residual, noise included, summed over the axes, of each chunk
        of frames, in order [nm^2]; by name of the controller.
    noise_nm2 : float, optional
        Mean variance of the noise in them, summed over the axes [nm^2].
    failures : mapping of str to str, optional
        Why other controllers could not be compared, by name.

    Raises
    ------
    DimensionError
        If the controllers have different chunks.
    ProblemError
        If there is no controller, or there are fewer than 8 chunks.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> common = np.random.default_rng(0).standard_normal(200) ** 2
    >>> pair = lbt.identification.PairedResiduals(
    ...     squares_nm2={"old": 100 + 50 * common, "new": 90 + 50 * common}, noise_nm2=20
    ... )
    >>> difference, error = pair.above("old", "new")
    >>> bool(abs(difference - 10) < 1e-9), bool(error < 1e-9), pair.best
    (True, True, 'new')
    """

    squares_nm2: Mapping[str, FloatArray]
    noise_nm2: float = 0.0
    failures: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        given = {
            name: frozen_copy(real_array(series, f"squares_nm2 of {name}"))
            for name, series in self.squares_nm2.items()
        }
        if not given:
            raise ProblemError("a comparison needs at least one controller; got none.")
        shapes = {series.shape for series in given.values()}
        if len(shapes) > 1 or len(next(iter(shapes))) != 1:
            raise DimensionError(
                f"all controllers must have the same chunks of frames; got {sorted(shapes)}."
            )
        if next(iter(shapes))[0] < _FEWEST:
            raise ProblemError(
                f"a comparison needs at least {_FEWEST} chunks of frames; got {shapes.pop()[0]}. "
                "Record more, or split less."
            )
        set_fields(self, squares_nm2=given, noise_nm2=number(self.noise_nm2, "noise_nm2"))

    @property
    def names(self) -> tuple[str, ...]:
        """The controllers, from the least measured residual to the largest."""
        return tuple(sorted(self.squares_nm2, key=self.measured_nm2))

    @property
    def best(self) -> str:
        """The controller of least measured residual."""
        return self.names[0]

    def measured_nm2(self, name: str) -> float:
        """Return the mean square of a measured residual, noise included [nm^2]."""
        return float(np.mean(self._series(name)))

    def residual_nm2(self, name: str) -> float:
        """Return the variance of a residual without noise [nm^2]; may be below 0 by its error."""
        return self.measured_nm2(name) - self.noise_nm2

    def above(self, name: str, other: str) -> tuple[float, float]:
        """Return by how much a residual is above another, and its standard error [nm^2].

        On the same frames the noise and most of the disturbance cancel: the error is smaller than
        that of either.
        """
        differences = self._series(name) - self._series(other)
        return float(np.mean(differences)), _error_of_chunks(differences)

    def _series(self, name: str) -> FloatArray:
        if name not in self.squares_nm2:
            raise ProblemError(
                f"the controller must be one of {', '.join(self.squares_nm2)}; got {name!r}."
            )
        return self.squares_nm2[name]


def chunk_squares(measured: FloatArray, frame_rate_hz: float) -> FloatArray:
    """Return the mean squares (chunks,) of a residual (frames, n), summed over the axes.

    Frames at the end that do not fill a chunk are left out.
    """
    frames = max(1, round(CHUNK_S * frame_rate_hz))
    count = len(measured) // frames
    squares = np.sum(measured[: count * frames] ** 2, axis=1)
    return np.asarray(np.mean(squares.reshape(count, frames), axis=1))


def _error_of_chunks(series: FloatArray) -> float:
    """Return the error of the mean of chunks, with blocks of a second at least.

    Lines that beat have autocorrelations too small to be seen at one lag, and too many to matter
    little.
    """
    longest = len(series) // _FEWEST_BLOCKS
    return bootstrap_error(series, min(max(choose_block_length(series), _LEAST_BLOCK), longest))


def bootstrap_error(series: ArrayLike, block: int | None = None) -> float:
    """Return the standard error of a correlated series' mean, by a circular block bootstrap.

    It is that of infinitely many draws, as none are made. The series (n,) has at least 8 values, a
    block at most a quarter of them; by default :func:`choose_block_length`.
    """
    values = real_array(series, "series")
    n = len(values)
    if block is None:
        length = choose_block_length(values)
    else:
        length = integer(block, "block", at_least=1, at_most=n // _FEWEST_BLOCKS)
    sums = np.concatenate([[0.0], np.cumsum(np.concatenate([values, values[: length - 1]]))])
    means = (sums[length:] - sums[:-length]) / length
    # blocks share the mean of the series: one degree of freedom less, as for single values
    return float(np.sqrt(np.mean((means - np.mean(values)) ** 2) / (n / length - 1)))


def choose_block_length(series: ArrayLike) -> int:
    """Return the length of blocks that Politis and White found best for such a series (n,).

    It is at most a quarter of the values, of which there are at least 8.
    """
    values = real_array(series, "series")
    n = len(values)
    if n < _FEWEST:
        raise ProblemError(f"an error needs at least {_FEWEST} values; got {n}.")
    centred = values - np.mean(values)
    most = min(int(np.ceil(np.sqrt(n))) + _QUIET_LAGS, n - 1)
    covariance = np.array([centred[: n - lag] @ centred[lag:] / n for lag in range(most + 1)])
    if covariance[0] <= 0:
        return 1
    quiet = np.abs(covariance[1:] / covariance[0]) < 2 * np.sqrt(np.log10(n) / n)
    rows = np.lib.stride_tricks.sliding_window_view(quiet, min(_QUIET_LAGS, most)).all(axis=1)
    last = int(np.argmax(rows)) if rows.any() else most
    width = max(min(2 * last, most), 1)
    lags = np.arange(1, width + 1)
    flat_top = np.minimum(1.0, 2 * (1 - lags / width)) * covariance[1 : width + 1]
    spectrum = covariance[0] + 2 * np.sum(flat_top)
    slope = 2 * np.sum(lags * flat_top)
    if spectrum <= 0:  # as of a difference: neighbours cancel
        return 1
    length = np.ceil((1.5 * (slope / spectrum) ** 2 * n) ** (1 / 3))
    return int(np.clip(length, 1, n // _FEWEST_BLOCKS))
