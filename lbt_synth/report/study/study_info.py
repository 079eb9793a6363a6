"""What the page of a study says besides its results."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from lbt_synth.report.provenance import SourceFile, creation_time, program_versions, read_source
from lbt_synth.storage.array_file import digest
from lbt_synth.studies import Failure, Study

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
    """What the page of a study says besides its results."""

    name: str  # Name of the study's file
    samples: int  # How many samples it is to have
    sampling: str  # How they are drawn
    evaluation: str  # How they are evaluated
    parameters: dict[str, str]  # Distribution of each parameter, in words
    controllers: dict[str, str]  # Origin of each controller, in words
    # SHA-256 of the matrices of each controller that is the same for all samples
    digests: dict[str, str]
    digest: str  # Digest of the study
    failures: tuple[Failure, ...]  # Evaluations that failed
    files: tuple[SourceFile, ...]  # Files that it was read from
    texts: dict[str, str]  # The study file and the configuration, by their names
    versions: tuple[tuple[str, str], ...]  # Programs and their versions
    made: datetime  # When the page was made
    computing_s: float | None  # Time of all its batches, of all processes together [s]
    replay: str  # Command that replays a sample, with ``{row}`` for its number


def study_info(
    study: Study,
    *,
    directory: str | os.PathLike[str],
    failures: Sequence[Failure] = (),
    computing_s: float | None = None,
) -> StudyInfo:
    """Collect what a page says of a study."""
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
        versions=program_versions(),
        made=creation_time(),
        computing_s=computing_s,
        replay=shlex.join(["lbt-synth", "study", os.fspath(study.source)])
        + f" -o {shlex.quote(os.fspath(directory))} --row {{row}}",
    )
