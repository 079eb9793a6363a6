"""Statistics of a study: each controller, comparisons between them, and sensitivities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError
from lbt_synth.studies.study.controller_samples import (
    ControllerSamples,
    read_column,
    read_controller_samples,
)
from lbt_synth.studies.study.percentiles import (
    Percentile,
    Share,
    mean_and_error,
    percentiles,
    share,
)
from lbt_synth.studies.study.sensitivity import ControllerSensitivity, sensitivities
from lbt_synth.validation import FloatArray, IntArray, integer, number

PERCENTS = (1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0)
LEVELS = (0.3, 0.5, 0.7, 0.8)
DIFFERENCES = (5.0, 25.0, 50.0, 75.0, 95.0)
_EQUAL = 1e-6  # difference of Strehl ratios that is rounding: the accuracy of the evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Two controllers on the samples on which neither failed."""

    first: str
    second: str
    better: Share  # samples with a higher Strehl ratio of the first
    equal: Share  # samples with the same, mostly as both are unstable
    mean: float  # Strehl ratio of the first minus the second
    mean_error: float  # standard error of that mean
    difference: tuple[Percentile, ...]  # of the same difference


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss:
    """What a controller loses against the best one of each sample."""

    best: Share  # samples on which no controller has a higher Strehl ratio
    loss: tuple[Percentile, ...]  # highest Strehl ratio minus this one: 50th, 95th and 99th


@dataclass(frozen=True, slots=True, kw_only=True)
class WorstRow:
    """One controller on one sample."""

    row: int  # of the sample in the study
    stable: bool
    strehl: float  # 0 if unstable
    residual_nm: float  # [nm rms]; inf if unstable
    parameters: dict[str, float]  # of the sample


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControllerStatistics:
    """Statistics of one controller over all samples."""

    controller: str  # its name
    samples: int  # samples on which it was evaluated
    failed: int  # samples on which the evaluation failed; all that follows leaves them out
    # loops that are unstable. Their Strehl ratio counts as 0, their residual as infinite
    unstable: Share
    mean: float  # mean of the Strehl ratio, and its standard error for independent samples
    mean_error: float
    strehl: tuple[Percentile, ...]  # percentiles of the Strehl ratio
    above: dict[float, Share]  # samples whose Strehl ratio is above each level
    residual_nm: tuple[Percentile, ...]  # percentiles of the residual [nm rms]
    parts_nm: dict[str, float]  # median of each part of the residual over the stable loops [nm rms]
    loss: Loss  # loss against the best controller of each sample
    worst: tuple[WorstRow, ...]  # samples on which it does worst


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyStatistics:
    """Statistics of a study."""

    samples: int  # samples in the study so far
    parameters: tuple[str, ...]  # their names
    controllers: tuple[ControllerStatistics, ...]  # each controller by itself
    # each controller against each later one, on the same samples
    comparisons: tuple[Comparison, ...]
    sensitivities: tuple[ControllerSensitivity, ...]  # what each controller depends on


def study_statistics(
    columns: Mapping[str, ArrayLike],
    parameters: Sequence[str],
    controllers: Sequence[str],
    *,
    levels: Sequence[float] = LEVELS,
    worst: int = 10,
) -> StudyStatistics:
    """Compute the statistics of a study's results.

    Parameters
    ----------
    columns : mapping of str to (n,) array_like
        Results: each parameter under its name and, for each controller, ``NAME.strehl`` (nan
        where unstable or failed), ``NAME.residual_nm`` and ``NAME.stable`` (1, 0; nan where the
        evaluation failed); ``NAME.turbulence_nm``, ``NAME.vibration_nm``, ``NAME.noise_nm`` and
        ``row`` (number of the sample) are optional.
    parameters : sequence of str
        Names of the parameters.
    controllers : sequence of str
        Names of the controllers.
    levels : sequence of float, optional
        Strehl ratios in [0, 1]: the samples above each are counted.
    worst : int, optional
        Worst samples to list for each controller.

    Returns
    -------
    StudyStatistics
        An unstable loop counts as a Strehl ratio of 0; failed evaluations are left out and
        counted.

    Raises
    ------
    ProblemError
        If a column is missing or holds impossible values, or a value is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> gain = np.linspace(0.5, 1.5, 201)
    >>> stable = (gain < 1.4).astype(float)
    >>> columns = {
    ...     "gain": gain,
    ...     "a.stable": stable,
    ...     "a.residual_nm": 100 / gain,
    ...     "a.strehl": np.where(stable, 0.6 * gain, np.nan),
    ... }
    >>> found = lbt.studies.study_statistics(columns, ["gain"], ["a"])
    >>> only = found.controllers[0]
    >>> only.samples, only.unstable.count, round(only.strehl[3].value, 3)
    (201, 21, 0.537)
    >>> only.worst[0].row, only.worst[0].stable
    (180, False)
    """
    for names, what in ((parameters, "parameters"), (controllers, "controllers")):
        if isinstance(names, str) or len(set(names)) != len(names):
            raise ProblemError(f"{what} must be a list of different names; got {names!r}.")
    if not controllers:
        raise ProblemError("controllers must name one at least; got none.")
    levels = [number(level, "levels", at_least=0, at_most=1) for level in levels]
    worst = integer(worst, "worst", at_least=0)
    size = len(read_column(columns, f"{controllers[0]}.stable"))
    if not size:
        raise ProblemError("the results must have at least one sample; got none.")
    found = [read_controller_samples(columns, name, size) for name in controllers]
    values = {name: read_column(columns, name, size, finite=True) for name in parameters}
    rows = np.arange(size)
    if "row" in columns:
        rows = read_column(columns, "row", size, finite=True).astype(np.int64)
    return StudyStatistics(
        samples=size,
        parameters=tuple(parameters),
        controllers=tuple(
            _controller_statistics(each, loss, levels, _worst_rows(each, rows, values, count=worst))
            for each, loss in zip(found, _losses(found), strict=True)
        ),
        comparisons=tuple(_compare(first, second) for first, second in combinations(found, 2)),
        sensitivities=sensitivities(found, values),
    )


