"""The method of the mixed filter."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from lbt_synth.methods.filters import BOUNDS, BoundOptions
from lbt_synth.methods.method import DesignInputs, Method

if TYPE_CHECKING:
    from lbt_synth.design.filter_design import FilterDesign


class MixedOptions(BoundOptions):
    """Options of the mixed filter."""

    rms: float | None = Field(
        default=None,
        gt=0,
        description="bound of the estimation error [nm rms] instead, under which the norm is "
        "minimised",
    )
    taps: int = Field(
        default=16, ge=1, le=64, description="past innovations that the filter weighs"
    )


def _build(inputs: DesignInputs, options: MixedOptions) -> FilterDesign:
    from lbt_synth.design.mixed import mixed

    bound = options.bound() if options.rms is None else {"rms": options.rms}
    return mixed(inputs.plant, **bound, taps=options.taps, horizon=options.horizon)


METHOD = Method(
    name="mixed",
    title="mixed filter",
    label="mixed",
    design="lbt_synth.design.filter_design:FilterDesign",
    options=MixedOptions,
    build=_build,
    exclusive=BOUNDS,
    configurable=frozenset({"gamma_ratio"}),
    slow=True,
)
