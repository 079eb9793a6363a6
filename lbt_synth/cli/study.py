"""The command study: run a study, or replay one of its rows."""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from lbt_synth import studies
from lbt_synth.cli.loop_inputs import load_shown
from lbt_synth.cli.output import Report
from lbt_synth.cli.streams import count_progress, print_error
from lbt_synth.report import study_page, write_page
from lbt_synth.report.page.html import require_weasyprint
from lbt_synth.report.pages import controller_table, replay_table, study_verdict
from lbt_synth.storage.atomic_files import make_directory, refuse_replacing
from lbt_synth.storage.executors import choose_engine
from lbt_synth.storage.words import duration_text, listing_text
from lbt_synth.studies.study.run import PAGE, PRINT, output_paths, replay_row
from lbt_synth.studies.study.statistics import study_statistics, summary_tables, worst_table
from lbt_synth.studies.study.study import Study
from lbt_synth.validation import integer

_FAILURE = ("row", "controller", "error")
_WORST = 3  # rows of each controller that are printed; the page has more


def run_study(arguments: Namespace) -> Report:
    """Run a study, say what it would cost, or replay one of its rows."""
    folder = Path(arguments.output)
    if arguments.pdf:
        require_weasyprint()
    loaded = studies.load_study(arguments.study)
    load_shown(arguments, loaded.config)
    refuse_replacing(output_paths(folder, loaded), loaded.inputs)
    if arguments.row is not None:
        return _replay(loaded, folder, arguments)
    return _run_study(loaded, folder, arguments)


def _run_study(loaded: Study, folder: Path, arguments: Namespace) -> Report:
    with run_in_parts(arguments, folder, total=loaded.samples, what="samples") as engine:
        run = studies.run_study(loaded, folder, **engine)
    names, columns = loaded.parameter_names, run.columns
    statistics = study_statistics(columns, names, tuple(loaded.controllers))
    pages = [folder / PAGE, *([folder / PRINT] if arguments.pdf else [])]
    draws = run.computed > 0 or not all(path.exists() for path in pages)
    if draws:
        page = study_page(
            loaded,
            columns,
            statistics,
            folder=folder,
            failures=run.failures,
            computing_s=run.computing_s,
        )
        write_page(page, pages[0], pdf=pages[1] if arguments.pdf else None)
    varying = [name for name, p in loaded.settings.parameters.items() if p.varies]
    worst = [worst_table(one, columns, varying) for one in statistics.controllers]
    files = dict.fromkeys((run.results, run.failed), run.new) | dict.fromkeys(pages, draws)
    done = f"{folder} is finished: {loaded.samples} samples in {run.results.name}; none computed."
    if run.computed:
        done = (
            f"{run.computed} of {loaded.samples} samples computed in "
            f"{duration_text(run.seconds)}, {duration_text(run.computing_s)} of all processes."
        )
    count = len(run.failures)
    report = Report(
        data={
            "samples": loaded.samples,
            "computed": run.computed,
            "failures": count,
            "seconds": run.seconds,
            "computing_seconds": run.computing_s,
            "statistics": asdict(statistics),
        },
        verdict=study_verdict(statistics),
        tables=[
            controller_table(statistics),
            *summary_tables(statistics),
            *(replace(table, rows=table.rows[:_WORST]) for table in worst),
        ],
        notes=[
            f"note: {done}",
            *([f"note: {count} results failed, see {run.failed}."] if count else []),
            *(f"unchanged: {path}" for path, now in files.items() if not now),
        ],
    )
    report.note_written(*(path for path, now in files.items() if now))
    return report


def _replay(loaded: Study, folder: Path, arguments: Namespace) -> Report:
    if 0 <= arguments.row < loaded.samples:  # else it is refused
        make_directory(folder)
    replay = replay_row(loaded, folder, arguments.row)
    stored, fresh, row = replay.stored, replay.fresh, arguments.row
    values = loaded.parameters_by_name(loaded.values(row, row + 1)[0])
    report = Report(
        data={"row": row, "parameters": values, "stored": stored, "fresh": fresh}
        | {"failures": [dict(zip(_FAILURE, failure, strict=True)) for failure in replay.failures]},
        notes=[f"warning: failed: {name}: {error}" for _, name, error in replay.failures],
    )
    said = "gives what is stored" if stored else "has no stored results to compare with"
    if replay.changed:
        said = f"does not give what is stored of {listing_text(replay.changed, 3)}"
    report.verdict.append(f"Row {row}, computed again, {said}.")
    report.tables.append(replay_table(replay, row, loaded.result_columns))
    report.note_written(*replay.files)
    return report


@contextmanager
def run_in_parts(
    arguments: Namespace, folder: Path, *, total: int, what: str
) -> Iterator[dict[str, Any]]:
    """Provide the executor, its workers and a progress bar for work that resumes from a folder.

    An interruption says where what is finished stays.
    """
    integer(arguments.jobs, "--jobs", at_least=1, at_most=8 * (os.cpu_count() or 1))
    with (
        choose_engine(arguments.jobs, getattr(arguments, "dask", None)) as (executor, workers),
        count_progress(total=total, what=what) as count,
    ):
        make_directory(folder)
        try:
            yield {"executor": executor, "workers": workers, "progress": count}
        except KeyboardInterrupt:
            print_error(f"what is finished is kept in {folder}; start it again to continue")
            raise
