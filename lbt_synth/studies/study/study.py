"""A Monte Carlo study: its file, the rows of its samples, and the loop of each."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, model_validator

import lbt_synth
from lbt_synth.config import Config, load_config
from lbt_synth.config.load import build_config, read_mapping, validate_sections
from lbt_synth.config.samples import Keys, find_number, parse_path, set_number
from lbt_synth.config.schema import FileSection
from lbt_synth.design import Design
from lbt_synth.errors import (
    ConfigError,
    LbtSynthError,
    ProblemError,
    name_file,
    name_key,
    refuse_config,
)
from lbt_synth.files.gain_file.store import load_with_digest
from lbt_synth.methods.method import Section
from lbt_synth.methods.registry import method_named
from lbt_synth.methods.request import DesignRequest, design_request
from lbt_synth.models import LoopHardware, Truth
from lbt_synth.studies.grid import RESIDUALS
from lbt_synth.validation import FloatArray, integer

DELAY_ERROR = "error.delay_frames"
NOISE_FACTOR = "error.noise_factor"
_EDGE = 2.0**-32  # levels stay this far from 0 and 1, where a normal quantile is infinite
# of one sample: what designs assume, the real loop, and what that really meets
Sample = tuple[Config, LoopHardware, Truth]
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


class ParameterSection(Section):
    """The distribution of one parameter; a bare number is fixed."""

    fixed: float | None = None
    uniform: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    normal: NormalSection | None = None
    list_: Annotated[list[float], Field(min_length=1)] | None = Field(default=None, alias="list")
    also: list[str] = Field(default_factory=list)

    @model_validator(mode="before")
    @classmethod
    def _bare_number(cls, value: Any) -> Any:
        return {"fixed": value} if isinstance(value, int | float) else value

    @model_validator(mode="after")
    def _one_distribution(self) -> ParameterSection:
        laws = [v is not None for v in (self.fixed, self.uniform, self.normal, self.list_)]
        if sum(laws) != 1:
            raise ValueError("expected a number or exactly one of fixed, uniform, normal, list")
        if self.uniform is not None and not self.uniform[0] < self.uniform[1]:
            low, high = self.uniform
            raise ValueError(f"uniform: must be [low, high]; got [{low:g}, {high:g}]")
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
        if len(shown) > 8:
            shown[4:-3] = ["..."]
        return f"one of {', '.join(shown)}"

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return the values below which each share ``level``, in [0, 1), lies."""
        from scipy.stats import truncnorm

        if self.normal is not None:
            mean, deviation = self.normal.mean, self.normal.deviation
            cuts = ((end - mean) / deviation for end in self.normal.ends)
            standard = truncnorm.ppf(np.clip(level, _EDGE, 1 - _EDGE), *cuts)
            with np.errstate(over="ignore"):  # an infinite value is refused later
                return np.clip(mean + deviation * standard, *self.normal.ends)
        if self.uniform is not None:
            low, high = self.uniform
            return np.clip(low + level * (high - low), low, high)
        return np.array(self.values)[(level * len(self.values)).astype(np.int64)]

    def extremes(self, samples: int) -> tuple[float, float]:
        """Return the ends, or values beyond which half a sample is expected."""
        if self.normal is None:
            return min(self.uniform or self.values), max(self.uniform or self.values)
        inside, ends = self.quantile(np.array([0.5 / samples, 1 - 0.5 / samples])), self.normal.ends
        low, high = np.where(np.isfinite(ends), ends, inside).tolist()
        return low, high


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
        options = ", ".join(f"{name} {value}" for name, value in self.options.items())
        method = f"{self.design} ({options})" if options else f"{self.design}"
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
    seed: Annotated[int, Field(ge=0)] = 0
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
            name: controller
            for name, controller in self.controllers.items()
            if self.settings.controllers[name].file is None and isinstance(controller, Design)
        }

    @property
    def result_columns(self) -> tuple[str, ...]:
        """Names of the results, controller by controller."""
        return tuple(c for name in self.controllers for c in result_columns(name))

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
        columns = [law.quantile(next(levels) if law.varies else none) for law in distributions]
        return np.stack(columns, axis=1)

    def parameters_by_name(self, values: Sequence[float] | FloatArray) -> dict[str, float]:
        """Return a row of :meth:`values` as a dictionary."""
        return dict(zip(self.parameter_names, np.asarray(values).tolist(), strict=True))


