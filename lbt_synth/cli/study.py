"""The command study: run a study, say what it would cost, or replay one of its rows."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from lbt_synth import studies
from lbt_synth.cli.display import choose_config_unit
from lbt_synth.cli.engine import choose_engine, keep_finished
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import count_progress, show_spinner
from lbt_synth.report import write_study_page
from lbt_synth.report.page.html import require_weasyprint
from lbt_synth.storage.atomic_files import make_directory, refuse_replacing
from lbt_synth.storage.rows import fact, facts
from lbt_synth.storage.words import count_text, duration_text
from lbt_synth.studies.study.run import FinishedStudy, StudyRun, output_paths
from lbt_synth.studies.study.statistics import StudyStatistics
from lbt_synth.studies.study.store import PAGE, PRINT, read_failures
from lbt_synth.studies.study.summary import worst_table
from lbt_synth.validation import integer

_COUNTS = ("samples", "computed", "failures", "seconds")
_WORST = 3  # rows of each controller that are printed; the page has more


def run(arguments: Namespace) -> Report:
    """Run a study, say what it would cost, or replay one of its rows."""
    integer(arguments.jobs, "--jobs", at_least=1)
    folder = Path(arguments.output)
    if arguments.pdf:
        require_weasyprint()
    with show_spinner("reading the study, designing", quiet=arguments.json):
        loaded = studies.load_study(arguments.study, directory=folder)
    choose_config_unit(arguments, loaded.config)
    refuse_replacing(output_paths(folder, loaded), loaded.inputs)
    if arguments.dry_run:
        return _dry_run(loaded, arguments)
    if arguments.row is not None:
        return _replay(loaded, folder, arguments)
    return _run_study(loaded, folder, arguments)


def _run_study(loaded: studies.Study, folder: Path, arguments: Namespace) -> Report:
    pages = [folder / PAGE, *([folder / PRINT] if arguments.pdf else [])]
    draws = not all(path.exists() for path in pages)
    found, statistics, new = _compute(loaded, folder, pages, arguments, draws=draws)
    files = {found.results: new, found.failed: new} | dict.fromkeys(pages, new or draws)
    varying = [p.name for p in loaded.parameters if p.distribution.varies]
    worst = [worst_table(each, varying) for each in statistics.controllers]
    done = f"{folder} is finished: {found.samples} samples in {found.results.name}; none computed."
    if new:
        done = (
            f"{found.computed} of {found.samples} samples computed in "
            f"{duration_text(found.computing_s)}; with tables and page "
            f"{duration_text(found.seconds)}."
        )
    failed = f"note: {found.failures} results failed, see {found.failed}."
    return Report(
        data={name: getattr(found, name) for name in _COUNTS}
        | {
            "computing_seconds": found.computing_s,
            "files": [str(path) for path in files],
            "statistics": asdict(statistics),
        },
        tables=[
            *studies.summary_tables(statistics),
            *(replace(table, rows=table.rows[:_WORST]) for table in worst),
        ],
        notes=[
            done,
            *_sampling_notes(loaded),
            *([failed] if found.failures else []),
            *(f"{'written' if now else 'unchanged'}: {path}" for path, now in files.items()),
        ],
    )


def _compute(
    loaded: studies.Study, folder: Path, files: Sequence[Path], arguments: Namespace, *, draws: bool
) -> tuple[StudyRun, StudyStatistics, bool]:
    """Run a study; return also whether anything was left to compute.

    Its page is written where something was, or where it ``draws`` in any case.
    """
    found: list[tuple[StudyStatistics, bool]] = []
    page, *pdf = files
    names = [controller.name for controller in loaded.controllers]

    def summarise(results: FinishedStudy) -> None:
        statistics = studies.study_statistics(results.columns, loaded.parameter_names, names)
        found.append((statistics, results.new))
        if results.new or draws:
            failures = [
                studies.Failure(row=row, controller=name, error=error)
                for row, name, error in read_failures(folder)
            ]
            write_study_page(
                loaded,
                results.columns,
                page,
                statistics=statistics,
                failures=failures,
                computing_s=results.computing_s,
                pdf=pdf[0] if pdf else None,
            )

    with choose_engine(arguments) as (executor, workers):
        make_directory(folder)
        with (
            count_progress(
                total=loaded.samples, what="samples", quiet=arguments.json, rate=True
            ) as count,
            keep_finished(folder),
        ):
            study_run = studies.run_study(
                loaded,
                folder,
                executor=executor,
                jobs=arguments.jobs,
                workers=workers,
                progress=count,
                whole=summarise,
            )
    [(statistics, new)] = found
    return study_run, statistics, new


def _sampling_notes(loaded: studies.Study) -> list[str]:
    if loaded.settings.sampling != "sobol" or loaded.samples & (loaded.samples - 1) == 0:
        return []
    return [
        "note: Sobol's points are balanced best when their number is a power of two; "
        f"{loaded.samples} is none."
    ]


def _dry_run(loaded: studies.Study, arguments: Namespace) -> Report:
    with choose_engine(arguments) as (_, workers):
        count = workers or arguments.jobs
    with show_spinner("measuring a batch", quiet=arguments.json):
        cost = studies.estimate_study(loaded, workers=count, local=workers is None)
    where = count_text(count, "process", "processes")
    if workers is not None:
        where = f"{count} threads of {arguments.dask}, as quick as this one"
    parameters = {p.name: p.distribution.text for p in loaded.parameters}
    controllers = {c.name: c.origin for c in loaded.controllers}
    report = Report(data={"parameters": parameters, "controllers": controllers})
    mb = {"unit": "MB", "scale": 1e-6, "format": ".3g"}
    report.add_facts(
        f"Study {loaded.source}",
        facts(
            samples=fact(loaded.samples, "samples"),
            sampling=fact(loaded.settings.sampling, "sampling"),
            seed=fact(loaded.settings.seed, "seed"),
            evaluation=fact(loaded.settings.evaluation, "evaluation"),
            workers=fact(count),
            measured_rows=fact(cost.measured_rows, "samples measured in one process"),
            measured_s=fact(cost.measured_s, "  their time", unit="s", format=".3g"),
            seconds=fact(cost.seconds),  # said in a note, in words for long ones
            disk_bytes=fact(cost.disk_bytes, "space on the disk, about", **mb),
        ),
    )
    report.add_table("Parameters", ("parameter", "distribution"), parameters.items())
    report.add_table("Controllers", ("controller", "what"), controllers.items())
    report.notes += [
        f"the whole takes about {duration_text(cost.seconds)} on {where}.",
        *_sampling_notes(loaded),
        "nothing was written.",
    ]
    return report


def _replay(loaded: studies.Study, folder: Path, arguments: Namespace) -> Report:
    if 0 <= arguments.row < loaded.samples:  # else it is refused
        make_directory(folder)
    with show_spinner("replaying", quiet=arguments.json):
        replay = studies.replay_row(loaded, folder, arguments.row)
    stored, fresh = replay.stored, replay.fresh
    report = Report(
        data={name: getattr(replay, name) for name in ("row", "parameters", "stored", "fresh")}
        | {"failures": [asdict(failure) for failure in replay.failures]},
        notes=[
            *([] if stored else ["note: the study has no result of this row yet."]),
            *(f"failed: {failure.controller}: {failure.error}" for failure in replay.failures),
            *([f"note: {replay.unwritten}"] if replay.unwritten else []),
        ],
    )
    report.add_table(f"Row {replay.row}", ("parameter", "value"), replay.parameters.items())
    results = [(name, stored.get(name), fresh.get(name)) for name in loaded.result_columns]
    report.add_table("Results", ("result", "stored", "now"), results)
    report.note_files(replay.files)
    return report
