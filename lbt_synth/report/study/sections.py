"""The sections of a study's page: verdict, samples, comparison, dependence, worst samples."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.report import provenance
from lbt_synth.report.page.blocks import Block, Listing, Notice, Paragraph, Section
from lbt_synth.report.page.source_section import source_section
from lbt_synth.report.page.words import paragraph
from lbt_synth.report.study import charts
from lbt_synth.storage.array_file import digest
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.storage.words import duration_text
from lbt_synth.studies import Study
from lbt_synth.studies.grid import Failure
from lbt_synth.studies.study import summary
from lbt_synth.studies.study.statistics import (
    ControllerSamples,
    ControllerStatistics,
    StudyStatistics,
    read_column,
    read_controller_samples,
)
from lbt_synth.validation import FloatArray

_MOST_FAILURES = 10  # that are listed
_PARAMETERS = 5  # of a worst sample: with row and Strehl ratio, they fill a sheet
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
    files: tuple[provenance.SourceFile, ...]  # Files that it was read from
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
        source, content = provenance.read_source(path, role)
        files.append(source)
        if place < len(roles):
            texts[f"{role.capitalize()} {source.name}"] = content.decode("utf-8-sig", "replace")
    return StudyInfo(
        name=study.source.name,
        samples=study.samples,
        sampling=f"{_SAMPLING[settings.sampling]}, seed {settings.seed}",
        evaluation=_EVALUATION[settings.evaluation],
        parameters={name: section.text for name, section in settings.parameters.items()},
        controllers={name: section.text for name, section in settings.controllers.items()},
        digests={
            name: digest({matrix: getattr(each.controller, matrix) for matrix in "ABCD"}, {})
            for name, each in study.controllers.items()
            if isinstance(each, Design)
        },
        digest=study.digest,
        failures=tuple(failures),
        files=tuple(files),
        texts=texts,
        versions=provenance.program_versions(),
        made=provenance.creation_time(),
        computing_s=computing_s,
        replay=shlex.join(["lbt-synth", "study", os.fspath(study.source)])
        + f" -o {shlex.quote(os.fspath(directory))} --row {{row}}",
    )


def study_sections(
    info: StudyInfo, statistics: StudyStatistics, columns: Mapping[str, ArrayLike]
) -> list[Section]:
    """Return the sections of a study's page; columns (n,) have one value per sample."""
    found = [read_controller_samples(columns, each.controller) for each in statistics.controllers]
    if any(len(each.strehl) != statistics.samples for each in found):
        raise ProblemError(
            f"the columns must have the {statistics.samples} samples of the statistics; got "
            f"{len(found[0].strehl)}."
        )
    values = {
        name: read_column(columns, name, statistics.samples) for name in statistics.parameters
    }
    names = short_names(statistics.parameters)
    sections = (
        _summary_section(info, statistics, found),
        _samples_section(info, values, names),
        _controllers_section(info, statistics),
        _comparison_section(statistics, found),
        _dependence_section(statistics, found, values, names),
        _worst_section(info, statistics, columns, names),
        Section(
            key="reading",
            title="How to read the figures",
            blocks=tuple(Paragraph(text=paragraph(name)) for name in ("intervals", "indices")),
        ),
        _origin_section(info, statistics),
    )
    return [section for section in sections if section.blocks]


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return for each path its last keys, as many as distinguish it from the others."""
    out = {}
    for name in names:
        keys = name.split(".")
        for count in range(1, len(keys) + 1):
            out[name] = ".".join(keys[-count:])
            if sum(f".{other}".endswith(f".{out[name]}") for other in names) == 1:
                break
    return out


def _summary_section(
    info: StudyInfo, statistics: StudyStatistics, found: Sequence[ControllerSamples]
) -> Section:
    """Open with what is wrong, the verdict, and the Strehl ratios."""
    unstable = [each for each in statistics.controllers if each.unstable]
    failed = [each for each in statistics.controllers if each.failed]
    warnings = []
    if statistics.samples < info.samples:
        warnings.append(paragraph("incomplete", done=statistics.samples, samples=info.samples))
    if unstable:
        parts = ", ".join(
            f"{each.controller} in {each.unstable} of {each.samples} "
            f"({summary.percent(each.unstable_share.value, 2)} %)"
            for each in unstable
        )
        warnings.append(f"Unstable loops: {parts}.")
    if failed:
        parts = ", ".join(f"{each.controller} {each.failed}" for each in failed)
        warnings.append(f"Evaluations that failed, and are in none of the figures: {parts}.")
    blocks: list[Block] = [Notice(text=text, tone="bad") for text in warnings]
    if not unstable and not failed and statistics.samples:
        text = "Every controller is stable in every sample, and none failed."
        blocks.append(Notice(text=text, tone="good"))
    blocks += [
        Paragraph(text=_verdict_text(statistics.controllers)),
        summary.strehl_table(statistics),
    ]
    return Section(
        key="summary", title="Summary", blocks=(*blocks, *charts.distribution_chart(found))
    )


def _verdict_text(controllers: Sequence[ControllerStatistics]) -> str:
    """Say which controller leads by each measure; the reader decides which measure counts."""
    with_data = [each for each in controllers if each.samples]
    if not with_data:
        return "No controller was evaluated on any sample."

    def leader(value: Callable[[ControllerStatistics], float]) -> str:
        best = max(with_data, key=value)
        return f"{best.controller}, {summary.percent(value(best))} %"

    text = paragraph(
        "leaders",
        mean=leader(lambda each: each.mean),
        median=leader(lambda each: each.strehl[50].value),
        low=leader(lambda each: each.strehl[5].value),
    )
    least = min(with_data, key=lambda each: each.loss[95].value)
    loss = least.loss[95].value
    if len(with_data) == 1 or not np.isfinite(loss):
        return text
    return f"{text} {paragraph('regret', name=least.controller, loss=summary.percent(loss))}"


def _samples_section(
    info: StudyInfo, values: Mapping[str, FloatArray], names: Mapping[str, str]
) -> Section:
    """Show the parameters and their histograms."""
    rows = tuple(
        (
            names[name],
            name,
            info.parameters.get(name, ""),
            *_rounded_texts(np.percentile(column, (0, 50, 100))),
        )
        for name, column in values.items()
        if column.size
    )
    table = Table(
        caption="Parameters",
        headings=("parameter", "its place", "distribution", "least", "median", "greatest"),
        rows=rows,
        words=(1, 2),
    )
    opening = f"{info.samples} samples, {info.sampling}; {info.evaluation}."
    blocks = (
        Paragraph(text=opening),
        table,
        *(charts.parameter_chart(values, names) if rows else ()),
    )
    return Section(key="samples", title="What was sampled", blocks=blocks)


def _rounded_texts(values: FloatArray) -> list[str]:
    """Return numbers with four digits of their range, or of their size if all are equal."""
    span = float(np.ptp(values)) or float(np.max(np.abs(values))) or 1.0
    digits = 3 - int(np.floor(np.log10(span)))
    return [f"{round(float(value), digits) + 0.0:.6g}" for value in values]


def _controllers_section(info: StudyInfo, statistics: StudyStatistics) -> Section:
    """List the controllers, and evaluations that failed."""
    blocks: list[Block] = [
        Table(
            caption="Controllers",
            headings=("controller", "origin", "digest", "evaluated", "unstable", "failed"),
            rows=tuple(
                (
                    each.controller,
                    info.controllers.get(each.controller, ""),
                    info.digests.get(each.controller, "-")[:16],
                    str(each.samples),
                    _count_cell(each.unstable),
                    _count_cell(each.failed),
                )
                for each in statistics.controllers
            ),
            words=(1, 2),
        )
    ]
    if info.failures:
        more = len(info.failures) - _MOST_FAILURES
        blocks.append(
            Table(
                caption="Evaluations that failed"
                + (f": the first {_MOST_FAILURES}, and {more} more" if more > 0 else ""),
                headings=("row", "controller", "error"),
                rows=tuple(
                    (str(row), name, error) for row, name, error in info.failures[:_MOST_FAILURES]
                ),
                words=(1, 2),
            )
        )
    return Section(key="controllers", title="Controllers", blocks=tuple(blocks))


def _count_cell(count: int) -> Cell:
    return Cell(text=str(count), tone="bad" if count else "plain")


def _comparison_section(statistics: StudyStatistics, found: Sequence[ControllerSamples]) -> Section:
    """Compare the controllers on the same samples."""
    table = summary.comparison_table(statistics)
    blocks: tuple[Block, ...] = (
        *([table] if table.rows else []),
        *charts.loss_chart(found),
        summary.residual_table(statistics),
    )
    return Section(key="comparison", title="Comparison on the same samples", blocks=blocks)


def _dependence_section(
    statistics: StudyStatistics,
    found: Sequence[ControllerSamples],
    values: Mapping[str, FloatArray],
    names: Mapping[str, str],
) -> Section:
    """Show what the Strehl ratio depends on."""
    if not statistics.ranked:
        blocks: tuple[Block, ...] = (Notice(text=paragraph("no-index")),)
        return Section(key="dependence", title="Dependence", blocks=blocks)
    blocks = (
        *charts.sensitivity_chart(statistics, names),
        summary.sensitivity_table(statistics, names=names),
        *charts.conditional_charts(statistics, names),
        *charts.map_charts(statistics, found, values, names),
    )
    return Section(key="dependence", title="What the Strehl ratio depends on", blocks=blocks)


def _worst_section(
    info: StudyInfo,
    statistics: StudyStatistics,
    columns: Mapping[str, ArrayLike],
    names: Mapping[str, str],
) -> Section:
    """List the worst samples, and the commands that replay them."""
    blocks: list[Block] = []
    commands = []
    most = 0
    for each in statistics.controllers:
        if each.worst:
            ranked = each.ranked
            others = tuple(name for name in statistics.parameters if name not in ranked)
            shown = (ranked or others)[:_PARAMETERS]
            most = max(most, len(ranked) - len(shown))
            table = summary.worst_table(each, columns, shown, names=names)
            blocks.append(table)
            commands.append(info.replay.replace("{row}", str(table.rows[0][0])))
    if most:
        blocks.insert(0, Paragraph(text=paragraph("worst", count=_PARAMETERS)))
    if commands:
        caption = "Commands that replay the first of each table; any other row likewise"
        blocks.append(Listing(caption=caption, text="\n".join(dict.fromkeys(commands))))
    return Section(key="worst", title="Worst samples", blocks=tuple(blocks))


def _origin_section(info: StudyInfo, statistics: StudyStatistics) -> Section:
    """Name the files and programs that the page was made from."""
    rows: list[tuple[str, str]] = [
        ("samples with results", f"{statistics.samples} of {info.samples}"),
        ("digest of the study", info.digest),
    ]
    if info.computing_s is not None:
        rows.append(("computing time, of all processes together", duration_text(info.computing_s)))
    about = Table(caption="Study", headings=("what", "value"), rows=tuple(rows), words=(1,))
    return source_section(info.files, versions=info.versions, texts=info.texts, about=about)
