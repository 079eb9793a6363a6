"""What the methods of filters share: their options, their record and their description."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from lbt_synth.errors import ProblemError
from lbt_synth.methods.method import Description, Method, RowTable, Section
from lbt_synth.validation import number

if TYPE_CHECKING:
    from lbt_synth.design.record import DesignRecord
    from lbt_synth.design.result import Design

Horizon = Annotated[
    int,
    Field(
        description="frames from the newest measurement to the estimate: the filter is for a loop "
        "with a delay of loop.delay_frames + horizon - 1, at least 1 frame",
        json_schema_extra={"instead": "Set loop.delay_frames in the configuration instead."},
    ),
]
_CLAIMS = ("gamma_requested", "gamma_least", "gamma_infeasible", "rms_requested")
BOUNDS = frozenset({"gamma", "gamma_ratio", "rms"})  # at most one is given


class BoundOptions(Section):
    """A bound on the H-infinity norm, and the horizon."""

    gamma: float | None = Field(default=None, gt=0, description="bound of the H-infinity norm [nm]")
    gamma_ratio: float = Field(
        default=1.2,
        ge=1,
        le=1e9,
        description="bound of the norm as a multiple of the least norm",
        json_schema_extra={
            "hint": "At 1 the bound is the least one; far above it the filter is the Kalman "
            "filter.",
            "slider": [1.0, 3.0],
        },
    )
    horizon: Horizon = 1

    def bound(self) -> dict[str, Any]:
        """Return the bound as an argument: an absolute one, else the multiple of the least."""
        return {"gamma_ratio": self.gamma_ratio} if self.gamma is None else {"gamma": self.gamma}


_OWN_SENSOR_ALONE = {"route": ("riccati", None), "horizon": (1,), "taps": (16,), "rms": (None,)}


def require_several_sensors(options: Section) -> None:
    """Refuse options that filters of several sensors do not have."""
    for name, usual in _OWN_SENSOR_ALONE.items():
        if getattr(options, name, usual[0]) not in usual:
            raise ProblemError(
                f"{name} must be left out with several sensors: it is an option of filters of the "
                "loop's own sensor alone."
            )


def _describe_filter(design: Any) -> Description:
    """Describe a filter, and its loop when some of several sensors fail."""
    if not design.several_sensors:
        names = ("gain_predictor", "gain_filter")
        matrices = {name: getattr(design, name) for name in names}
        return Description(facts=design.facts(), matrices=matrices)
    from lbt_synth.design.fusion.failures import failure_rows

    rows = failure_rows(design.problem, design.gains, design.fallbacks)
    unseen = [row.missing for row in rows if row.must_switch]
    notes = [
        "unseen: the readings are zero, or frozen, and the filter believes them: a reading that "
        "stays leaves an offset, which counts to the residual. Not read: the "
        "fall-back filter of this file for the remaining sensors, with the same state.",
    ]
    if unseen:
        notes.append(
            f"note: unstable if these fail unseen: {'; '.join(unseen)}. The computer of the loop "
            "has to see such a failure, and take the fall-back filter."
        )
    return Description(
        facts=design.facts(),
        tables=(RowTable(key="failures", title="When sensors fail", rows=rows),),
        notes=notes,
        matrices={"gains": design.gains},
    )


def _pack_filter(design: Any) -> DesignRecord:
    """Record the gains and claims of a filter, with its problem."""
    from lbt_synth.design.record import DesignRecord, record_problem

    if design.several_sensors:
        from lbt_synth.design.fusion.record import record_fused

        return record_fused(design)
    arrays = {"GAIN_PREDICTOR": design.gain_predictor, "GAIN_FILTER": design.gain_filter}
    if design.witness is not None:
        arrays |= {"WITNESS_X": design.witness.states, "WITNESS_W": design.witness.disturbances}
    meta = {name: getattr(design, name) for name in _CLAIMS}
    return DesignRecord(arrays, meta) | record_problem(design.problem)


def _unpack_filter(record: DesignRecord) -> Design:
    """Rebuild a filter."""
    if record.meta["problem"] == "fused plant":
        from lbt_synth.design.fusion.record import rebuild_fused

        return rebuild_fused(record)
    from lbt_synth.design.filter_design import FilterDesign
    from lbt_synth.linear import Witness

    problem, arrays = record.problem(), record.arrays
    rows_cols = (problem.A.shape[0], problem.C.shape[0])
    said = {name: record.meta[name] for name in _CLAIMS}
    claims: dict[str, Any] = {k: number(v, k, above=0) for k, v in said.items() if v is not None}
    for name in ("GAIN_PREDICTOR", "GAIN_FILTER"):
        if arrays[name].shape != rows_cols:
            raise ValueError(f"{name} must be {rows_cols} to match the plant")
        claims[name.lower()] = arrays[name]
    if "WITNESS_X" in arrays:
        claims["witness"] = Witness(states=arrays["WITNESS_X"], disturbances=arrays["WITNESS_W"])
    return FilterDesign(**record.common(), **claims, problem=problem)


filter_method = partial(Method, pack=_pack_filter, unpack=_unpack_filter, describe=_describe_filter)
