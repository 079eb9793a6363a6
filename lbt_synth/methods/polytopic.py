"""The method "polytopic": a filter for an interval of vibration frequencies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from lbt_synth.methods.filters import Horizon
from lbt_synth.methods.method import Description, DesignInputs, Method, Section
from lbt_synth.validation import choice, number

if TYPE_CHECKING:
    from lbt_synth.design.polytopic import PolytopicDesign
    from lbt_synth.design.record import DesignRecord

_NORMS = ("hinf", "h2")
_RESULTS = ("bound_guaranteed", "worst_achieved", "worst_frequency_hz", "bound_programme")


class PolytopicOptions(Section):
    """Options of the filter for an interval."""

    half_width_hz: float = Field(
        ge=0,
        description="half width of the interval of vibration frequencies [Hz]",
        examples=[1],
        json_schema_extra={"slider": [0.0, 4.0]},
    )
    norm: Literal["hinf", "h2"] = Field(
        default="hinf",
        description="what is minimised over the interval: hinf (H-infinity norm) or h2 (rms)",
    )
    horizon: Horizon = 1


def _build(inputs: DesignInputs, options: PolytopicOptions) -> PolytopicDesign:
    from lbt_synth.design.polytopic import polytopic

    return polytopic(inputs.plant, **options.model_dump())


def _pack(design: PolytopicDesign) -> DesignRecord:
    from lbt_synth.design.record import DesignRecord, record_problem

    arrays = {f"PREDICTOR_{name}": getattr(design.predictor, name) for name in "ABC"}
    interval = {name: getattr(design, name) for name in ("half_width_hz", "norm", *_RESULTS)}
    return DesignRecord(arrays, {"interval": interval}) | record_problem(design.problem)


def _unpack(record: DesignRecord) -> PolytopicDesign:
    from lbt_synth.design.polytopic import PolytopicDesign

    problem = record.plant("an interval of frequencies")
    common, interval = record.common(), record.meta["interval"]
    if common["method"] != f"{METHOD.name}-{interval['norm']}":
        raise ValueError(
            f"the method {common['method']} does not minimise the norm {interval['norm']}"
        )
    results: dict[str, Any] = {name: number(interval[name], name, above=0) for name in _RESULTS}
    design = PolytopicDesign(
        **common,
        **results,
        problem=problem,
        predictor=record.controller("PREDICTOR_", D=np.zeros((len(problem.L), len(problem.C)))),
        norm=choice(interval["norm"], "norm", _NORMS),
        half_width_hz=number(interval["half_width_hz"], "half_width_hz", at_least=0),
    )
    # raises for an interval that does not fit the plant: refused here, not when it is verified
    design.interval.coefficient(design.worst_frequency_hz)
    return design


def _describe(design: PolytopicDesign) -> Description:
    return Description(
        facts=design.facts(),
        matrices={f"predictor_{name}": getattr(design.predictor, name) for name in "ABC"},
    )


METHOD = Method(
    name="polytopic",
    title="filter for an interval",
    label="polytopic",
    options=PolytopicOptions,
    build=_build,
    pack=_pack,
    unpack=_unpack,
    describe=_describe,
    design_names=tuple(f"polytopic-{norm}" for norm in _NORMS),
)