def _controller_statistics(
    each: ControllerSamples, loss: Loss, levels: Sequence[float], worst: tuple[WorstRow, ...]
) -> ControllerStatistics:
    """Return the statistics of one controller."""
    strehl = each.strehl[each.evaluated]
    n = len(strehl)
    mean, error = mean_and_error(strehl)
    stable = each.stable
    return ControllerStatistics(
        controller=each.controller,
        samples=n,
        failed=len(each.strehl) - n,
        unstable=share(each.unstable[each.evaluated]),
        mean=mean,
        mean_error=error,
        strehl=percentiles(strehl, PERCENTS),
        above={level: share(strehl > level) for level in levels},
        residual_nm=percentiles(each.residual_nm[each.evaluated], PERCENTS),
        parts_nm={
            part: float(np.median(values[stable])) if stable.any() else np.nan
            for part, values in each.parts_nm.items()
        },
        loss=loss,
        worst=worst,
    )


def _worst_rows(
    controller: ControllerSamples,
    rows: IntArray,
    parameters: Mapping[str, FloatArray],
    *,
    count: int,
) -> tuple[WorstRow, ...]:
    """Return the samples of least Strehl ratio, the unstable ones first; arrays are (n,)."""
    indices = np.flatnonzero(controller.evaluated)
    key = np.where(controller.unstable, -1.0, controller.strehl)[indices]
    if 0 < count < len(indices):  # sort no more than those up to the last one wanted
        least = key <= np.partition(key, count - 1)[count - 1]
        indices, key = indices[least], key[least]
    order = np.lexsort((rows[indices], key))[:count]
    return tuple(
        WorstRow(
            row=int(rows[i]),
            stable=not controller.unstable[i],
            strehl=float(controller.strehl[i]),
            residual_nm=float(controller.residual_nm[i]),
            parameters={name: float(values[i]) for name, values in parameters.items()},
        )
        for i in indices[order]
    )


def _compare(first: ControllerSamples, second: ControllerSamples) -> Comparison:
    """Compare two controllers sample by sample."""
    both = first.evaluated & second.evaluated
    difference = first.strehl[both] - second.strehl[both]
    mean, error = mean_and_error(difference)
    return Comparison(
        first=first.controller,
        second=second.controller,
        better=share(difference > _EQUAL),
        equal=share(np.abs(difference) <= _EQUAL),
        mean=mean,
        mean_error=error,
        difference=percentiles(difference, DIFFERENCES),
    )


def sample_losses(controllers: Sequence[ControllerSamples]) -> tuple[FloatArray, ...]:
    """Return for each controller the best Strehl ratio minus its own, on every sample (m,)."""
    whole = np.logical_and.reduce([each.evaluated for each in controllers])
    best = np.max([each.strehl[whole] for each in controllers], axis=0)
    return tuple(best - each.strehl[whole] for each in controllers)


def _losses(controllers: Sequence[ControllerSamples]) -> tuple[Loss, ...]:
    """Return the loss of each controller against the best one of each sample."""
    return tuple(
        Loss(best=share(loss <= _EQUAL), loss=percentiles(loss, (50.0, 95.0, 99.0)))
        for loss in sample_losses(controllers)
    )
