"""Schema of a study file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, model_validator

from lbt_synth.methods.section import Positive, Section

KINDS = ("fixed", "uniform", "normal", "list")
_CONTROLLER_NAME = r"^[A-Za-z][A-Za-z0-9_-]*$"


class NormalSection(Section):
    """A normal distribution, cut at low and high if they are given."""

    mean: float
    deviation: Positive
    low: float | None = None
    high: float | None = None

    @model_validator(mode="after")
    def _low_below_high(self) -> NormalSection:
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"low must be below high; got {self.low:g} and {self.high:g}")
        return self


class ParameterSection(Section):
    """The distribution of one parameter; a bare number is fixed."""

    fixed: float | None = None
    uniform: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    normal: NormalSection | None = None
    list_: Annotated[list[float], Field(min_length=1)] | None = Field(default=None, alias="list")
    weights: Annotated[list[Positive], Field(min_length=1)] | None = None
    also: list[str] = Field(default_factory=list)

    @model_validator(mode="before")
    @classmethod
    def _bare_number(cls, value: Any) -> Any:
        return {"fixed": value} if isinstance(value, int | float) else value

    @model_validator(mode="after")
    def _one_distribution(self) -> ParameterSection:
        given = [v is not None for v in (self.fixed, self.uniform, self.normal, self.list_)]
        if sum(given) != 1:
            raise ValueError(f"expected a number or exactly one of {', '.join(KINDS)}")
        if self.uniform is not None and not self.uniform[0] < self.uniform[1]:
            low, high = self.uniform
            raise ValueError(f"uniform: must be [low, high]; got [{low:g}, {high:g}]")
        if self.weights is not None and (
            self.list_ is None or len(self.weights) != len(self.list_)
        ):
            raise ValueError("weights goes with list, one for each of its values")
        return self


class ControllerSection(Section):
    """A controller: a gain file, or a design with the options of ``lbt-synth design``."""

    model_config = ConfigDict(extra="allow")

    file: str | None = None
    design: str | None = None
    for_: Literal["configuration", "sample"] | None = Field(default=None, alias="for")

    @property
    def options(self) -> dict[str, Any]:
        """The options of the design that are given."""
        return dict(self.model_extra or {})

    @model_validator(mode="after")
    def _one_kind(self) -> ControllerSection:
        if (self.file is None) == (self.design is None):
            raise ValueError("expected exactly one of design, file")
        if self.design is None:
            foreign = [*(["for"] if self.for_ is not None else []), *self.options]
            if foreign:
                raise ValueError(f"{foreign[0]} goes with design, not with file")
        return self


class StudySection(Section):
    """A whole study file."""

    version: Annotated[int, Field(ge=1, le=1)]
    config: str
    samples: Annotated[int, Field(ge=1, le=2**30)]
    sampling: Literal["sobol", "latin_hypercube"] = "sobol"
    seed: Annotated[int, Field(ge=0)] = 0
    results: Literal["csv", "parquet"] = "csv"
    evaluation: Literal["exact", "simulation"] = "exact"
    controllers: Annotated[
        dict[Annotated[str, Field(pattern=_CONTROLLER_NAME)], ControllerSection],
        Field(min_length=1),
    ]
    parameters: Annotated[dict[str, ParameterSection], Field(min_length=1)]
