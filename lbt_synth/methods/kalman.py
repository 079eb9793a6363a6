"""The method of the Kalman filter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from lbt_synth.methods.filters import Horizon, describe_filter, pack_filter, unpack_filter
from lbt_synth.methods.method import DesignInputs, Method
from lbt_synth.methods.section import Section

if TYPE_CHECKING:
    from lbt_synth.design.result import FilterDesign


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
    options=KalmanOptions,
    build=_build,
    pack=pack_filter,
    unpack=unpack_filter,
    describe=describe_filter,
    batched=True,
    reference=(1, {}),
)
