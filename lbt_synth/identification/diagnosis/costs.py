"""What each part of the disturbance costs a loop, in nm and in Strehl ratio."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lbt_synth.identification.diagnosis.line_origins import LineOrigin
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop, jitter_strehl, model_budget
from lbt_synth.loop.budget import line_covariance
from lbt_synth.models import TipTiltPlant
from lbt_synth.storage.rows import column, nm_column, percent_column, table_row
from lbt_synth.validation import FloatArray


@table_row
class CostRow:
    """One part of the disturbance, and what it costs two loops by the model."""

    part: str = column("part", help="Part of the disturbance")
    running_nm: float = nm_column("running", help="Residual that it leaves in the loop that ran")
    running_strehl: float = percent_column("Strehl lost", help="Strehl ratio that this costs")
    best_nm: float = nm_column("best design", help="Residual that it leaves in the best design")
    best_strehl: float = percent_column("Strehl lost", help="Strehl ratio that this costs")


def disturbance_costs(
    plant: TipTiltPlant,
    lines: Sequence[LineOrigin],
    running: Controller | None,
    best: Controller | None,
    imaging: Imaging,
) -> tuple[CostRow, ...]:
    """Return a row per part of the disturbance, the most costly first, and one of all.

    The Strehl ratio that a part costs is that of the residual without it, less that with it: as
    residuals add up in the exponent, these do not add up to the whole loss.
    """
    tables = [_covariances(plant, lines, controller) for controller in (running, best)]
    names = next((list(table) for table in tables if table), [])
    losses = [_losses(table, imaging) for table in tables]
    rows = [
        CostRow(
            part=name,
            running_nm=_rms(tables[0], name),
            running_strehl=losses[0].get(name, np.nan),
            best_nm=_rms(tables[1], name),
            best_strehl=losses[1].get(name, np.nan),
        )
        for name in names
    ]
    by = "running_nm" if tables[0] else "best_nm"
    return tuple(sorted(rows[:-1], key=lambda row: -getattr(row, by))) + tuple(rows[-1:])


def _covariances(
    plant: TipTiltPlant, lines: Sequence[LineOrigin], controller: Controller | None
) -> dict[str, FloatArray]:
    """Return the covariance (n, n) of the residual by part, and of all; none of no stable loop."""
    if controller is None:
        return {}
    loop = close_loop(plant.hardware, controller)
    if not loop.is_stable:
        return {}
    budget = model_budget(loop, plant, frame_means=True)
    out = {"turbulence": budget.turbulence_nm2, "measurement noise": budget.noise_nm2}
    for line in lines:
        parts = [line_covariance(loop, vibration) for vibration in line.vibrations]
        name = line.name if line.name not in out else f"{line.name}, another"
        out[name] = np.sum(parts, axis=0)
    rest = budget.total_nm2 - np.sum(list(out.values()), axis=0)
    out["turbulence"] = out["turbulence"] + rest  # slow resonances are turbulence
    return out | {"all": budget.total_nm2}


def _losses(parts: Mapping[str, FloatArray], imaging: Imaging) -> dict[str, float]:
    """Return the Strehl ratio that each part costs."""
    if not parts:
        return {}
    whole = parts["all"]
    strehl = jitter_strehl(whole, imaging=imaging)
    return {
        name: jitter_strehl(_without(whole, part), imaging=imaging) - strehl
        for name, part in parts.items()
    }


def _without(whole: FloatArray, part: FloatArray) -> FloatArray:
    """Return a covariance without a part of it, positive semidefinite in spite of rounding."""
    values, vectors = np.linalg.eigh(whole - part)
    return np.asarray(vectors @ np.diag(np.maximum(values, 0)) @ vectors.T)


def _rms(parts: Mapping[str, FloatArray], name: str) -> float:
    return float(np.sqrt(max(np.trace(parts[name]), 0.0))) if name in parts else np.nan
