"""Read a study file, and check all that can be checked before it runs."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from lbt_synth.config import Config, load_config
from lbt_synth.config.load import read_mapping, validate_sections
from lbt_synth.config.samples import Keys
from lbt_synth.design import Design
from lbt_synth.errors import ConfigError, LbtSynthError, name_file, name_key
from lbt_synth.files.gain_file.store import load_with_digest
from lbt_synth.methods import method_named
from lbt_synth.methods.request import DesignRequest, Wording, design_request
from lbt_synth.studies.study.config_keys import is_integer, parse_path, require_number
from lbt_synth.studies.study.distributions import Distribution, Fixed, Listed, Normal, Uniform
from lbt_synth.studies.study.reference_evaluation import close_sample_loop
from lbt_synth.studies.study.sample import Sample, make_sample
from lbt_synth.studies.study.schema import ParameterSection, StudySection
from lbt_synth.studies.study.store import read_design, read_manifest, require_same_study
from lbt_synth.studies.study.study import ERRORS, Parameter, Study, StudyController

# The oldest version whose results this one repeats to rounding: studies that it began are read
# and resumed. Raise it with any change that moves a result.
# the digest names these options of a controller also where they are not given
_OPTIONS_IN_DIGEST = {
    *("route", "horizon", "gamma", "gamma_ratio", "rms", "taps"),
    *("norm", "half_width_hz", "command_weight", "gain"),
}
_WORDING = Wording(method="design: {}")
_SAME_RESULTS_SINCE = "0.1.0"
_MOST_MODES = 2  # a Strehl ratio of jitter takes one or two axes


def load_study(
    path: str | os.PathLike[str], *, directory: str | os.PathLike[str] | None = None
) -> Study:
    """Read a study file, check it, and design the controllers that are for the whole study.

    It checks the file, the configuration and the gain files, that every parameter is a number of
    the configuration, and that the configuration accepts the ends of each parameter, with the
    others at their medians.

    Parameters
    ----------
    path : path-like
        The file (YAML).
    directory : path-like, optional
        Directory of the study. If it was begun there, its designs are read from it.

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
    OutputError
        If the directory belongs to another study, or a design in it was changed.

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
    config_file = source.parent / settings.config
    config = load_config(config_file)
    if config.hardware.modes > _MOST_MODES:
        raise ConfigError(
            f"{config_file}: a study is of one or two axes; got a loop of {config.hardware.modes}."
        )
    names = list(settings.controllers)
    _require_file_names(names, source)
    gains: dict[str, tuple[Design, str]] = {}
    files: dict[str, Path] = {}
    for name, section in settings.controllers.items():
        if section.file is not None:
            files[name] = source.parent / section.file
            gains[name] = load_with_digest(files[name])
    study = Study(
        source=source,
        settings=settings,
        config=config,
        parameters=_parameters(settings, config, source),
        controllers=(),
        digest=_digest(settings, config, {name: digest for name, (_, digest) in gains.items()}),
        inputs=(source, config_file, *files.values()),
    )
    samples = [(where, _checked_sample(study, where, values)) for where, values in _corners(study)]
    stored = _read_designs(study, directory)
    controllers = []
    for name, section in settings.controllers.items():
        if section.file is not None:
            entry = StudyController(
                name=name, request=None, design=gains[name][0], origin=str(files[name])
            )
        else:
            assert section.design is not None  # the schema requires a file or a design
            with name_file(source), name_key(f"controllers.{name}.design"):
                method_named(section.design)
            with name_file(source), name_key(f"controllers.{name}"):
                request = design_request(section.design, section.options, _WORDING)
            own = section.for_ == "sample"
            design = (
                None if own else stored.get(name) or _make_design(name, request, config, source)
            )
            scope = "for each sample" if own else "for the configuration"
            entry = StudyController(
                name=name, request=request, design=design, origin=f"{request.text} {scope}"
            )
        controllers.append(entry)
        if entry.design is not None:
            for where, sample in samples:
                _require_fitting(entry.design, sample, f"{source}: controllers.{name}, {where}")
    study = replace(study, controllers=tuple(controllers))
    clash = set(study.parameter_names) & set(study.result_columns)
    if clash:
        name = min(clash)
        raise ConfigError(
            f"{source}: {name} is both a parameter and a result; give the controller "
            f"{name.split('.')[0]} another name.",
            path=f"controllers.{name.split('.')[0]}",
        )
    return study


def _read_designs(study: Study, directory: str | os.PathLike[str] | None) -> dict[str, Design]:
    """Return the designs of a study in its directory, none if it was not begun there."""
    if directory is None or (manifest := read_manifest(Path(directory))) is None:
        return {}
    require_same_study(manifest, study.digest, Path(directory))
    return {name: read_design(Path(directory), name, manifest) for name in manifest["designs"]}


