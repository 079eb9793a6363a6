"""Comparisons of controllers with each other on the same samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.studies.study.controller_samples import ControllerSamples
from lbt_synth.studies.study.percentiles import Percentile, Share, percentiles, share
from lbt_synth.validation import FloatArray

DIFFERENCES = (5.0, 25.0, 50.0, 75.0, 95.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Two controllers on the samples on which neither failed."""

    first: str
    second: str
    better: Share  # samples with a higher Strehl ratio of the first
    equal: Share  # samples with the same, mostly as both are unstable
    mean: float  # Strehl ratio of the first less the second
    mean_error: float  # standard error of that mean
    difference: tuple[Percentile, ...]  # of the same difference


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss:
    """What a controller loses against the best one of each sample."""

    best: Share  # samples on which no controller has a higher Strehl ratio
    loss: tuple[Percentile, ...]  # highest Strehl ratio less this one: 50th, 95th and 99th


def mean_and_error(values: FloatArray) -> tuple[float, float]:
    """Return the mean and its standard error for independent samples; nan if too few."""
    n = len(values)
    mean = float(np.mean(values)) if n else np.nan
    return mean, float(np.std(values, ddof=1) / np.sqrt(n)) if n > 1 else np.nan


def compare(first: ControllerSamples, second: ControllerSamples) -> Comparison:
    """Compare two controllers sample by sample."""
    both = first.evaluated & second.evaluated
    difference = first.strehl[both] - second.strehl[both]
    mean, error = mean_and_error(difference)
    n = len(difference)
    return Comparison(
        first=first.controller,
        second=second.controller,
        better=share(int(np.count_nonzero(difference > 0)), n),
        equal=share(int(np.count_nonzero(difference == 0)), n),
        mean=mean,
        mean_error=error,
        difference=percentiles(difference, DIFFERENCES),
    )


def sample_losses(controllers: Sequence[ControllerSamples]) -> tuple[FloatArray, ...]:
    """Return for each controller the best Strehl ratio less its own, on every sample (m,)."""
    whole = np.logical_and.reduce([each.evaluated for each in controllers])
    best = np.max([each.strehl[whole] for each in controllers], axis=0)
    return tuple(best - each.strehl[whole] for each in controllers)


def losses(controllers: Sequence[ControllerSamples]) -> tuple[Loss, ...]:
    """Return the loss of each controller against the best one of each sample."""
    return tuple(
        Loss(
            best=share(int(np.count_nonzero(loss == 0)), len(loss)),
            loss=percentiles(loss, (50.0, 95.0, 99.0)),
        )
        for loss in sample_losses(controllers)
    )
