"""What the methods of filters share: their options, their record and their description."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from lbt_synth.errors import ProblemError
from lbt_synth.methods.method import Description, Method, Section

if TYPE_CHECKING:
    from lbt_synth.design.record import DesignRecord
    from lbt_synth.design.result import Design

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


_OWN_SENSOR_ALONE = {"route": ("riccati", None), "horizon": (1,), "taps": (16,), "rms": (None,)}


def require_several_sensors(options: Section) -> None:
    """Refuse options that filters of several sensors do not have."""
    for name, usual in _OWN_SENSOR_ALONE.items():
        if getattr(options, name, usual[0]) not in usual:
            raise ProblemError(
                f"{name} must be left out with several sensors: it is an option of filters of the "
                "loop's own sensor alone."
            )


@dataclass(frozen=True, slots=True)
class FilterKind:
    """What filters of one sensor, or of several, are described, recorded and rebuilt with."""

    describe: Callable[[Any], Description]
    pack: Callable[[Any], DesignRecord]
    unpack: Callable[[DesignRecord], Design]


def _kind(*, several_sensors: bool) -> FilterKind:
    """Return the kind of a filter; its module is imported when a design is at hand."""
    if several_sensors:
        from lbt_synth.methods.filter_kinds.fused import FUSED

        return FUSED
    from lbt_synth.methods.filter_kinds.one_sensor import ONE_SENSOR

    return ONE_SENSOR


def _describe_filter(design: Design) -> Description:
    return _kind(several_sensors=design.several_sensors).describe(design)


def _pack_filter(design: Design) -> DesignRecord:
    return _kind(several_sensors=design.several_sensors).pack(design)


def _unpack_filter(record: DesignRecord) -> Design:
    return _kind(several_sensors=record.meta["problem"] == "fused plant").unpack(record)


filter_method = partial(Method, pack=_pack_filter, unpack=_unpack_filter, describe=_describe_filter)
