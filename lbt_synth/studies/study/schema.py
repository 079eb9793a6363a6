"""Schema of a study file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from lbt_synth.config.design_methods import METHOD_ROUTES, METHODS_WITHOUT_HORIZON, OPTION_METHODS
from lbt_synth.config.schema import Positive, Section

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

    file: str | None = None
    design: (
        Literal["kalman", "hinf", "mixed", "lqg", "robust", "polytopic", "integrator"] | None
    ) = None
    for_: Literal["configuration", "sample"] | None = Field(default=None, alias="for")
    route: str | None = None
    gamma: Positive | None = None
    gamma_ratio: Annotated[float, Field(ge=1)] | None = None
    rms: Positive | None = None
    taps: Annotated[int, Field(ge=1, le=64)] | None = None
    norm: Literal["hinf", "h2"] | None = None
    half_width_hz: Positive | None = None
    command_weight: Annotated[float, Field(ge=0)] | None = None
    gain: Positive | None = None
    horizon: Annotated[int, Field(ge=0)] | None = None

    @property
    def options(self) -> dict[str, Any]:
        """The options of the design that are given."""
        named = {name: getattr(self, name) for name in ("route", "horizon", *OPTION_METHODS)}
        return {name: value for name, value in named.items() if value is not None}

    @model_validator(mode="after")
    def _one_kind(self) -> ControllerSection:
        if (self.file is None) == (self.design is None):
            raise ValueError("expected exactly one of design, file")
        if self.design is None:
            foreign = [*(["for"] if self.for_ is not None else []), *self.options]
            if foreign:
                raise ValueError(f"{foreign[0]} goes with design, not with file")
            return self
        for name in self.options:
            owners = OPTION_METHODS.get(name)
            if owners is not None and self.design not in owners:
                raise ValueError(f"{name} goes with design: {' or '.join(owners)}")
        if self.route is not None and self.route not in METHOD_ROUTES[self.design]:
            known = " or ".join(METHOD_ROUTES[self.design]) or "no route"
            raise ValueError(f"design: {self.design} takes {known}; got route {self.route!r}")
        if self.design == "polytopic" and self.half_width_hz is None:
            raise ValueError("design: polytopic needs half_width_hz")
        if self.horizon is not None and self.design in METHODS_WITHOUT_HORIZON:
            raise ValueError(f"design: {self.design} takes no horizon")
        if sum(v is not None for v in (self.gamma, self.gamma_ratio, self.rms)) > 1:
            raise ValueError("expected at most one of gamma, gamma_ratio, rms")
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
