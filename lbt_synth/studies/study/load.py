"""Read a study file, and check all that can be checked before it runs."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import lbt_synth
from lbt_synth.config import Config, load_config
from lbt_synth.config.load import read_mapping, validate_sections
from lbt_synth.config.samples import Keys, find_number, parse_path
from lbt_synth.design import Design
from lbt_synth.errors import ConfigError, LbtSynthError, name_file, name_key, refuse_config
from lbt_synth.files.gain_file.store import load_with_digest
from lbt_synth.methods import method_named
from lbt_synth.methods.request import DesignRequest, Wording, design_request, fixed_design
from lbt_synth.studies.study.sample import close_sample_loop, make_sample
from lbt_synth.studies.study.study import (
    DELAY_ERROR,
    NOISE_FACTOR,
    Study,
    StudySection,
    is_error,
    result_columns,
)


def load_study(path: str | os.PathLike[str]) -> Study:
    """Read a study file, check it, and design the controllers that are for the whole study.

    It checks the file, the configuration and the gain files, that every parameter is a number of
    the configuration, and that the configuration accepts the ends of each parameter, with the
    others at their medians.

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
    if config.truth.drifts and settings.evaluation == "exact":
        raise ConfigError(
            f"{source}: a vibration of the truth drifts, so that there is no exact answer; "
            "set evaluation: simulation.",
            path="evaluation",
        )
    study = replace(
        study,
        controllers={
            name: gains[name][0] if name in files else _make_controller(study, name)
            for name in settings.controllers
        },
    )
    for name, controller in study.controllers.items():
        if (design := fixed_design(controller)) is not None:
            for where, sample in samples:
                with refuse_config(f"{source}: controllers.{name}, {where}"):
                    close_sample_loop(sample, design)
    return study


def _require_names(settings: StudySection, source: Path) -> None:
    """Refuse names of controllers that are those of other files or columns."""
    first: dict[str, str] = {}
    for name in settings.controllers:
        other = first.setdefault(name.casefold(), name)
        taken = [p for p in settings.parameters if p in result_columns(name, settings.evaluation)]
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
    with refuse_config(f"{study.source}", place):
        words = Wording(method="design: {}", place=place)
        request = design_request(method, section.options, words)
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
    """Yield the medians, then the ends of each parameter with the others at their medians."""
    parameters = study.settings.parameters
    centre = [section.median() for section in parameters.values()]
    yield "parameters in the middle", centre
    for i, (name, section) in enumerate(parameters.items()):
        for end in section.extremes(study.samples) if section.varies else ():
            yield f"parameters.{name} at {end:g}", [*centre[:i], end, *centre[i + 1 :]]
