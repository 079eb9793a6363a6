"""The method of the H-infinity filter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from lbt_synth.methods.filters import BOUNDS, BoundOptions
from lbt_synth.methods.method import DesignInputs, Method

if TYPE_CHECKING:
    from lbt_synth.design.filter_design import FilterDesign


class HinfOptions(BoundOptions):
    """Options of the H-infinity filter."""

    route: Literal["lmi", "riccati"] | None = Field(
        default=None, description="solver (default lmi up to 20 states, riccati beyond)"
    )


def _build(inputs: DesignInputs, options: HinfOptions) -> FilterDesign:
    from lbt_synth.design.hinf import hinf

    return hinf(inputs.plant, **options.bound(), horizon=options.horizon, route=options.route)


METHOD = Method(
    name="hinf",
    title="H-infinity filter",
    label="H∞",
    design="lbt_synth.design.filter_design:FilterDesign",
    options=HinfOptions,
    build=_build,
    exclusive=BOUNDS,
    configurable=frozenset({"gamma_ratio"}),
    reference_rank=2,
    reference_options={"route": "riccati"},
)
