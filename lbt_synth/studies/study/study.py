"""A Monte Carlo study: its file, and the rows of its samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from lbt_synth.config import Config
from lbt_synth.config.samples import Keys, parse_path
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.methods.method import Section
from lbt_synth.methods.request import DesignRequest, fixed_design
from lbt_synth.studies.grid import RESIDUALS
from lbt_synth.validation import FloatArray, integer

DELAY_ERROR = "error.delay_frames"
NOISE_FACTOR = "error.noise_factor"
EXACT_COLUMNS = ("strehl", *RESIDUALS, "stable")
SIMULATED_COLUMNS = ("strehl", "residual_nm", "stable")
_EDGE = 2.0**-32  # levels stay this far from 0 and 1, where a normal quantile is infinite
ControllerName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$", max_length=100)]


class NormalSection(Section):
    """A normal distribution, cut at low and high if they are given."""

    mean: float
    deviation: Annotated[float, Field(gt=0)]
    low: float | None = None
    high: float | None = None

    @model_validator(mode="after")
    def _has_room(self) -> NormalSection:
        low, high = self.ends
        if not low < high:
            raise ValueError(f"low must be below high; got {low:g} and {high:g}")
        return self

    @property
    def ends(self) -> tuple[float, float]:
        """Least and greatest value; infinite without a cut."""
        low, high = self.low, self.high
        return -np.inf if low is None else low, np.inf if high is None else high

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return the values at levels in [0, 1)."""
        from scipy.stats import truncnorm

        low, high = ((end - self.mean) / self.deviation for end in self.ends)
        standard = truncnorm.ppf(np.clip(level, _EDGE, 1 - _EDGE), low, high)
        with np.errstate(over="ignore"):  # an infinite value is refused later
            return np.clip(self.mean + self.deviation * standard, *self.ends)


