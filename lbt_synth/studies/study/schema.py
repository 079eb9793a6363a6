"""Schema of a study file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, model_validator

from lbt_synth.methods.section import Section
from lbt_synth.studies.study.distributions import ParameterSection

_CONTROLLER_NAME = r"^[A-Za-z][A-Za-z0-9_-]*$"


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
