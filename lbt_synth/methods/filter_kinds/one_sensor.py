"""What ``show`` says of a filter of the loop's own sensor, and what a gain file holds of it."""

from __future__ import annotations

from typing import Any

from lbt_synth.design import FilterDesign
from lbt_synth.design.record import DesignRecord, record_problem
from lbt_synth.linear import Witness
from lbt_synth.methods.filters import FilterKind
from lbt_synth.methods.method import Description
from lbt_synth.validation import number

_CLAIMS = ("gamma_requested", "gamma_least", "gamma_infeasible", "rms_requested")


def _describe(design: FilterDesign) -> Description:
    """Describe a filter."""
    return Description(
        facts=design.facts(),
        matrices={"gain_predictor": design.gain_predictor, "gain_filter": design.gain_filter},
    )


def _pack(design: FilterDesign) -> DesignRecord:
    """Record the gains and claims of a filter, with its problem."""
    arrays = {"GAIN_PREDICTOR": design.gain_predictor, "GAIN_FILTER": design.gain_filter}
    if design.witness is not None:
        arrays |= {"WITNESS_X": design.witness.states, "WITNESS_W": design.witness.disturbances}
    meta = {name: getattr(design, name) for name in _CLAIMS}
    return DesignRecord(arrays, meta) | record_problem(design.problem)


def _unpack(record: DesignRecord) -> FilterDesign:
    """Rebuild a filter."""
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


ONE_SENSOR = FilterKind(describe=_describe, pack=_pack, unpack=_unpack)
