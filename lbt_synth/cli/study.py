"""The command study: run a study, say what it would cost, or replay one of its rows."""

from __future__ import annotations

import contextlib
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lbt_synth.cli.output import Report, TableText, fact_table
from lbt_synth.cli.output_files import make_directory
from lbt_synth.cli.progress import count_progress, show_spinner
from lbt_synth.errors import ProblemError
from lbt_synth.report import write_study_page
from lbt_synth.storage.atomic_files import refuse_replacing
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.studies import (
    Failure,
    Study,
    StudyRun,
    StudyStatistics,
    estimate_study,
    load_study,
    replay_row,
    run_study,
    study_statistics,
    summary_tables,
)
from lbt_synth.studies.study.cluster import connect_cluster
from lbt_synth.studies.study.output_files import read_failures
from lbt_synth.studies.study.run import FinishedStudy, output_paths
from lbt_synth.studies.study.store import PAGE, PRINT
from lbt_synth.studies.study.summary import worst_table

_WORST = 3  # rows of each controller that are printed; the page has more


def run(arguments: Namespace) -> Report:
    """Run a study, say what it would cost, or replay one of its rows."""
    if arguments.jobs < 1:
        raise ProblemError(f"--jobs must be at least 1; got {arguments.jobs}.")
    folder = Path(arguments.output)
    with show_spinner("reading the study, designing", quiet=arguments.json):
        loaded = load_study(arguments.study, directory=folder)
    refuse_replacing(output_paths(folder, loaded), loaded.inputs)
    if arguments.dry_run:
        return _dry_run(loaded, arguments)
    if arguments.row is not None:
        return _replay(loaded, folder, arguments)
    return _run_study(loaded, folder, arguments)


def _run_study(loaded: Study, folder: Path, arguments: Namespace) -> Report:
    files = [folder / PAGE, *([folder / PRINT] if arguments.pdf else [])]
    study_run, statistics, new = _compute(loaded, folder, files, arguments)
    report = Report(
        data={
            "samples": study_run.samples,
            "computed": study_run.computed,
            "failures": study_run.failures,
            "retry": study_run.retry,
            "computing_seconds": study_run.computing_s,
            "seconds": study_run.seconds,
            "files": [str(path) for path in (study_run.results, study_run.failed, *files)],
        }
    )
    varying = [p.name for p in loaded.parameters if p.distribution.varies]
    report.data["statistics"] = asdict(statistics)
    report.tables = [_printed_table(table) for table in summary_tables(statistics)]
    report.tables += [
        _printed_table(worst_table(each, varying), rows=_WORST) for each in statistics.controllers
    ]
    report.notes.append(
        f"{study_run.computed} of {study_run.samples} samples computed in "
        f"{_duration(study_run.computing_s)}; with tables and page {_duration(study_run.seconds)}."
        if new
        else f"{folder} is finished: {study_run.samples} samples in {study_run.results.name}; none "
        "computed."
    )
    report.notes += _sampling_notes(loaded)
    if study_run.failures:
        report.notes.append(
            f"note: {study_run.failures} results failed, see {study_run.failed}."
            + (
                " Those that ended their process are tried again if it is started again."
                if study_run.retry
                else ""
            )
        )
    words = "written" if new else "there"
    report.notes += [f"{words}: {path}" for path in report.data["files"]]
    return report


def _compute(
    loaded: Study, folder: Path, files: Sequence[Path], arguments: Namespace
) -> tuple[StudyRun, StudyStatistics, bool]:
    """Run a study and write its page; return also whether anything was left to compute."""
    found: list[tuple[StudyStatistics, bool]] = []

    def summarise(results: FinishedStudy) -> None:
        found.append((_summarise(loaded, files, results), results.new))

    with _engine(arguments) as (executor, workers):
        make_directory(folder)
        with count_progress(
            total=loaded.samples, what="samples", quiet=arguments.json, rate=True
        ) as count:
            try:
                study_run = run_study(
                    loaded,
                    folder,
                    executor=executor,
                    jobs=arguments.jobs,
                    workers=workers,
                    progress=count,
                    whole=summarise,
                )
            except KeyboardInterrupt:
                note = (
                    f"lbt-synth: what is finished is kept in {folder}; start it again to continue"
                )
                print(note, file=sys.stderr)
                raise
    [(statistics, new)] = found
    return study_run, statistics, new


@contextlib.contextmanager
def _engine(arguments: Namespace) -> Iterator[tuple[Executor | None, int | None]]:
    """Yield the executor of ``--dask`` and its workers, or None for both with ``--jobs``."""
    if arguments.dask is None:
        yield None, None
        return
    with connect_cluster(arguments.dask) as cluster:
        yield cluster.executor, cluster.workers


