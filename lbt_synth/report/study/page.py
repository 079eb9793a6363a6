"""The page of a robustness study, and the files that it becomes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.report.page.blocks import Page
from lbt_synth.report.page.page_files import require_page_names, write_page
from lbt_synth.report.provenance import time_text
from lbt_synth.report.study.sections import StudyInfo, study_info, study_sections
from lbt_synth.storage.words import count_text
from lbt_synth.studies import Study, study_statistics
from lbt_synth.studies.grid import Failure
from lbt_synth.studies.study.statistics import StudyStatistics


def write_study_page(
    study: Study,
    columns: Mapping[str, ArrayLike],
    path: str | os.PathLike[str],
    *,
    statistics: StudyStatistics | None = None,
    failures: Sequence[Failure] = (),
    computing_s: float | None = None,
    pdf: str | os.PathLike[str] | None = None,
) -> tuple[Path, ...]:
    """Write the page of a study as one HTML file that opens offline, and as a PDF if wanted.

    Parameters
    ----------
    study : Study
        The study.
    columns : mapping of str to (n,) array_like
        Its results, all or those that there are so far.
    path : path-like
        File to write, that ends in .html, in the directory of the results.
    statistics : StudyStatistics, optional
        Those of the columns, if they are known already.
    failures : sequence of (int, str, str), optional
        Row, controller and error of what failed.
    computing_s : float, optional
        Time of all its batches, of all processes together [s].
    pdf : path-like, optional
        File to write, that ends in .pdf.

    Returns
    -------
    tuple of pathlib.Path
        The files; all of them are written, or none.

    Raises
    ------
    ProblemError
        If the columns are not those of the study.
    OutputError
        If a name ends in something else, or a file cannot be written.

    Examples
    --------
    >>> import lbt_synth as lbt, pathlib, tempfile
    >>> study = lbt.studies.load_study("examples/study.yaml")
    >>> values = study.values(0, 2)
    >>> columns = dict(zip(study.parameter_names, values.T))
    >>> columns |= lbt.studies.evaluate_samples(study, values, 0)[0]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     files = lbt.report.write_study_page(
    ...         study, columns, pathlib.Path(folder) / "summary.html"
    ...     )
    >>> files[0].name
    'summary.html'
    """
    require_page_names(path, pdf, inputs=study.inputs)
    if statistics is None:
        names = tuple(study.controllers)
        statistics = study_statistics(columns, study.parameter_names, names)
    info = study_info(
        study, directory=Path(path).parent, failures=failures, computing_s=computing_s
    )
    return write_page(study_page(info, statistics, columns), path, pdf)


def study_page(
    info: StudyInfo, statistics: StudyStatistics, columns: Mapping[str, ArrayLike]
) -> Page:
    """Return the page of a study's results; columns (n,) have one value per sample."""
    sections = study_sections(info, statistics, columns)
    varying = sum(np.ptp(np.asarray(columns[name])) > 0 for name in statistics.parameters)
    return Page(
        title=f"Robustness study {info.name}",
        subtitle=(
            f"{statistics.samples} samples of {varying} parameters, "
            f"{count_text(len(statistics.controllers), 'controller')}. Made {time_text(info.made)}."
        ),
        sections=tuple(sections),
    )