def _make_design(name: str, request: DesignRequest, config: Config, source: Path) -> Design:
    try:
        return config.design(request)
    except LbtSynthError as error:
        error.args = (f"{source}: controllers.{name}: {error}",)
        raise


def _digest(settings: StudySection, config: Config, gains: dict[str, str]) -> str:
    """Return the digest of all that decides the results: not names of files, nor their format."""
    study = settings.model_dump(by_alias=True, exclude={"config", "results"})
    for section in study["controllers"].values():
        del section["file"]
        section |= dict.fromkeys(_OPTIONS_IN_DIGEST - section.keys())
    content = {
        "version": _SAME_RESULTS_SINCE,
        "study": study,
        "config": config.settings.model_dump(),
        "gains": gains,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _require_file_names(names: list[str], source: Path) -> None:
    """Refuse names that would give two controllers one file."""
    first: dict[str, str] = {}
    for name in names:
        other = first.setdefault(name.casefold(), name)
        if other != name:
            raise ConfigError(
                f"{source}: controllers.{name}: its files would have the names of {other}'s; "
                "give a name that differs by more than its case.",
                path=f"controllers.{name}",
            )
        if name.casefold().startswith("row_"):
            raise ConfigError(
                f"{source}: controllers.{name}: names that begin with row_ are those of replayed "
                "samples; give another.",
                path=f"controllers.{name}",
            )


def _parameters(settings: StudySection, config: Config, source: Path) -> tuple[Parameter, ...]:
    full = config.settings.model_dump()
    taken: dict[Keys | str, str] = {}
    out = []
    for name, section in settings.parameters.items():
        key = f"parameters.{name}"
        places: list[Keys] = []
        try:
            if name.split(".")[0] == "error":
                _require_error_name(name, section)
                taken[name] = name
            else:
                for place in (name, *section.also):
                    require_number(full, place)
                    keys = parse_path(place)
                    other = taken.setdefault(keys, name)
                    if other != name or keys in places:
                        raise ConfigError(f"{place} is given twice, by {other} and {name}.")
                    places.append(keys)
            distribution = _distribution(section)
            for keys in places:
                if is_integer(full, keys) and isinstance(distribution, Uniform | Normal):
                    raise ConfigError(
                        "it is an integer, which takes a list of values; got a distribution of "
                        "all numbers."
                    )
        except LbtSynthError as error:
            raise ConfigError(f"{source}: {key}: {error}", path=key) from error
        out.append(Parameter(name=name, places=tuple(places), distribution=distribution))
    return tuple(out)


def _require_error_name(name: str, section: ParameterSection) -> None:
    if name not in ERRORS:
        raise ConfigError(f"the errors of a loop are {' and '.join(ERRORS)}; got {name}.")
    if section.also:
        raise ConfigError("an error of the loop is in no configuration; leave also out.")


def _distribution(section: ParameterSection) -> Distribution:
    if section.fixed is not None:
        return Fixed(value=section.fixed)
    if section.uniform is not None:
        return Uniform(low=section.uniform[0], high=section.uniform[1])
    if section.normal is not None:
        given = {k: v for k, v in section.normal.model_dump().items() if v is not None}
        return Normal(**given)
    assert section.list_ is not None  # the schema requires exactly one
    weights = section.weights or [1.0] * len(section.list_)
    return Listed(values=tuple(section.list_), weights=tuple(weights))


def _corners(study: Study) -> Iterator[tuple[str, list[float]]]:
    """Yield the medians, then the ends of each parameter with the others at their medians."""
    centre = [parameter.distribution.median() for parameter in study.parameters]
    yield "parameters in the middle", centre
    for i, parameter in enumerate(study.parameters):
        if not parameter.distribution.varies:
            continue
        for end in parameter.distribution.extremes(study.samples):
            values = list(centre)
            values[i] = end
            yield f"parameters.{parameter.name} at {end:g}", values


def _checked_sample(study: Study, where: str, values: list[float]) -> Sample:
    try:
        sample = make_sample(study, np.array(values))
    except LbtSynthError as error:
        raise ConfigError(f"{study.source}: {where}: {error}", path=where.split(" ")[0]) from error
    if sample.truth.drifts and study.settings.evaluation == "exact":
        raise ConfigError(
            f"{study.source}: a vibration of the truth drifts, so that there is no exact answer; "
            "set evaluation: simulation.",
            path="evaluation",
        )
    return sample


def _require_fitting(design: Design, sample: Sample, where: str) -> None:
    try:
        close_sample_loop(sample, design)
    except LbtSynthError as error:
        raise ConfigError(f"{where}: {error}") from error
