"""What the page of a study says besides its results."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from lbt_synth.archive import digest
from lbt_synth.report.making import SourceFile, read_source, time_of_making, versions
from lbt_synth.study import Failure, Study

_SAMPLING = {
    "sobol": "points of a scrambled Sobol sequence",
    "latin_hypercube": "a Latin hypercube",
}
_EVALUATION = {
    "exact": "each evaluated exactly, by integrals over its spectra",
    "simulation": "each simulated in the time domain",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyInfo:
    """What the page of a study says besides its results.

    Attributes
    ----------
    name : str
        Name of the study.
    samples : int
        Samples asked for.
    sampling, evaluation : str
        How they were drawn, and evaluated.
    parameters : dict of str to str
        Distribution of each parameter, in words.
    controllers : dict of str to str
        Origin of each controller, in words.
    digests : dict of str to str
        SHA-256 of the matrices of each controller that is the same for all samples.
    digest : str
        That of the study.
    failures : tuple of Failure
        What failed.
    files : tuple of SourceFile
        Files that it was read from.
    texts : dict of str to str
        The study file and the configuration, by their names.
    versions : tuple of (str, str)
        Programs and their versions.
    made : datetime
        When the page was made.
    computing_s : float or None
        Time of all its batches, of all processes together [s].
    replay : str
        Command that replays a sample, with ``{row}`` for its number.
    """

    name: str
    samples: int
    sampling: str
    evaluation: str
    parameters: dict[str, str]
    controllers: dict[str, str]
    digests: dict[str, str]
    digest: str
    failures: tuple[Failure, ...]
    files: tuple[SourceFile, ...]
    texts: dict[str, str]
    versions: tuple[tuple[str, str], ...]
    made: datetime
    computing_s: float | None
    replay: str


def study_info(
    study: Study,
    *,
    directory: str | os.PathLike[str],
    failures: Sequence[Failure] = (),
    computing_s: float | None = None,
) -> StudyInfo:
    """Collect what a page says of a study.

    Parameters
    ----------
    study : Study
        The study.
    directory : path-like
        Where its results are; for the command that replays a sample.
    failures : sequence of Failure, optional
        What failed.
    computing_s : float, optional
        Time of all its batches, of all processes together [s].

    Returns
    -------
    StudyInfo
        The same, in words.

    Raises
    ------
    FileError
        If a file that the study was read from cannot be read again.
    """
    settings = study.settings
    roles = ["study", "configuration"]
    files, texts = [], {}
    for place, path in enumerate(study.inputs):
        role = roles[place] if place < len(roles) else "gain file"
        source, content = read_source(path, role)
        files.append(source)
        if place < len(roles):
            texts[f"{role.capitalize()} {source.name}"] = content.decode("utf-8", "replace")
    return StudyInfo(
        name=study.source.name,
        samples=study.samples,
        sampling=f"{_SAMPLING[settings.sampling]}, seed {settings.seed}",
        evaluation=_EVALUATION[settings.evaluation],
        parameters={each.name: each.distribution.text for each in study.parameters},
        controllers={each.name: each.origin for each in study.controllers},
        digests={
            each.name: digest({name: getattr(each.design.controller, name) for name in "ABCD"}, {})
            for each in study.controllers
            if each.design is not None
        },
        digest=study.digest,
        failures=tuple(failures),
        files=tuple(files),
        texts=texts,
        versions=versions(),
        made=time_of_making(),
        computing_s=computing_s,
        replay=shlex.join(["lbt-synth", "study", os.fspath(study.source)])
        + f" -o {shlex.quote(os.fspath(directory))} --row {{row}}",
    )
