"""The method of the LQG controller."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from lbt_synth.methods.method import Description, DesignInputs, Method, Section
from lbt_synth.validation import frozen_copy, number

if TYPE_CHECKING:
    from lbt_synth.design.lqg import LqgDesign
    from lbt_synth.design.record import DesignRecord

_NUMBERS = ("command_weight", "objective_nm")


class LqgOptions(Section):
    """Options of the LQG controller."""

    command_weight: float = Field(
        default=0.0,
        ge=0,
        le=1e12,
        description="weight of the squared command beside the squared residual",
    )


def _build(inputs: DesignInputs, options: LqgOptions) -> LqgDesign:
    from lbt_synth.design.lqg import lqg

    return lqg(inputs.plant, command_weight=options.command_weight)


def _pack(design: LqgDesign) -> DesignRecord:
    from lbt_synth.design.record import DesignRecord, record_problem

    arrays = {"GAIN_PREDICTOR": design.gain_predictor, "GAIN_STATE": design.gain_state}
    if design.gain_mirror.size:
        arrays["GAIN_MIRROR"] = design.gain_mirror[None]
    meta = {"lqg": {name: getattr(design, name) for name in _NUMBERS}}
    return DesignRecord(arrays, meta) | record_problem(design.problem)


def _unpack(record: DesignRecord) -> LqgDesign:
    from lbt_synth.design.lqg import LqgDesign

    problem = record.plant("a design that knows the mirror")
    numbers: dict[str, Any] = {
        name: number(record.meta["lqg"][name], name, at_least=0) for name in _NUMBERS
    }
    design = LqgDesign(
        **record.common(),
        **numbers,
        problem=problem,
        gain_predictor=record.arrays["GAIN_PREDICTOR"],
        gain_state=record.arrays["GAIN_STATE"],
        gain_mirror=frozen_copy(np.ravel(record.arrays.get("GAIN_MIRROR", []))),
    )
    estimation, mirror = design.estimation, problem.hardware.mirror_system.core
    shapes = {
        "GAIN_PREDICTOR": (design.gain_predictor.shape, estimation.C.T.shape),
        "GAIN_STATE": (design.gain_state.shape, estimation.L.shape),
        "GAIN_MIRROR": (design.gain_mirror.shape, (mirror.n_states,)),
    }
    for name, (found, expected) in shapes.items():
        if found != expected:
            raise ValueError(f"{name} must be {expected} to match the plant and the mirror")
    return design


def _describe(design: LqgDesign) -> Description:
    return Description(facts=design.facts())


METHOD = Method(
    name="lqg",
    title="LQG controller",
    label="LQG",
    options=LqgOptions,
    build=_build,
    pack=_pack,
    unpack=_unpack,
    describe=_describe,
    configurable=frozenset({"command_weight"}),
)
