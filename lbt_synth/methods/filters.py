"""The options that the methods of filters share."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from lbt_synth.methods.method import Section

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