def result_columns(controller: str) -> tuple[str, ...]:
    """Return the names of the results of one controller."""
    return tuple(f"{controller}.{name}" for name in ("strehl", *RESIDUALS, "stable"))


def unit_points(settings: StudySection, dimensions: int, start: int, stop: int) -> FloatArray:
    """Return points ``start`` to ``stop`` of a study's Sobol sequence, (., dimensions) in [0, 1).

    The seed fixes every point. A longer sequence begins with the same points, and is balanced where
    it has 2^k of them.
    """
    if dimensions == 0 or stop == start:
        return np.zeros((stop - start, dimensions))
    engine = _sampler(dimensions, settings.seed).reset()
    if start > 0:
        return np.asarray(engine.fast_forward(start).random(stop - start))
    # a first number of points that is no power of 2 is warned of
    return np.asarray(engine.random(1 << (stop - 1).bit_length())[:stop])


@lru_cache(maxsize=1)
def _sampler(dimensions: int, seed: int) -> Any:
    """Return a sampler, whose scrambling takes longer than a part."""
    from scipy.stats import qmc

    return qmc.Sobol(dimensions, seed=np.random.default_rng(seed))


def is_error(parameter: str) -> bool:
    """Whether a parameter is an error of the loop, which is in no configuration."""
    return parameter.split(".")[0] == "error"


def make_sample(study: Study, values: Sequence[float] | FloatArray) -> Sample:
    """Make the sample of a row of ``Study.values``."""
    base, parameters = study.config, study.parameters_by_name(values)
    full = base.settings.model_dump()
    content = base.settings.model_dump(exclude_unset=True)
    for name, places in study.places.items():
        for keys in places:
            set_number(content, keys, parameters[name], full=full)
    config = build_config(validate_sections(FileSection, content, base.source), base.source)
    delay_error, factor = parameters.get(DELAY_ERROR, 0.0), parameters.get(NOISE_FACTOR, 1.0)
    hardware, truth = config.hardware, config.truth
    with refuse_config(f"the real loop, with {DELAY_ERROR} and {NOISE_FACTOR}"):
        if delay_error != 0:
            hardware = replace(hardware, delay_frames=hardware.delay_frames + delay_error)
        if factor != 1:
            truth = replace(truth, noise_nm=truth.noise_nm * factor)
    return config, hardware, truth


def design_for_sample(controller: Design | DesignRequest, sample: Sample) -> Design:
    """Return a controller's design, made for the sample if it has none for all."""
    return controller if isinstance(controller, Design) else sample[0].design(controller)


def load_study(path: str | os.PathLike[str]) -> Study:
    """Read a study file, check it, and design the controllers that are for the whole study.

    It checks the file, the configuration and the gain files, that every parameter is a number of
    the configuration, and that the configuration accepts the ends of each parameter, with the
    others in the middle of their distributions or lists.

    Parameters
    ----------
    path : path-like
        The file (YAML).

    Returns
    -------
    Study
        The study.

    Raises
    ------
    ConfigError
        If the file or the configuration is refused; ``path`` on the error is that of the key.
    GainFileError
        If a gain file cannot be read.
    SynthesisError
        If a design cannot be made.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> study = lbt.studies.load_study("examples/study.yaml")
    >>> study.samples, study.parameter_names[0]
    (4096, 'atmosphere.seeing_arcsec')
    >>> study.values(0, 2).shape[1] == len(study.parameter_names)
    True
    """
    source = Path(path)
    settings = validate_sections(StudySection, read_mapping(source), source)
    _require_names(settings, source)
    config_file = source.parent / settings.config
    config = load_config(config_file)
    if config.hardware.modes > 2:  # a Strehl ratio of jitter takes one or two axes
        raise ConfigError(
            f"{config_file}: a study is of one or two axes; got a loop of {config.hardware.modes}."
        )
    sections = settings.controllers.items()
    files = {name: source.parent / s.file for name, s in sections if s.file is not None}
    gains = {name: load_with_digest(file) for name, file in files.items()}
    _require_places(settings, config, source)
    study = Study(
        source=source,
        settings=settings,
        config=config,
        controllers={},
        digest=_digest(settings, config, {name: digest for name, (_, digest) in gains.items()}),
        inputs=(source, config_file, *files.values()),
    )
    samples = []
    for where, values in _corners(study):
        with refuse_config(f"{source}: {where}", where.split(" ")[0]):
            samples.append((where, make_sample(study, values)))
    if config.truth.drifts:
        raise ConfigError(
            f"{config_file}: a vibration of the truth drifts, so that there is no exact answer; "
            "give it one frequency, or simulate it.",
            path="config",
        )
    study = replace(
        study,
        controllers={
            name: gains[name][0] if name in files else _make_controller(study, name)
            for name in settings.controllers
        },
    )
    for name, controller in study.controllers.items():
        if isinstance(controller, Design):
            for where, (_, hardware, truth) in samples:
                with refuse_config(f"{source}: controllers.{name}, {where}"):
                    controller.close(hardware, sensor_gain=truth.sensor_gain)
    return study


