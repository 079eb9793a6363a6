"""Numbers that people write in files, with limits beyond which a unit is wrong or a slip."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

from pydantic import Discriminator, Field, Tag

ONE, EACH = "one", "each"  # one value for all axes, or a list with one per axis

Count: TypeAlias = Annotated[int, Field(ge=1, le=10**9)]
Whole: TypeAlias = Annotated[int, Field(ge=0, le=10**9)]
Fraction: TypeAlias = Annotated[float, Field(ge=1e-6, le=1)]
Damping: TypeAlias = Annotated[float, Field(ge=1e-7, le=1e6)]  # far above 1: a drift
Metres: TypeAlias = Annotated[float, Field(ge=1e-2, le=1e6)]
MetresPerSecond: TypeAlias = Annotated[float, Field(ge=1e-3, le=1e3)]
Arcseconds: TypeAlias = Annotated[float, Field(ge=1e-2, le=100)]
Micrometres: TypeAlias = Annotated[float, Field(ge=1e-2, le=50)]
Milliarcseconds: TypeAlias = Annotated[float, Field(ge=1e-4, le=1e5)]
Nanometres: TypeAlias = Annotated[float, Field(ge=1e-3, le=1e6)]
Hertz: TypeAlias = Annotated[float, Field(ge=1e-3, le=1e6)]
HertzFromZero: TypeAlias = Annotated[float, Field(ge=0, le=1e6)]
Shift: TypeAlias = Annotated[float, Field(ge=-1e6, le=1e6)]
Seconds: TypeAlias = Annotated[float, Field(ge=1e-3, le=1e6)]
Degrees: TypeAlias = Annotated[float, Field(ge=-1e4, le=1e4)]
Gain: TypeAlias = Annotated[float, Field(ge=1e-3, le=1e3)]
Ratio: TypeAlias = Annotated[float, Field(ge=1e-6, le=1e6)]
RatioFromZero: TypeAlias = Annotated[float, Field(ge=0, le=1e6)]
Entry: TypeAlias = Annotated[float, Field(ge=-1e6, le=1e6)]
Acceleration: TypeAlias = Annotated[float, Field(ge=1e-12, le=1e3)]


def tag_one_or_each(value: Any) -> str:
    """Tell a list with one value per axis or measurement from one value for all."""
    return EACH if isinstance(value, list) else ONE


NanometresOrEach = Annotated[
    Annotated[Nanometres, Tag(ONE)] | Annotated[list[Nanometres], Field(min_length=1), Tag(EACH)],
    Discriminator(tag_one_or_each),
]
GainOrEach = Annotated[
    Annotated[Gain, Tag(ONE)] | Annotated[list[Gain], Field(min_length=1), Tag(EACH)],
    Discriminator(tag_one_or_each),
]
AccelerationOrEach = Annotated[
    Annotated[Acceleration, Tag(ONE)]
    | Annotated[list[Acceleration], Field(min_length=1), Tag(EACH)],
    Discriminator(tag_one_or_each),
]
