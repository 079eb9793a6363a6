"""The pages of a study and of a diagnosis: verdict, tables, figures.

Charts are made of binned data, so that their size does not grow with the samples.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.design import Design
from lbt_synth.identification.diagnosis import Diagnosis, law_facts
from lbt_synth.identification.fit.identified_model import model_tables
from lbt_synth.identification.records.record import NOT_KNOWN
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.loop.margins import LoopMargins
from lbt_synth.report.draw import GUIDE, PANEL_IN, draw_map, drawing, line_style, name_axes
from lbt_synth.report.figures import identification_figure
from lbt_synth.report.figures.studies import STREHL
from lbt_synth.report.page.html import (
    Block,
    Chart,
    Notice,
    Page,
    chart,
    new_page,
    paragraph,
    survival_blocks,
)
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.rows import cell_text, row_table
from lbt_synth.storage.tables import Table
from lbt_synth.storage.words import count_text, duration_text, listing_text
from lbt_synth.studies.grid import Failure
from lbt_synth.studies.study.run import Replay
from lbt_synth.studies.study.statistics import (
    ControllerStatistics,
    Samples,
    StudyStatistics,
    controller_samples,
    percent,
    residual_table,
    sensitivity_table,
    strehl_table,
    worst_table,
)
from lbt_synth.studies.study.study import Study
from lbt_synth.validation import FloatArray

_POINTS = 400  # of a cumulative distribution
_BINS = 30  # along either axis of a map, at most
_PER_CELL = 8  # samples in a cell of a map on average, at least
_MOST_FAILURES = 10  # that are listed
_PARAMETERS = 5  # of a worst sample: with row and Strehl ratio, they fill a sheet


def study_page(
    study: Study,
    columns: Mapping[str, ArrayLike],
    statistics: StudyStatistics,
    *,
    folder: str | os.PathLike[str] = ".",
    failures: Sequence[Failure] = (),
    computing_s: float = 0.0,
) -> Page:
    """Return the page of a study; :func:`write_page` writes it.

    Parameters
    ----------
    study : Study
        The study.
    columns : mapping of str to (n,) array_like
        Its results, all or those that there are so far.
    statistics : StudyStatistics
        Those of the columns.
    folder : path-like, optional
        Directory of the results, which is named in commands that replay them.
    failures : sequence of (int, str, str), optional
        Row, controller and error of what failed.
    computing_s : float, optional
        Time of all its batches, of all processes together [s].

    Returns
    -------
    Page
        The page.

    Raises
    ------
    ProblemError
        If the columns are not those of the study.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> from lbt_synth.studies.study.statistics import study_statistics
    >>> study = lbt.studies.load_study("examples/study.yaml")
    >>> columns = dict(zip(study.parameter_names, study.values(0, 2).T)) | {"row": [0, 1]}
    >>> columns |= {f"kalman.{name}": [1.0, 0.5] for name in ("strehl", "residual_nm")}
    >>> columns["kalman.stable"] = [1, 1]
    >>> statistics = study_statistics(columns, study.parameter_names, ["kalman"])
    >>> lbt.report.study_page(study, columns, statistics).title
    'Robustness study study.yaml'
    """
    samples = {
        controller.controller: controller_samples(columns, controller.controller)
        for controller in statistics.controllers
    }
    values = {name: np.asarray(columns[name], float) for name in statistics.parameters}
    varying = sum(np.ptp(column) > 0 for column in values.values())
    dependence: list[Block] = [Notice(text=paragraph("no-index"))]
    if statistics.ranked:
        dependence = [sensitivity_table(statistics), *_map_charts(statistics, samples, values)]
    origin = (
        ("samples with results", f"{statistics.samples} of {study.samples}"),
        ("digest of the study", study.digest),
        ("computing time, of all processes together", duration_text(computing_s)),
    )
    return new_page(
        f"Robustness study {study.source.name}",
        f"{statistics.samples} samples of {varying} parameters, "
        f"{count_text(len(statistics.controllers), 'controller')}",
        {
            "Summary": _summary_blocks(study, statistics, samples),
            "What was sampled": _samples_blocks(study, values),
            "Controllers": _controllers_blocks(study, statistics, failures),
            "What the Strehl ratio depends on": dependence,
            "Worst samples": _worst_blocks(study, statistics, columns, os.fspath(folder)),
            "How to read the figures": [paragraph(name) for name in ("intervals", "indices")],
        },
        sources=list(zip_longest(study.inputs, ("study", "configuration"), fillvalue="gain file")),
        facts=[Table(caption="Study", headings=("what", "value"), rows=origin, words=(1,))],
    )


def _summary_blocks(
    study: Study, statistics: StudyStatistics, samples: Mapping[str, Samples]
) -> list[Block]:
    """Open with what is wrong, the verdict, and the Strehl ratios."""
    failed = ", ".join(f"{c.controller} {c.failed}" for c in statistics.controllers if c.failed)
    done, total = statistics.samples, study.samples
    wrong = [paragraph("incomplete", done=done, samples=total)] if done < total else []
    wrong += [f"Evaluations that failed, and are in none of the figures: {failed}."] * bool(failed)
    verdict = study_verdict(statistics)
    wrong += [sentence for sentence in verdict if " is unstable " in sentence]
    return [
        *(Notice(text=sentence, tone="bad") for sentence in wrong),
        " ".join(sentence for sentence in verdict if sentence not in wrong),
        *survival_blocks(_design_margins(study, statistics)),
        strehl_table(statistics),
        residual_table(statistics),
        *_distribution_chart(samples),
    ]


def _design_margins(study: Study, statistics: StudyStatistics) -> dict[str, LoopMargins]:
    """Return the margins of designs for the whole study, of one sensor, in their own loops."""
    loops = {
        name: close_loop(design.hardware, design)
        for name in (controller.controller for controller in statistics.controllers)
        if isinstance(design := study.controllers.get(name), Design)
        and design.hardware is not None
        and not design.other_sensors
    }
    return {name: loop_margins(loop) for name, loop in loops.items() if loop.is_stable}


def study_verdict(statistics: StudyStatistics) -> list[str]:
    """Say which controllers are unstable, which leads by each measure, and what it depends on."""
    with_data = [one for one in statistics.controllers if one.samples]
    if not with_data:
        return ["No controller was evaluated on any sample."]
    verdict = []
    if unstable := sorted((c for c in with_data if c.unstable), key=lambda c: -c.unstable):
        first, *others = (f"{percent(c.unstable_share.value, 2)} %" for c in unstable)
        verdict = [f"{unstable[0].controller} is unstable in {first} of the samples."]
        if others:
            names = listing_text([c.controller for c in unstable[1:]], 2)
            most = "at most " * (len(others) > 1)
            verdict = [f"{verdict[0][:-1]}, and {names} in {most}{others[0]}."]
    measures: dict[str, Callable[[ControllerStatistics], float]] = {
        "mean": lambda one: one.mean,
        "median": lambda one: one.strehl[50].value,
        "5th percentile": lambda one: one.strehl[5].value,
    }
    leaders = []
    for name, measure in measures.items():
        best = max(with_data, key=measure)
        leaders.append(f"highest {name}, {best.controller} {percent(measure(best))} %")
    verdict.append(f"Strehl ratios: {'; '.join(leaders)}.")
    best = max(with_data, key=measures["mean"])
    if best.ranked:
        share = 100 * best.index(best.ranked[0])[0]
        verdict.append(
            f"That of {best.controller} depends most on {best.ranked[0]} ({share:.0f} % of its "
            "variance)."
        )
    return verdict


def controller_table(statistics: StudyStatistics) -> Table:
    """Return a line for each controller."""
    kinds = ("mean", "+-", "5th", "median", "95th", "unstable")
    rows = []
    for one in statistics.controllers:
        low, median, high = (one.strehl[p].value for p in (5, 50, 95))
        values = (one.mean, one.mean_error, low, median, high, one.unstable_share.value)
        rows.append((one.controller, *(percent(value, 2) for value in values), str(one.failed)))
    return Table(
        caption="Strehl ratio over the samples, with percentiles; an unstable loop counts as 0",
        headings=("controller", *(f"{kind} [%]" for kind in kinds), "failed"),
        rows=tuple(rows),
    )


def replay_table(replay: Replay, row: int, names: Sequence[str]) -> Table:
    """List results of a row as stored and now, those in nm in the unit that is shown."""
    unit, factor = shown_unit("nm")
    rows = []
    for name in names:
        shown, scale = name, 1.0
        if name.endswith("_nm"):
            shown, scale = f"{name.removesuffix('nm')}{unit}", factor
        values = (scale * results.get(name, np.nan) for results in (replay.stored, replay.fresh))
        rows.append((shown, *map(cell_text, values)))
    headings = ("result", "stored", "now")
    return Table(caption=f"Results of row {row}", headings=headings, rows=tuple(rows))


def _samples_blocks(study: Study, values: Mapping[str, FloatArray]) -> list[Block]:
    """List the parameters, and what was drawn of them."""
    settings = study.settings
    texts = {name: section.text for name, section in settings.parameters.items()}
    rows = [
        (
            name,
            texts.get(name, ""),
            *(f"{q:.4g}" for q in np.quantile(c, (0, 0.5, 1))),
        )
        for name, c in values.items()
    ]
    headings = ("parameter", "distribution", "least", "median", "greatest")
    return [
        f"{study.samples} samples of a Sobol sequence (seed: {settings.seed}).",
        Table(caption="Parameters", headings=headings, rows=tuple(rows), words=(1,)),
    ]


def _controllers_blocks(
    study: Study, statistics: StudyStatistics, failures: Sequence[Failure]
) -> list[Block]:
    """List the controllers and their failures."""
    origins = {name: section.text for name, section in study.settings.controllers.items()}
    rows = tuple((c.controller, origins.get(c.controller, "")) for c in statistics.controllers)
    headings = ("controller", "origin")
    blocks: list[Block] = [Table(caption="Controllers", headings=headings, rows=rows, words=(1,))]
    if failures:
        more = len(failures) - _MOST_FAILURES
        caption = f": the first {_MOST_FAILURES}, and {more} more" if more > 0 else ""
        listed = tuple((str(row), name, error) for row, name, error in failures[:_MOST_FAILURES])
        blocks.append(
            Table(
                caption=f"Evaluations that failed{caption}",
                headings=("row", "controller", "error"),
                rows=listed,
                words=(1, 2),
            )
        )
    return blocks


def _worst_blocks(
    study: Study,
    statistics: StudyStatistics,
    columns: Mapping[str, ArrayLike],
    folder: str,
) -> list[Block]:
    """List the worst samples, and the commands that replay them."""
    words = ["lbt-synth", "study", os.fspath(study.source), "-o", folder, "--row"]
    tables = [
        worst_table(one, columns, (one.ranked or statistics.parameters)[:_PARAMETERS])
        for one in statistics.controllers
        if one.worst
    ]
    if not tables:
        return []
    commands = [shlex.join([*words, str(table.rows[0][0])]) for table in tables]
    caption = "Commands that replay the first of each table; any other row likewise"
    opening = paragraph("worst", count=_PARAMETERS)
    return [opening, *tables, (caption, "\n".join(dict.fromkeys(commands)))]


def _distribution_chart(samples: Mapping[str, Samples]) -> list[Chart]:
    """Cumulative distribution of the Strehl ratio, and its lower tail on a logarithmic scale."""
    strehls = {name: columns["strehl"][columns["evaluated"]] for name, columns in samples.items()}
    if not any(values.size for values in strehls.values()):
        return []
    top = 100 * max(float(np.max(values, initial=0.0)) for values in strehls.values())
    least = 100 / max(values.size for values in strehls.values())
    low = min(10.0, 10.0 ** np.floor(np.log10(least)))
    share = ("samples at or below", "%")
    with drawing([PANEL_IN] * 2, columns=2) as (plain, tail):
        name_axes(plain, STREHL, share, "all samples", ylim=(0, 100))
        name_axes(tail, STREHL, share, "lower tail", ylim=(low, 100), yscale="log")
        plain.axhline(50, label="half of the samples", **GUIDE)
        for look, (name, values) in enumerate(strehls.items()):
            if values.size:
                level, part = cumulative_points(values)
                # from nothing just below the first value
                x, y = 100 * np.append(level[:1], level), 100 * np.append(0.0, part)
                style = line_style(look, drawstyle="steps-post", label=name)
                plain.plot(x, y, **style)
                tail.plot(x[1:], y[1:], **style)
        for panel in (plain, tail):
            panel.set_xlim(0, min(100.0, max(1.02 * top, 1.0)))
    return [chart("distribution", plain.figure)]


def _map_charts(
    statistics: StudyStatistics,
    samples: Mapping[str, Samples],
    parameters: Mapping[str, FloatArray],
) -> list[Chart]:
    """Mean Strehl ratio over the two most influential parameters, one chart per controller."""
    charts = []
    for place, one in enumerate(statistics.controllers):
        if len(one.ranked) < 2:
            continue
        first, second = one.ranked[:2]
        strehl, kept = (samples[one.controller][name] for name in ("strehl", "evaluated"))
        places = parameters[first][kept], parameters[second][kept]
        x, y, mean = binned_map(*places, strehl[kept])
        with drawing([2.6]) as (panel,):
            name_axes(panel, (first, ""), (second, ""))
            draw_map([panel], [(x, y, 100 * mean)], "mean Strehl ratio [%]", blank="no sample")
        facts = {"x": first, "y": second}
        facts["controller"] = one.controller
        charts.append(chart(f"map-{place + 1}", panel.figure, group="study-map", **facts))
    return charts


def cumulative_points(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return levels (k,) and the part of the values at or below each, denser in the tails."""
    ordered, n = np.sort(values), len(values)
    tail = np.geomspace(1, n, _POINTS // 4)
    ranks = np.concatenate((tail, n + 1 - tail, np.linspace(1, n, _POINTS // 2)))
    level = np.unique(ordered[ranks.astype(np.int64) - 1])
    return level, np.searchsorted(ordered, level, side="right") / n


def binned_map(
    x: FloatArray, y: FloatArray, result: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return centres of cells (nx,), (ny,), and the mean (ny, nx) of a result in each, or nan."""
    from scipy.stats import binned_statistic_2d

    cells = int(np.clip(np.sqrt(len(x) / _PER_CELL), 3, _BINS))
    mean, rows, columns, _ = binned_statistic_2d(y, x, result, bins=cells)
    return (columns[:-1] + columns[1:]) / 2, (rows[:-1] + rows[1:]) / 2, np.asarray(mean)


_DiagnosisRows: TypeAlias = list[tuple[str, str, str, Sequence[Any]]]


def diagnosis_rows(diagnosis: Diagnosis) -> _DiagnosisRows:
    """Return section, key, caption and rows of each table of a diagnosis, none of the unknown."""
    record, commands, law = diagnosis.record, diagnosis.commands, diagnosis.law
    size = f"{record.duration_s:.4g} s at {record.frame_rate_hz:.6g} Hz"
    # what a correction lacks is a consequence of other faults, and of the beginning
    faults = [finding for finding in record.findings if finding.kind != NOT_KNOWN]
    best = f" (best design: {diagnosis.best})" if diagnosis.best else ""
    costs = f"What each part leaves by the model of the first half{best}"
    unseen = "Residual on the second half of the record, by models of the first"
    reach = "How the commands reach the measurements"
    tables: _DiagnosisRows = [
        ("Verdict", "residuals", f"{unseen}; {diagnosis.imaging.label}", diagnosis.residuals),
        ("Verdict", "costs", costs, diagnosis.costs),
        ("Record", "channels", f"Record: {size}. {record.summary()}", diagnosis.channels),
        ("Record", "faults", "Faults", faults),
        ("Loop", "commands", reach, [] if commands is None else [commands.facts()]),
        (
            "Loop",
            "law",
            "Control law, from y to u",
            [] if law is None else [law_facts(law)],
        ),
        ("Loop", "loop", "Loop", [] if diagnosis.loop is None else [diagnosis.loop]),
    ]
    return [table for table in tables if table[-1]]


def diagnosis_page(diagnosis: Diagnosis, files: Sequence[str] = ()) -> Page:
    """Return the page of a diagnosis, with the digests of the record and of the given design."""
    record, model, (state, *rest) = diagnosis.record, diagnosis.model, diagnosis.verdict
    name = Path(files[0]).name if files else record.source or "a record"
    tables: dict[str, list[Block]] = {}
    for section, _, caption, rows in diagnosis_rows(diagnosis):
        tables.setdefault(section, []).append(row_table(caption, rows))
    disturbance: list[Block] = [] if model is None else [*model_tables(model)[1:]]
    if model is not None:
        best = diagnosis.best_design
        designs = {} if best is None else {diagnosis.best: best}
        figure = identification_figure(model, designs=designs)
        disturbance.append(chart("identification", figure))
    verdict: list[Block] = [Notice(text=state, tone=diagnosis.findings[0].tone), " ".join(rest)]
    verdict += tables.pop("Verdict", [])
    verdict += [Notice(text=f"{note[0].upper()}{note[1:]}") for note in diagnosis.notes]
    duration = f"{record.duration_s:.4g} s at {record.frame_rate_hz:.6g} Hz"
    return new_page(
        f"Diagnosis of {name}",
        f"{duration}, {count_text(record.axes, 'axis', 'axes')}",
        {
            "Verdict": verdict,
            "Record": tables["Record"],
            "Loop that ran": [paragraph("law"), *tables.get("Loop", ())],
            "Disturbance": disturbance or ["No model was identified."],
        },
        sources=list(zip(files, ("record", "gain file"), strict=False)),
    )


def say_diagnosis(diagnosis: Diagnosis, given: Collection[str]) -> list[str]:
    """Say the record's state, its residual and what to change, and then what else is known."""
    *states, residual = diagnosis.findings
    faults = [state.sentence for state in states if state.tone == "bad"]
    tried = [(row.name, row.replayed) for row in diagnosis.residuals if row.name in given]
    leave = "".join(f"; {name} would leave {replay.text}" for name, replay in tried if replay)
    verdict = [f"{residual.sentence[:-1]}{leave}.", diagnosis.verdict[-1]]
    if len(faults) > 1:  # of which nothing follows for the residual
        verdict.reverse()
    verdict = [*(faults or [states[0].sentence]), *verdict]
    return [*verdict, *(state.sentence for state in states if state.sentence not in verdict)]