def _require_names(settings: StudySection, source: Path) -> None:
    """Refuse names of controllers that are those of other files or columns."""
    first: dict[str, str] = {}
    for name in settings.controllers:
        other = first.setdefault(name.casefold(), name)
        taken = [p for p in settings.parameters if p in result_columns(name)]
        if other != name:
            why = f"its files need a name that differs by more than its case from {other}"
        elif name.casefold().startswith("row_"):
            why = "names that begin with row_ are those of replayed samples; give another"
        elif taken:
            why = f"{taken[0]} is both a parameter and a result; give the controller another name"
        else:
            continue
        raise ConfigError(f"{source}: controllers.{name}: {why}.", path=f"controllers.{name}")


def _make_controller(study: Study, name: str) -> Design | DesignRequest:
    """Return a controller that the study designs, once unless each sample has its own."""
    section, place = study.settings.controllers[name], f"controllers.{name}"
    method = str(section.design)
    with name_file(study.source), name_key(f"{place}.design"):
        method_named(method)
    with refuse_config(f"{study.source}: {place}", place):
        request = design_request(method, section.options)
    if section.for_ == "sample":
        return request
    try:
        return study.config.design(request)
    except LbtSynthError as error:
        error.args = (f"{study.source}: {place}: {error}",)
        raise


def _digest(settings: StudySection, config: Config, gains: dict[str, str]) -> str:
    """Return the digest of all that decides the results: not the names of files."""
    study = settings.model_dump(by_alias=True, exclude={"config"})
    for section in study["controllers"].values():
        del section["file"]
    content = {
        "version": lbt_synth.__version__,
        "study": study,
        "config": config.settings.model_dump(),
        "gains": gains,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _require_places(settings: StudySection, config: Config, source: Path) -> None:
    """Refuse parameters that are no numbers of the configuration, or are given twice."""
    full = config.settings.model_dump()
    taken: dict[Keys, str] = {}
    for name, section in settings.parameters.items():
        with refuse_config(f"{source}: parameters.{name}", f"parameters.{name}"):
            if is_error(name) and name not in (DELAY_ERROR, NOISE_FACTOR):
                errors = f"{DELAY_ERROR} and {NOISE_FACTOR}"
                raise ConfigError(f"the errors of a loop are {errors}; got {name}.")
            if is_error(name) and section.also:
                raise ConfigError("an error of the loop is in no configuration; leave also out.")
            for place in () if is_error(name) else (name, *section.also):
                if isinstance(find_number(full, place), int) and not section.values:
                    raise ConfigError(
                        "it is an integer, which takes a list of values; got a distribution of all "
                        "numbers."
                    )
                keys = parse_path(place)
                if keys in taken:
                    raise ConfigError(f"{place} is given twice, by {taken[keys]} and {name}.")
                taken[keys] = name


def _corners(study: Study) -> Iterator[tuple[str, list[float]]]:
    """Yield the middles, then the ends of each parameter with the others in the middle."""
    parameters = study.settings.parameters
    centre = [float(section.quantile(np.array([0.5]))[0]) for section in parameters.values()]
    yield "parameters in the middle", centre
    for i, (name, section) in enumerate(parameters.items()):
        for end in section.extremes(study.samples) if section.varies else ():
            yield f"parameters.{name} at {end:g}", [*centre[:i], end, *centre[i + 1 :]]
