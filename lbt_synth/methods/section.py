"""The base of all options and sections that people write: strict types, limits, no unknown keys."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(gt=0, le=1)]
Damping = Annotated[float, Field(gt=0, lt=1)]
Count = Annotated[int, Field(ge=1)]


class Section(BaseModel):
    """Options or a section of a file: strict types, no unknown keys, read-only.

    Examples
    --------
    >>> from pydantic import Field
    >>> from lbt_synth.methods import Section
    >>> class Leak(Section):
    ...     leak_per_s: float = Field(gt=0, description="part of the command lost [1/s]")
    >>> Leak(leak_per_s=5).leak_per_s
    5.0
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)
