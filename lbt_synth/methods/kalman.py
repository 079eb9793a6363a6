"""The method of the Kalman filter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from lbt_synth.methods.filters import Horizon
from lbt_synth.methods.method import DesignInputs, Method, Section

if TYPE_CHECKING:
    from lbt_synth.design.filter_design import FilterDesign


class KalmanOptions(Section):
    """Options of the Kalman filter."""

    route: Literal["riccati", "sdp"] = Field(default="riccati", description="solver")
    horizon: Horizon = 1


def _build(inputs: DesignInputs, options: KalmanOptions) -> FilterDesign:
    from lbt_synth.design.kalman import kalman

    return kalman(inputs.plant, horizon=options.horizon, route=options.route)


METHOD = Method(
    name="kalman",
    title="Kalman filter",
    label="Kalman",
    design="lbt_synth.design.filter_design:FilterDesign",
    options=KalmanOptions,
    build=_build,
    batched=True,
    reference_rank=1,
)