def _summarise(loaded: Study, files: Sequence[Path], results: FinishedStudy) -> StudyStatistics:
    """Compute the statistics of a finished study, and write its page if it is missing."""
    page, *pdf = files
    statistics = study_statistics(
        results.columns,
        loaded.parameter_names,
        [controller.name for controller in loaded.controllers],
    )
    if results.new or not all(path.exists() for path in files):
        write_study_page(
            loaded,
            results.columns,
            page,
            statistics=statistics,
            failures=[
                Failure(row=row, controller=name, error=error)
                for row, name, error in read_failures(page.parent)
            ],
            computing_s=results.computing_s,
            pdf=pdf[0] if pdf else None,
        )
    return statistics


def _printed_table(table: Table, rows: int | None = None) -> TableText:
    cells = [
        [cell.text if isinstance(cell, Cell) else cell for cell in row] for row in table.rows[:rows]
    ]
    width = len(table.headings)
    return TableText(
        title=table.caption,
        headings=table.headings,
        rows=[row + [""] * (width - len(row)) for row in cells],
    )


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.3g} s"
    if seconds < 6000:
        return f"{seconds / 60:.3g} min"
    hours = seconds / 3600
    return f"{hours:.3g} h" if hours < 100 else f"{hours / 24:.3g} days"


def _sampling_notes(loaded: Study) -> list[str]:
    if loaded.settings.sampling != "sobol" or loaded.samples & (loaded.samples - 1) == 0:
        return []
    return [
        "note: Sobol's points are balanced best when their number is a power of two; "
        f"{loaded.samples} is none."
    ]


def _dry_run(loaded: Study, arguments: Namespace) -> Report:
    with _engine(arguments) as (_, workers):
        count = workers or arguments.jobs
    with show_spinner("measuring a batch", quiet=arguments.json):
        cost = estimate_study(loaded, workers=count, local=workers is None)
    where = f"{count} {'process' if count == 1 else 'processes'}"
    if workers is not None:
        where = f"{count} threads of {arguments.dask}, as quick as this one"
    settings = loaded.settings
    return Report(
        data={
            "samples": loaded.samples,
            "sampling": settings.sampling,
            "evaluation": settings.evaluation,
            "parameters": {p.name: p.distribution.text for p in loaded.parameters},
            "controllers": {c.name: c.origin for c in loaded.controllers},
            "workers": count,
            **asdict(cost),
        },
        tables=[
            fact_table(
                f"Study {loaded.source}",
                [
                    ("samples", str(loaded.samples), ""),
                    (
                        "sampling",
                        f"{settings.sampling.replace('_', ' ')}, seed {settings.seed}",
                        "",
                    ),
                    ("evaluation", settings.evaluation, ""),
                    (
                        f"time of {cost.measured_rows} samples, measured in one process",
                        f"{cost.measured_s:.3g}",
                        "s",
                    ),
                    (f"time of the whole, on {where}", f"about {_duration(cost.seconds)}", ""),
                    ("space on the disk", f"about {cost.disk_bytes / 1e6:.3g}", "MB"),
                ],
            ),
            TableText(
                title="Parameters",
                headings=("parameter", "distribution"),
                rows=[(p.name, p.distribution.text) for p in loaded.parameters],
            ),
            TableText(
                title="Controllers",
                headings=("controller", "what"),
                rows=[(c.name, c.origin) for c in loaded.controllers],
            ),
        ],
        notes=[*_sampling_notes(loaded), "nothing was written."],
    )


def _replay(loaded: Study, folder: Path, arguments: Namespace) -> Report:
    if 0 <= arguments.row < loaded.samples:  # else it is refused
        make_directory(folder)
    with show_spinner("replaying", quiet=arguments.json):
        replay = replay_row(loaded, folder, arguments.row)
    data: dict[str, Any] = {
        "row": replay.row,
        "parameters": replay.parameters,
        "stored": replay.stored,
        "fresh": replay.fresh,
        "failures": [asdict(failure) for failure in replay.failures],
        "files": [str(path) for path in replay.files],
    }
    return Report(
        data=data,
        tables=[
            TableText(
                title=f"Row {replay.row}",
                headings=("parameter", "value"),
                rows=list(replay.parameters.items()),
            ),
            TableText(
                title="Results",
                headings=("result", "stored", "now"),
                rows=[
                    (name, replay.stored.get(name), replay.fresh.get(name))
                    for name in loaded.result_columns
                ],
            ),
        ],
        notes=[
            *([] if replay.stored else ["note: the study has no result of this row yet."]),
            *(f"failed: {failure.controller}: {failure.error}" for failure in replay.failures),
            *([f"note: {replay.unwritten}"] if replay.unwritten else []),
            *(f"written: {path}" for path in replay.files),
        ],
    )
