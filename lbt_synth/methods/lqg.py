"""The method of the LQG controller."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from lbt_synth.methods.method import DesignInputs, Method, Section

if TYPE_CHECKING:
    from lbt_synth.design.lqg import LqgDesign


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

    return lqg(inputs.plant.own_sensor_alone(), command_weight=options.command_weight)


METHOD = Method(
    name="lqg",
    title="LQG controller",
    label="LQG",
    options=LqgOptions,
    build=_build,
    design="lbt_synth.design.lqg:LqgDesign",
    configurable=frozenset({"command_weight"}),
)
