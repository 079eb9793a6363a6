"""Sensitivity of each controller's Strehl ratio to each parameter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.studies.study.conditional_curve import ConditionalCurve, conditional_curve
from lbt_synth.studies.study.controller_samples import ControllerSamples
from lbt_synth.studies.study.variance_index import (
    FEWEST,
    NO_INDEX,
    VarianceIndex,
    first_order_index,
    value_starts,
)
from lbt_synth.validation import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ParameterSensitivity:
    """How a controller's Strehl ratio depends on one parameter."""

    parameter: str  # its name
    index: VarianceIndex  # part of the variance that it explains by itself
    spearman: float  # rank correlation, in [-1, 1]; nan if either is constant
    swing: float  # see ConditionalCurve.swing; nan for a constant
    swing_error: float  # its standard error
    curve: ConditionalCurve | None  # None for a constant


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControllerSensitivity:
    """How one controller's Strehl ratio depends on all parameters."""

    controller: str  # its name
    samples: int  # samples on which it did not fail
    parameters: tuple[ParameterSensitivity, ...]  # in the order of the study

    @property
    def ranked(self) -> tuple[ParameterSensitivity, ...]:
        """The parameters that vary, by falling index."""
        varying = [each for each in self.parameters if np.isfinite(each.index.value)]
        return tuple(sorted(varying, key=lambda each: -each.index.value))

    @property
    def sum(self) -> float:
        """Sum of the indices; nan if there is none."""
        values = [each.index.value for each in self.ranked]
        return float(np.sum(values)) if values else np.nan

    @property
    def sum_error(self) -> float:
        """Root of the sum of squares of their errors; nan if there is none."""
        errors = [each.index.error for each in self.ranked]
        return float(np.linalg.norm(errors)) if errors else np.nan

    @property
    def interactions(self) -> float:
        """1 less the sum: the part that only several independent parameters explain together."""
        return 1 - self.sum


def sensitivities(
    controllers: Sequence[ControllerSamples], parameters: Mapping[str, FloatArray]
) -> tuple[ControllerSensitivity, ...]:
    """Return the sensitivity of each controller's Strehl ratio to each parameter, (n,) each."""
    ranks = [_ranks(each) for each in controllers]
    found: list[list[ParameterSensitivity]] = [[] for _ in controllers]
    for name, values in parameters.items():
        order = np.argsort(values, kind="stable")  # ties in the order of the samples
        for place, each in enumerate(controllers):
            found[place].append(_sensitivity(name, values, each, order, ranks[place]))
    return tuple(
        ControllerSensitivity(
            controller=each.controller,
            samples=int(np.count_nonzero(each.evaluated)),
            parameters=tuple(found[place]),
        )
        for place, each in enumerate(controllers)
    )


def _sensitivity(
    name: str,
    values: FloatArray,
    controller: ControllerSamples,
    order: IntArray,
    ranks: FloatArray,
) -> ParameterSensitivity:
    """Return the sensitivity to one parameter, given the order of its values."""
    if not controller.evaluated.all():
        order = order[controller.evaluated[order]]
    ordered = values[order]
    index, curve = NO_INDEX, None
    spearman = swing = error = np.nan
    if len(ordered) >= FEWEST and ordered[0] < ordered[-1]:
        strehl = controller.strehl[order]
        index = first_order_index(ordered, strehl)
        spearman = _correlation(_ranks_in_order(ordered), ranks[order])
        curve = conditional_curve(ordered, strehl, controller.unstable[order])
        swing, error = curve.swing()
    return ParameterSensitivity(
        parameter=name,
        index=index,
        spearman=spearman,
        swing=swing,
        swing_error=error,
        curve=curve,
    )


def _ranks(controller: ControllerSamples) -> FloatArray:
    """Return the ranks of the Strehl ratio, their mean for ties; nan where it failed."""
    from scipy.stats import rankdata

    ranks = np.full(len(controller.strehl), np.nan)
    ranks[controller.evaluated] = rankdata(controller.strehl[controller.evaluated])
    return ranks


def _ranks_in_order(ordered: FloatArray) -> FloatArray:
    """Return the ranks of values that are in order."""
    starts = value_starts(ordered)
    counts = np.diff(np.append(starts, len(ordered)))
    ranks: FloatArray = np.repeat(starts + (counts + 1) / 2, counts)
    return ranks


def _correlation(first: FloatArray, second: FloatArray) -> float:
    """Return Spearman's correlation, given ranks."""
    middle = (len(first) + 1) / 2  # the mean of ranks
    first, second = first - middle, second - middle
    size = float(first @ first) * float(second @ second)
    return float(first @ second) / float(np.sqrt(size)) if size > 0 else np.nan