class ParameterSection(Section):
    """The distribution of one parameter; a bare number is fixed."""

    fixed: float | None = None
    uniform: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    normal: NormalSection | None = None
    list_: Annotated[list[float], Field(min_length=1)] | None = Field(default=None, alias="list")
    weights: Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=1)] | None = None
    also: list[str] = Field(default_factory=list)

    @model_validator(mode="before")
    @classmethod
    def _bare_number(cls, value: Any) -> Any:
        return {"fixed": value} if isinstance(value, int | float) else value

    @model_validator(mode="after")
    def _one_distribution(self) -> ParameterSection:
        given = [v is not None for v in (self.fixed, self.uniform, self.normal, self.list_)]
        if sum(given) != 1:
            raise ValueError("expected a number or exactly one of fixed, uniform, normal, list")
        if self.uniform is not None and not self.uniform[0] < self.uniform[1]:
            low, high = self.uniform
            raise ValueError(f"uniform: must be [low, high]; got [{low:g}, {high:g}]")
        if self.weights is not None and len(self.weights) != len(self.list_ or ()):
            raise ValueError("weights goes with list, one for each of its values")
        return self

    @property
    def values(self) -> list[float]:
        """The values of a list, or the fixed one; none of a continuous distribution."""
        return [self.fixed] if self.fixed is not None else self.list_ or []

    @property
    def varies(self) -> bool:
        """Whether it takes a dimension of the sampling."""
        return len(self.values) != 1

    @property
    def text(self) -> str:
        """Description for people."""
        if self.fixed is not None:
            return f"fixed at {self.fixed:g}"
        if self.uniform is not None:
            return f"uniform from {self.uniform[0]:g} to {self.uniform[1]:g}"
        if self.normal is not None:
            out = f"normal, {self.normal.mean:g} with deviation {self.normal.deviation:g}"
            ends = {"from": self.normal.low, "to": self.normal.high}
            return out + "".join(f", {k} {v:g}" for k, v in ends.items() if v is not None)
        shown = [f"{value:g}" for value in self.values]
        if len(set(self.weights or ())) > 1:
            shown = [f"{v} ({w:g})" for v, w in zip(shown, self.weights or (), strict=True)]
        if len(shown) > 8:
            shown[4:-3] = ["..."]
        return f"one of {', '.join(shown)}"

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return the values below which each share ``level``, in [0, 1), lies."""
        if self.normal is not None:
            return self.normal.quantile(level)
        if self.uniform is not None:
            low, high = self.uniform
            return np.clip(low + level * (high - low), low, high)
        bounds = np.cumsum(self.weights or [1.0] * len(self.values))
        return np.array(self.values)[np.searchsorted(bounds[:-1] / bounds[-1], level, side="right")]

    def extremes(self, samples: int) -> tuple[float, float]:
        """Return the ends, or values beyond which half a sample is expected."""
        given = self.normal.ends if self.normal is not None else self.uniform or self.values
        inside = self.quantile(np.array([0.5 / samples, 1 - 0.5 / samples])).tolist()
        low, high = (
            end if np.isfinite(end) else value
            for end, value in zip((min(given), max(given)), inside, strict=True)
        )
        return low, high

    def median(self) -> float:
        """Return the median; the middle one of a list."""
        if self.values:
            return sorted(self.values)[len(self.values) // 2]
        return float(self.quantile(np.array([0.5]))[0])


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

    @property
    def text(self) -> str:
        """Where it comes from, for people."""
        if self.file is not None:
            return self.file
        given = ", ".join(f"{name} {value}" for name, value in self.options.items())
        method = f"{self.design} ({given})" if given else f"{self.design}"
        return f"{method} for {'each sample' if self.for_ == 'sample' else 'the configuration'}"

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
    evaluation: Literal["exact", "simulation"] = "exact"
    controllers: Annotated[dict[ControllerName, ControllerSection], Field(min_length=1)]
    parameters: Annotated[dict[str, ParameterSection], Field(min_length=1)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Study:
    """A checked study; made by :func:`load_study`."""

    source: Path  # the study file
    settings: StudySection  # its values, checked
    config: Config  # the configuration, unchanged
    # what is evaluated, in the order of the file; a request is designed for each sample
    controllers: Mapping[str, Design | DesignRequest]
    # SHA-256 of all that decides the results: settings, configuration, gain files, version of the
    # package
    digest: str
    inputs: tuple[Path, ...]  # files that the study was read from

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.settings.samples

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, the columns of :meth:`values`."""
        return tuple(self.settings.parameters)

    @property
    def places(self) -> dict[str, tuple[Keys, ...]]:
        """The keys of every number that each parameter sets; none for the two errors."""
        return {
            name: tuple(map(parse_path, (name, *section.also))) if not is_error(name) else ()
            for name, section in self.settings.parameters.items()
        }

    @property
    def designed(self) -> dict[str, Design]:
        """The controllers that the study designs once, for all samples."""
        return {
            name: design
            for name, controller in self.controllers.items()
            if self.settings.controllers[name].file is None
            and (design := fixed_design(controller)) is not None
        }

    @property
    def result_columns(self) -> tuple[str, ...]:
        """Names of the results, controller by controller."""
        evaluation = self.settings.evaluation
        return tuple(c for name in self.controllers for c in result_columns(name, evaluation))

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all columns of the results: row, parameters, results."""
        return ("row", *self.parameter_names, *self.result_columns)

    def values(self, start: int = 0, stop: int | None = None) -> FloatArray:
        """Return the parameters of samples ``start`` to ``stop``, (stop - start, parameters).

        A row is the same whichever rows are requested with it.
        """
        start = integer(start, "start", at_least=0)
        stop = self.samples if stop is None else integer(stop, "stop", at_least=start)
        if stop > self.samples:
            raise ProblemError(f"the study has {self.samples} samples; got rows up to {stop}.")
        distributions = self.settings.parameters.values()
        varying = sum(distribution.varies for distribution in distributions)
        levels = iter(unit_points(self.settings, varying, start, stop).T)
        none = np.zeros(stop - start)
        columns = [each.quantile(next(levels) if each.varies else none) for each in distributions]
        return np.stack(columns, axis=1)

    def simulation_seed(self, row: int) -> int:
        """Return the seed of the simulation of one sample."""
        drawn = np.random.SeedSequence(self.settings.seed, spawn_key=(row,)).generate_state(1)
        return int(drawn[0])

    def parameters_by_name(self, values: Sequence[float] | FloatArray) -> dict[str, float]:
        """Return a row of :meth:`values` as a dictionary."""
        return dict(zip(self.parameter_names, np.asarray(values).tolist(), strict=True))


def result_columns(controller: str, evaluation: str) -> tuple[str, ...]:
    """Return the names of the results of one controller."""
    names = EXACT_COLUMNS if evaluation == "exact" else SIMULATED_COLUMNS
    return tuple(f"{controller}.{name}" for name in names)


def unit_points(settings: StudySection, dimensions: int, start: int, stop: int) -> FloatArray:
    """Return points ``start`` to ``stop`` of a study's sampling, (., dimensions) in [0, 1).

    The seed fixes every point. A longer Sobol sequence begins with the same points, and is
    balanced where it has 2^k of them. A Latin hypercube is made as a whole, once per process.
    """
    from scipy.stats import qmc

    if dimensions == 0 or stop == start:
        return np.zeros((stop - start, dimensions))
    if settings.sampling == "latin_hypercube":
        return _hypercube(settings.samples, dimensions, settings.seed)[start:stop]
    engine: qmc.Sobol = _sobol(dimensions, settings.seed).reset()
    if start > 0:
        return np.asarray(engine.fast_forward(start).random(stop - start))
    # a first number of points that is no power of 2 is warned of
    return np.asarray(engine.random(1 << (stop - 1).bit_length())[:stop])


@lru_cache(maxsize=1)
def _sobol(dimensions: int, seed: int) -> Any:
    """Return the sequence, as its scrambling takes longer than a batch."""
    from scipy.stats import qmc

    return qmc.Sobol(dimensions, scramble=True, seed=np.random.default_rng(seed))


@lru_cache(maxsize=1)
def _hypercube(samples: int, dimensions: int, seed: int) -> FloatArray:
    from scipy.stats import qmc

    engine = qmc.LatinHypercube(dimensions, seed=np.random.default_rng(seed))
    return np.asarray(engine.random(samples))


def is_error(parameter: str) -> bool:
    """Whether a parameter is an error of the loop, which is in no configuration."""
    return parameter.split(".")[0] == "error"
