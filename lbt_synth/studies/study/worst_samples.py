"""The samples on which a controller does worst."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lbt_synth.studies.study.controller_samples import ControllerSamples
from lbt_synth.validation import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class WorstRow:
    """One sample, and what became of the controller."""

    row: int  # Number of the sample in the study
    stable: bool  # Whether the loop is stable
    strehl: float  # Strehl ratio; 0 if unstable
    residual_nm: float  # Residual [nm rms]; inf if unstable
    parameters: dict[str, float]  # The sample


def worst_rows(
    controller: ControllerSamples,
    rows: IntArray,
    parameters: Mapping[str, FloatArray],
    *,
    count: int,
) -> tuple[WorstRow, ...]:
    """Return the samples of least Strehl ratio: unstable ones first, then in order of the ratio.

    Shapes: rows (n,), parameters (n,).
    """
    indices = np.flatnonzero(controller.evaluated)
    key = np.where(controller.unstable, -1.0, controller.strehl)[indices]
    if 0 < count < len(indices):  # only those not above the last one wanted need be sorted
        kept = key <= np.partition(key, count - 1)[count - 1]
        indices, key = indices[kept], key[kept]
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
