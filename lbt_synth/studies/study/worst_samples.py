"""The samples of a study on which a controller does worst."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lbt_synth.studies.study.controller_samples import ControllerSamples
from lbt_synth.validation import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class WorstRow:
    """One controller on one sample."""

    row: int  # of the sample in the study
    stable: bool
    strehl: float  # 0 if unstable
    residual_nm: float  # [nm rms]; inf if unstable
    parameters: dict[str, float]  # of the sample


def worst_rows(
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
