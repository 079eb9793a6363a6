"""What the methods of filters share: their options, their record and their description."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from lbt_synth.methods.method import Description, Method, Section
from lbt_synth.validation import number

if TYPE_CHECKING:
    from lbt_synth.design.fusion.fused_filter import FusedFilter
    from lbt_synth.design.record import DesignRecord
    from lbt_synth.design.result import FilterDesign

_CLAIMS = ("gamma_requested", "gamma_least", "gamma_infeasible", "rms_requested")

Horizon = Annotated[
    int,
    Field(
        description="frames from the newest measurement to the estimate: the filter is for a loop "
        "with a delay of loop.delay_frames + horizon - 1, at least 1 frame",
        json_schema_extra={"instead": "Set loop.delay_frames in the configuration instead."},
    ),
]
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


def _describe_filter(design: FilterDesign | FusedFilter) -> Description:
    """Describe a filter."""
    from lbt_synth.design.fusion.fused_filter import FusedFilter

    if isinstance(design, FusedFilter):
        from lbt_synth.methods.fused import describe_fused

        return describe_fused(design)
    return Description(
        facts=design.facts(),
        matrices={"gain_predictor": design.gain_predictor, "gain_filter": design.gain_filter},
    )


def _pack_filter(design: FilterDesign | FusedFilter) -> DesignRecord:
    """Record the gains and claims of a filter, with its problem."""
    from lbt_synth.design.fusion.fused_filter import FusedFilter
    from lbt_synth.design.record import DesignRecord, record_problem

    if isinstance(design, FusedFilter):
        from lbt_synth.design.fusion.record import record_fused

        return record_fused(design)

    arrays = {"GAIN_PREDICTOR": design.gain_predictor, "GAIN_FILTER": design.gain_filter}
    if design.witness is not None:
        arrays |= {"WITNESS_X": design.witness.states, "WITNESS_W": design.witness.disturbances}
    meta = {name: getattr(design, name) for name in _CLAIMS}
    return DesignRecord(arrays, meta) | record_problem(design.problem)


def _unpack_filter(record: DesignRecord) -> FilterDesign | FusedFilter:
    """Rebuild a filter."""
    from lbt_synth.design import FilterDesign
    from lbt_synth.linear import Witness

    if record.meta["problem"] == "fused plant":
        from lbt_synth.design.fusion.record import rebuild_fused

        return rebuild_fused(record)
    problem, arrays = record.problem(), record.arrays
    rows_cols = (problem.A.shape[0], problem.C.shape[0])
    said = {name: record.meta.get(name) for name in _CLAIMS}  # files of 0.1 have fewer
    claims: dict[str, Any] = {k: number(v, k, above=0) for k, v in said.items() if v is not None}
    for name in ("GAIN_PREDICTOR", "GAIN_FILTER"):
        if arrays[name].shape != rows_cols:
            raise ValueError(f"{name} must be {rows_cols} to match the plant")
        claims[name.lower()] = arrays[name]
    if "WITNESS_X" in arrays:
        claims["witness"] = Witness(states=arrays["WITNESS_X"], disturbances=arrays["WITNESS_W"])
    return FilterDesign(**record.common(), **claims, problem=problem)


filter_method = partial(Method, pack=_pack_filter, unpack=_unpack_filter, describe=_describe_filter)
