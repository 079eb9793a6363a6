"""A Monte Carlo study: samples of a configuration, and the controllers evaluated on each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from lbt_synth.config import Config
from lbt_synth.config.samples import Keys
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.methods.request import DesignRequest
from lbt_synth.studies.study.schema import ParameterSection, StudySection
from lbt_synth.validation import FloatArray, integer

DELAY_ERROR = "error.delay_frames"
NOISE_FACTOR = "error.noise_factor"
ERRORS = (DELAY_ERROR, NOISE_FACTOR)
_BLOCK = 1 << 14  # points of a Sobol sequence that are drawn together
_PARTS = ("turbulence_nm", "vibration_nm", "noise_nm")
RESIDUALS = {"residual_nm": "rms_nm"} | {n: n for n in _PARTS}  # columns, attributes of budgets
EXACT_COLUMNS = ("strehl", *RESIDUALS, "stable")
SIMULATED_COLUMNS = ("strehl", "residual_nm", "stable")


def result_columns(controller: str, evaluation: str) -> tuple[str, ...]:
    """Return the names of the results of one controller."""
    names = EXACT_COLUMNS if evaluation == "exact" else SIMULATED_COLUMNS
    return tuple(f"{controller}.{name}" for name in names)


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """A number that varies over the samples."""

    name: str  # path in the configuration, ``error.delay_frames`` or ``error.noise_factor``
    places: tuple[Keys, ...]  # keys of every place that it sets; none for the two errors
    distribution: ParameterSection


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyController:
    """A controller that is evaluated on each sample."""

    name: str  # in the columns
    request: DesignRequest | None  # what to design; None for a gain file
    design: Design | None  # for all samples; None if each sample has its own
    origin: str  # gain file or design, in words

    @property
    def for_sample(self) -> bool:
        """Whether each sample has its own design."""
        return self.design is None

    @property
    def is_designed(self) -> bool:
        """Whether the study designs it once, for all samples."""
        return self.request is not None and self.design is not None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Study:
    """A checked study; made by :func:`load_study`.

    Attributes
    ----------
    source : pathlib.Path
        The study file.
    settings : StudySection
        Its values, checked.
    config : Config
        The configuration, unchanged.
    parameters : tuple of Parameter
        What varies, in the order of the file.
    controllers : tuple of StudyController
        What is evaluated, in the order of the file.
    digest : str
        SHA-256 of all that decides the results: settings, configuration, gain files, version of
        the package.
    inputs : tuple of pathlib.Path
        Files that the study was read from.
    """

    source: Path
    settings: StudySection
    config: Config
    parameters: tuple[Parameter, ...]
    controllers: tuple[StudyController, ...]
    digest: str
    inputs: tuple[Path, ...]

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.settings.samples

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, the columns of :meth:`values`."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def result_columns(self) -> tuple[str, ...]:
        """Names of the results, controller by controller."""
        evaluation = self.settings.evaluation
        return tuple(c for each in self.controllers for c in result_columns(each.name, evaluation))

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all columns of the results: row, parameters, results."""
        return ("row", *self.parameter_names, *self.result_columns)

    def values(self, start: int = 0, stop: int | None = None) -> FloatArray:
        """Return the parameters of samples ``start`` to ``stop``.

        Parameters
        ----------
        start, stop : int, optional
            Rows, the last not included; default all.

        Returns
        -------
        (stop - start, parameters) ndarray
            A row is the same whichever rows are requested with it.

        Raises
        ------
        ProblemError
            If there are no such rows.
        """
        start = integer(start, "start", at_least=0)
        stop = self.samples if stop is None else integer(stop, "stop", at_least=start)
        if stop > self.samples:
            raise ProblemError(f"the study has {self.samples} samples; got rows up to {stop}.")
        varying = [p for p in self.parameters if p.distribution.varies]
        points = unit_points(self.settings, len(varying), start, stop)
        levels = iter(points.T)
        out = np.empty((stop - start, len(self.parameters)))
        for column, parameter in enumerate(self.parameters):
            level = next(levels) if parameter.distribution.varies else np.zeros(stop - start)
            out[:, column] = parameter.distribution.quantile(level)
        return out

    def simulation_seed(self, row: int) -> int:
        """Return the seed of the simulation of one sample."""
        drawn = np.random.SeedSequence(self.settings.seed, spawn_key=(row,)).generate_state(1)
        return int(drawn[0])

    def parameters_by_name(self, values: Sequence[float] | FloatArray) -> dict[str, float]:
        """Return a row of :meth:`values` as a dictionary."""
        return dict(zip(self.parameter_names, np.asarray(values).tolist(), strict=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """A controller without a result on a sample.

    Attributes
    ----------
    row : int
        The sample, from 0.
    controller : str
        Name of the controller.
    error : str
        What went wrong.
    """

    row: int
    controller: str
    error: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BatchResult:
    """Results of consecutive samples.

    Attributes
    ----------
    start : int
        Row of the first sample.
    columns : mapping of str to (b,) ndarray
        Results by column, one of ``Study.result_columns``; nan without a result.
    failures : tuple of Failure
        In the order of their rows.
    """

    start: int
    columns: Mapping[str, FloatArray]
    failures: tuple[Failure, ...] = ()


def unit_points(settings: StudySection, dimensions: int, start: int, stop: int) -> FloatArray:
    """Return points ``start`` to ``stop`` of a study's sampling, (., dimensions) in [0, 1).

    The seed fixes every point. A longer Sobol sequence begins with the same points, and is
    balanced where it has 2^k of them. A Latin hypercube is made as a whole, once per process.
    """
    if dimensions == 0 or stop == start:
        return np.zeros((stop - start, dimensions))
    if settings.sampling == "latin_hypercube":
        return _hypercube(settings.samples, dimensions, settings.seed)[start:stop]
    first, last = start // _BLOCK, (stop - 1) // _BLOCK
    draw = _known_sobol_points if first == last else _sobol_points  # a part of one block, or more
    points = draw(dimensions, settings.seed, first, last)
    return points[start - first * _BLOCK : stop - first * _BLOCK]


def _sobol_points(dimensions: int, seed: int, first: int, last: int) -> FloatArray:
    """Return the points of some blocks of a sequence, (n, dimensions)."""
    from scipy.stats import qmc

    engine = qmc.Sobol(dimensions, scramble=True, seed=np.random.default_rng(seed))
    if first > 0:
        engine.fast_forward(first * _BLOCK)
    points = np.concatenate([engine.random(_BLOCK) for _ in range(first, last + 1)])
    points.setflags(write=False)
    return points


_known_sobol_points = lru_cache(maxsize=1)(_sobol_points)  # scrambling takes longer than a batch


@lru_cache(maxsize=1)
def _hypercube(samples: int, dimensions: int, seed: int) -> FloatArray:
    from scipy.stats import qmc

    engine = qmc.LatinHypercube(dimensions, seed=np.random.default_rng(seed))
    points = np.asarray(engine.random(samples))
    points.setflags(write=False)
    return points
