"""Which parameters a controller's Strehl ratio depends on."""

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

    parameter: str  # Its name
    index: VarianceIndex  # Part of the variance that the parameter explains by itself
    # Rank correlation, in [-1, 1]: the sign of the dependence, and how monotonic it is; nan where
    # the parameter or the Strehl ratio is constant
    spearman: float
    # swing, swing_error: Greatest less least mean of the Strehl ratio over the middle 90 % of the
    # parameter, and its standard error; nan for a constant
    swing: float
    swing_error: float
    curve: ConditionalCurve | None  # The Strehl ratio over the parameter; None for a constant


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControllerSensitivity:
    """Dependence of one controller's Strehl ratio on all parameters."""

    controller: str  # Its name
    samples: int  # Samples on which it did not fail
    parameters: tuple[ParameterSensitivity, ...]  # In the order of the study

    @property
    def ranked(self) -> tuple[ParameterSensitivity, ...]:
        """Those that vary, in order of falling index."""
        varying = [each for each in self.parameters if np.isfinite(each.index.value)]
        return tuple(sorted(varying, key=lambda each: -each.index.value))

    @property
    def sum(self) -> float:
        """Sum of the indices; nan where there is none."""
        values = [each.index.value for each in self.ranked]
        return float(np.sum(values)) if values else np.nan

    @property
    def sum_error(self) -> float:
        """Root of the sum of squares of their errors; nan where there is none."""
        errors = [each.index.error for each in self.ranked]
        return float(np.linalg.norm(errors)) if errors else np.nan

    @property
    def interactions(self) -> float:
        """1 less the sum: what only parameters together explain, if they are independent."""
        return 1 - self.sum


def sensitivities(
    controllers: Sequence[ControllerSamples], parameters: Mapping[str, FloatArray]
) -> tuple[ControllerSensitivity, ...]:
    """Dependence of each controller's Strehl ratio on each parameter. Shapes: parameters (n,)."""
    ranks = [_ranks(each) for each in controllers]
    found: list[list[ParameterSensitivity]] = [[] for _ in controllers]
    for name, values in parameters.items():
        order = np.argsort(values, kind="stable")  # ties in the order of the samples
        for place, each in enumerate(controllers):
            kept = order if each.evaluated.all() else order[each.evaluated[order]]
            found[place].append(_sensitivity(name, values[kept], each, kept, ranks[place]))
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
    ordered: FloatArray,
    controller: ControllerSamples,
    order: IntArray,
    ranks: FloatArray,
) -> ParameterSensitivity:
    """One parameter, the samples in order of it."""
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
    """Ranks of the Strehl ratio, the mean one for ties; nan where the evaluation failed."""
    from scipy.stats import rankdata

    ranks = np.full(len(controller.strehl), np.nan)
    ranks[controller.evaluated] = rankdata(controller.strehl[controller.evaluated])
    return ranks


def _ranks_in_order(ordered: FloatArray) -> FloatArray:
    """Rank samples that are in order already."""
    starts = value_starts(ordered)
    counts = np.diff(np.append(starts, len(ordered)))
    ranks: FloatArray = np.repeat(starts + (counts + 1) / 2, counts)
    return ranks


def _correlation(first: FloatArray, second: FloatArray) -> float:
    """Pearson's correlation; of ranks, Spearman's."""
    middle = (len(first) + 1) / 2  # the mean of ranks
    first, second = first - middle, second - middle
    size = float(first @ first) * float(second @ second)
    return float(first @ second) / float(np.sqrt(size)) if size > 0 else np.nan
