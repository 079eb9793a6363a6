"""The page of a robustness study: verdict, samples, comparison, dependence, worst samples.

Charts are made of binned data, so that their size does not grow with the samples.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError
from lbt_synth.loop import LoopMargins, close_loop, loop_margins
from lbt_synth.methods.request import fixed_design
from lbt_synth.report.draw import PANEL_IN, Panel, drawing
from lbt_synth.report.page.html import (
    Block,
    Chart,
    Notice,
    Page,
    Sections,
    chart,
    creation_time,
    paragraph,
    read_source,
    source_section,
    survival_blocks,
    time_text,
)
from lbt_synth.storage.array_file import digest
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.storage.words import count_text, duration_text, listing_text
from lbt_synth.studies import Study, study_statistics
from lbt_synth.studies.grid import Failure
from lbt_synth.studies.study import summary
from lbt_synth.studies.study.statistics import (
    ControllerSamples,
    ControllerStatistics,
    StudyStatistics,
    is_list,
    read_column,
    read_controller_samples,
    sample_losses,
)
from lbt_synth.validation import FloatArray

_UNSTABLE_PANELS = 4
_POINTS = 400  # of a cumulative distribution
_BINS = 30  # of a histogram, at most
_CELLS = 32  # along either axis of a map, at most
_WITHIN = 1, 99  # percentiles at the edges of a map; its outermost cells hold what is beyond
_PER_CELL = 8  # samples in a cell of a map on average, at least
_HIGH = 40.0  # Strehl ratio [%] above which the axis need not start at 0
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
Names = Mapping[str, str]  # what each parameter is called


def study_page(
    study: Study,
    columns: Mapping[str, ArrayLike],
    *,
    folder: str | os.PathLike[str] = ".",
    statistics: StudyStatistics | None = None,
    failures: Sequence[Failure] = (),
    computing_s: float | None = None,
) -> Page:
    """Return the page of a study; :func:`write_page` writes it.

    Parameters
    ----------
    study : Study
        The study.
    columns : mapping of str to (n,) array_like
        Its results, all or those that there are so far.
    folder : path-like, optional
        Directory of the results, which is named in commands that replay them.
    statistics : StudyStatistics, optional
        Those of the columns, if they are known already.
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
    >>> study = lbt.studies.load_study("examples/study.yaml")
    >>> values = study.values(0, 2)
    >>> columns = dict(zip(study.parameter_names, values.T))
    >>> columns |= lbt.studies.evaluate_samples(study, values, 0)[0]
    >>> lbt.report.study_page(study, columns).title
    'Robustness study study.yaml'
    """
    if statistics is None:
        statistics = study_statistics(columns, study.parameter_names, list(study.controllers))
    samples = [read_controller_samples(columns, each.controller) for each in statistics.controllers]
    if any(len(each.strehl) != statistics.samples for each in samples):
        raise ProblemError(
            f"the columns must have the {statistics.samples} samples of the statistics; got "
            f"{len(samples[0].strehl)}."
        )
    values = {
        name: read_column(columns, name, statistics.samples) for name in statistics.parameters
    }
    names = short_names(statistics.parameters)
    varying = sum(np.ptp(column) > 0 for column in values.values())
    reading = [paragraph(name) for name in ("intervals", "indices")]
    made = time_text(creation_time())
    return Page(
        title=f"Robustness study {study.source.name}",
        subtitle=(
            f"{statistics.samples} samples of {varying} parameters, "
            f"{count_text(len(statistics.controllers), 'controller')}. Made {made}."
        ),
        sections={
            "summary": ("Summary", _summary_blocks(study, statistics, samples)),
            "samples": ("What was sampled", _samples_blocks(study, values, names)),
            "controllers": ("Controllers", _controllers_blocks(study, statistics, failures)),
            "comparison": (
                "Comparison on the same samples",
                _comparison_blocks(statistics, samples),
            ),
            "dependence": (
                "What the Strehl ratio depends on",
                _dependence_blocks(statistics, samples, values, names),
            ),
            "worst": (
                "Worst samples",
                _worst_blocks(study, statistics, columns, names, os.fspath(folder)),
            ),
            "reading": ("How to read the figures", reading),
            **_origin_section(study, statistics, computing_s),
        },
    )


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


def _summary_blocks(
    study: Study, statistics: StudyStatistics, samples: Sequence[ControllerSamples]
) -> list[Block]:
    """Open with what is wrong, the verdict, and the Strehl ratios."""
    unstable = [each for each in statistics.controllers if each.unstable]
    failed = [each for each in statistics.controllers if each.failed]
    warnings = []
    if statistics.samples < study.samples:
        warnings.append(paragraph("incomplete", done=statistics.samples, samples=study.samples))
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
        _verdict_text(statistics.controllers),
        *survival_blocks(_design_margins(study, statistics)),
        summary.strehl_table(statistics),
    ]
    return [*blocks, *_distribution_chart(samples)]


def _design_margins(study: Study, statistics: StudyStatistics) -> dict[str, LoopMargins]:
    """Return the margins of the designs of a study in the loops that they were made for.

    A controller that is designed for each sample has none, nor has one of several sensors.
    """
    loops = {
        name: close_loop(design.hardware, design)
        for name in (each.controller for each in statistics.controllers)
        if name in study.controllers
        and (design := fixed_design(study.controllers[name])) is not None
        and design.hardware is not None
        and not design.other_sensors
    }
    return {name: loop_margins(loop) for name, loop in loops.items() if loop.is_stable}


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


def _samples_blocks(study: Study, values: Mapping[str, FloatArray], names: Names) -> list[Block]:
    """Show the parameters and their histograms."""
    distributions = {name: section.text for name, section in study.settings.parameters.items()}
    rows = tuple(
        (
            names[name],
            name,
            distributions.get(name, ""),
            *(f"{value:.4g}" for value in np.percentile(column, (0, 50, 100))),
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
    settings = study.settings
    opening = (
        f"{study.samples} samples, {_SAMPLING[settings.sampling]}, seed {settings.seed}; "
        f"{_EVALUATION[settings.evaluation]}."
    )
    return [opening, table, *(_histogram_chart(values, names) if rows else ())]


def _controllers_blocks(
    study: Study, statistics: StudyStatistics, failures: Sequence[Failure]
) -> list[Block]:
    """List the controllers, with digests of what is the same for all samples, and failures."""
    origins = {name: section.text for name, section in study.settings.controllers.items()}
    digests = {
        name: digest({matrix: getattr(design.controller, matrix) for matrix in "ABCD"}, {})
        for name, each in study.controllers.items()
        if (design := fixed_design(each)) is not None
    }
    rows = tuple(
        (
            each.controller,
            origins.get(each.controller, ""),
            digests.get(each.controller, "-")[:16],
            str(each.samples),
            _count_cell(each.unstable),
            _count_cell(each.failed),
        )
        for each in statistics.controllers
    )
    headings = ("controller", "origin", "digest", "evaluated", "unstable", "failed")
    blocks: list[Block] = [Table(caption="Controllers", headings=headings, rows=rows, words=(1, 2))]
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


def _count_cell(count: int) -> Cell:
    return Cell(text=str(count), tone="bad" if count else "plain")


def _comparison_blocks(
    statistics: StudyStatistics, samples: Sequence[ControllerSamples]
) -> list[Block]:
    """Compare the controllers on the same samples."""
    table = summary.comparison_table(statistics)
    compared = [table] if table.rows else []
    return [*compared, *_loss_chart(samples), summary.residual_table(statistics)]


def _dependence_blocks(
    statistics: StudyStatistics,
    samples: Sequence[ControllerSamples],
    values: Mapping[str, FloatArray],
    names: Names,
) -> list[Block]:
    """Show what the Strehl ratio depends on."""
    if not statistics.ranked:
        return [Notice(text=paragraph("no-index"))]
    return [
        *_sensitivity_chart(statistics, names),
        summary.sensitivity_table(statistics, names=names),
        *_conditional_charts(statistics, names),
        *_map_charts(statistics, samples, values, names),
    ]


def _worst_blocks(
    study: Study,
    statistics: StudyStatistics,
    columns: Mapping[str, ArrayLike],
    names: Names,
    folder: str,
) -> list[Block]:
    """List the worst samples, and the commands that replay them."""
    blocks: list[Block] = []
    words = ["lbt-synth", "study", os.fspath(study.source), "-o", folder, "--row"]
    commands = []
    most = 0
    for each in statistics.controllers:
        if each.worst:
            others = tuple(name for name in statistics.parameters if name not in each.ranked)
            shown = (each.ranked or others)[:_PARAMETERS]
            most = max(most, len(each.ranked) - len(shown))
            table = summary.worst_table(each, columns, shown, names=names)
            blocks.append(table)
            commands.append(shlex.join([*words, str(table.rows[0][0])]))
    if most:
        blocks.insert(0, paragraph("worst", count=_PARAMETERS))
    if commands:
        caption = "Commands that replay the first of each table; any other row likewise"
        blocks.append((caption, "\n".join(dict.fromkeys(commands))))
    return blocks


def _origin_section(
    study: Study, statistics: StudyStatistics, computing_s: float | None
) -> Sections:
    """Name the files and programs that the page was made from."""
    rows = [
        ("samples with results", f"{statistics.samples} of {study.samples}"),
        ("digest of the study", study.digest),
    ]
    if computing_s is not None:
        rows.append(("computing time, of all processes together", duration_text(computing_s)))
    about = Table(caption="Study", headings=("what", "value"), rows=tuple(rows), words=(1,))
    roles, sources, texts = ["study", "configuration"], [], {}
    for place, path in enumerate(study.inputs):
        role = roles[place] if place < len(roles) else "gain file"
        source, content = read_source(path, role)
        sources.append(source)
        if place < len(roles):
            texts[f"{role.capitalize()} {source[0]}"] = content.decode("utf-8-sig", "replace")
    return source_section(sources, texts=texts, about=about)


def _distribution_chart(samples: Sequence[ControllerSamples]) -> list[Chart]:
    """Cumulative distribution of the Strehl ratio, and its lower tail on a logarithmic scale."""
    strehls = {each.controller: each.strehl[each.evaluated] for each in samples}
    if not any(values.size for values in strehls.values()):
        return []
    top = 100 * max(float(np.max(values, initial=0.0)) for values in strehls.values())
    least = 100 / max(values.size for values in strehls.values())
    low = min(10.0, 10.0 ** np.floor(np.log10(least)))
    x_axis = {"label": "Strehl ratio", "unit": "%", "low": 0}
    x_axis["high"] = min(100.0, max(1.02 * top, 1.0))
    y_axis = {"label": "samples at or below", "unit": "%", "high": 100}
    with drawing([PANEL_IN] * 2, columns=2) as (plain, tail):
        plain.set_axes(x_axis, y_axis | {"low": 0}, title="all samples")
        tail.set_axes(x_axis, y_axis | {"low": low, "log": True}, title="lower tail")
        plain.rule("half of the samples", 50, "y")
        for look, (name, values) in enumerate(strehls.items()):
            if values.size:
                level, share = cumulative_points(values)
                # from nothing just below the first value
                x, y = np.append(level[:1], level), np.append(0.0, share)
                _draw_steps(plain, name, x, y, look)
                _draw_steps(tail, name, level, share, look)
    return [chart("distribution", plain.figure)]


def _draw_steps(panel: Panel, name: str, x: FloatArray, y: FloatArray, look: int) -> None:
    """Draw shares over values, both in percent."""
    panel.curve(name, 100 * x, 100 * y, look=look, step="steps-post", width=1.8)


def _loss_chart(samples: Sequence[ControllerSamples]) -> list[Chart]:
    """How much each controller loses against the best of each sample, and how often."""
    losses = sample_losses(samples)
    if len(samples) < 2 or not losses[0].size:
        return []
    y_axis = {"label": "samples that lose more", "unit": "%", "low": 0, "high": 100}
    with drawing([PANEL_IN]) as (panel,):
        panel.set_axes({"label": "loss of Strehl ratio", "unit": "points", "low": 0}, y_axis)
        for look, (each, loss) in enumerate(zip(samples, losses, strict=True)):
            level, share = cumulative_points(loss)
            x, y = np.append(0.0, level), np.append(1.0, 1 - share)
            _draw_steps(panel, each.controller, x, y, look)
    return [chart("loss", panel.figure)]


def _histogram_chart(parameters: Mapping[str, FloatArray], names: Names) -> list[Chart]:
    """Histograms of the parameters that vary."""
    varying = {name: values for name, values in parameters.items() if np.ptp(values) > 0}
    if not varying:
        return []
    with drawing([1.7] * len(varying), columns=min(len(varying), 3)) as panels:
        for panel, (name, values) in zip(panels, varying.items(), strict=True):
            panel.set_axes({"label": names[name]}, {"label": "samples", "unit": "%", "low": 0})
            edges, share = histogram(values)
            x = np.repeat(edges, 2)
            y = np.concatenate(([0.0], np.repeat(100 * share, 2), [0.0]))
            panel.area("", x, np.zeros_like(y), y)
            panel.curve("samples [%]", x, y, dash=0, quiet=True)
    listed_names = listing_text([names[name] for name in varying])
    return [chart("parameters", panels[0].figure, names=listed_names)]


def _sensitivity_chart(statistics: StudyStatistics, names: Names) -> list[Chart]:
    """First-order indices as bars, one series per controller."""
    bars: dict[str, FloatArray] = {}
    intervals: dict[str, tuple[FloatArray, FloatArray]] = {}
    for one in statistics.controllers:
        rows = [one.sensitivity[name] for name in statistics.ranked]
        value, error = (
            100 * np.array([row[key] for row in rows]) for key in ("index", "index_error")
        )
        low, high = value - 2 * error, value + 2 * error
        bars[one.controller], low, high = np.maximum((value, low, high), 0)
        intervals[one.controller] = low, high
    height_in = min(max(0.8, 0.24 * len(statistics.ranked) * len(bars) + 0.2), 7.5)  # fits a sheet
    with drawing([height_in]) as (panel,):
        panel.set_axes({"label": "variance explained by itself", "unit": "%", "low": 0}, {})
        panel.bars([names[name] for name in statistics.ranked], bars, intervals)
    return [chart("sensitivity", panel.figure)]


def _conditional_charts(statistics: StudyStatistics, names: Names) -> list[Chart]:
    """Mean and 10th percentile of the Strehl ratio over each parameter, and unstable loops.

    The latter are drawn over the parameters that their part changes most with.
    """
    groups = {
        name: [one.curves[name] for one in statistics.controllers if name in one.curves]
        for name in statistics.ranked
    }
    groups = {name: curves for name, curves in groups.items() if curves}
    if not groups:
        return []
    charts = [_parameter_chart("curves", statistics, list(groups), names)]
    spans = {
        name: max(float(np.ptp(curve["unstable"])) for curve in curves)
        for name, curves in groups.items()
        if any(curve["unstable"].any() for curve in curves)
    }
    most = sorted(spans, key=lambda name: -spans[name])[:_UNSTABLE_PANELS]
    return [*charts, _parameter_chart("unstable", statistics, most, names)] if most else charts


def _parameter_chart(
    key: str, statistics: StudyStatistics, parameters: Sequence[str], names: Names
) -> Chart:
    """Draw the Strehl ratios, or the part of unstable loops, over some parameters."""
    is_strehl, columns = key == "curves", min(len(parameters), 2)
    label = "Strehl ratio" if is_strehl else "unstable"
    with drawing([PANEL_IN] * len(parameters), columns=columns) as panels:
        for panel, name in zip(panels, parameters, strict=True):
            curves = {
                (look, one.controller): one.curves[name]
                for look, one in enumerate(statistics.controllers)
                if name in one.curves and (is_strehl or one.unstable)
            }
            least = min(100 * float(np.min(curve["low"])) for curve in curves.values())
            low = None if is_strehl and least >= _HIGH else 0
            panel.set_axes({"label": names[name]}, {"label": label, "unit": "%", "low": low})
            style: dict[str, Any] = {"marker": "own", "width": 1.8}
            for (look, controller), curve in curves.items():
                y = 100 * curve["mean" if is_strehl else "unstable"]
                panel.curve(controller, curve["parameter"], y, look=look, **style)
            for (look, controller), curve in curves.items() if is_strehl else ():
                label_low, y = f"{controller}, 10th percentile", 100 * curve["low"]
                panel.curve(label_low, curve["parameter"], y, look=look, width=0.9, quiet=True)
            if is_strehl:
                panel.curve("10th percentile (thin)", [], [], look=None, width=0.9)
    return chart(key, panels[0].figure, names=listing_text([names[name] for name in parameters]))


def _map_charts(
    statistics: StudyStatistics,
    samples: Sequence[ControllerSamples],
    parameters: Mapping[str, FloatArray],
    names: Names,
) -> list[Chart]:
    """Mean Strehl ratio over the two most influential parameters, one chart per controller."""
    charts = []
    for place, (one, each) in enumerate(zip(statistics.controllers, samples, strict=True)):
        if len(one.ranked) < 2:
            continue
        first, second = one.ranked[:2]
        kept = each.evaluated
        places = parameters[first][kept], parameters[second][kept]
        x, y, mean = binned_map(*places, each.strehl[kept])
        low, high = (100 * float(end(mean)) for end in (np.nanmin, np.nanmax))
        ends = 5 * float(np.floor(low / 5)), 5 * float(np.floor(high / 5)) + 5
        with drawing([2.6]) as (panel,):
            panel.set_axes({"label": names[first]}, {"label": names[second]})
            label: dict[str, Any] = {"label": "mean Strehl ratio", "unit": "%"}
            panel.map(x, y, 100 * mean, ends=ends, blank="no sample", **label)
        facts = {"x": names[first], "y": names[second], "x_path": first, "y_path": second}
        facts["controller"] = each.controller
        charts.append(chart(f"map-{place + 1}", panel.figure, group="study-map", **facts))
    return charts


def cumulative_points(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return levels (k,) and the part of the values at or below each, denser in the tails."""
    ordered, n = np.sort(values), len(values)
    tail = np.geomspace(1, n, _POINTS // 4)
    ranks = np.concatenate((tail, n + 1 - tail, np.linspace(1, n, _POINTS // 2)))
    level = np.unique(ordered[ranks.astype(np.int64) - 1])
    return level, np.searchsorted(ordered, level, side="right") / n


def histogram(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return edges of bins (k + 1,) and the part of the values in each (k,)."""
    bins = int(np.clip(np.sqrt(len(values)), 4, _BINS))
    counts, edges = np.histogram(values, bins=bins)
    return edges, counts / len(values)


def binned_map(
    x: FloatArray, y: FloatArray, result: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the mean of a result (n,) over a grid of two varying parameters (n,).

    It is (ny, nx), nan in a cell without samples, and comes after the centres of the cells, or
    the values of a list, x (nx,) and y (ny,).
    """
    from scipy.stats import binned_statistic_2d

    cells = int(np.clip(np.sqrt(len(x) / _PER_CELL), 3, _CELLS))
    (columns, x_edges), (rows, y_edges) = (_cells(values, cells) for values in (x, y))
    mean = binned_statistic_2d(y, x, result, bins=(y_edges, x_edges)).statistic
    return columns, rows, np.asarray(mean)


def _cells(values: FloatArray, cells: int) -> tuple[FloatArray, FloatArray]:
    """Return the centres of the cells along one axis, and their edges."""
    ordered = np.sort(values)
    if is_list(ordered):
        centres = np.unique(values)
        inner = (centres[:-1] + centres[1:]) / 2
    else:
        low, high = np.percentile(ordered, _WITHIN)
        if not low < high:
            low, high = ordered[0], ordered[-1]
        edges = np.linspace(low, high, cells + 1)
        centres, inner = (edges[:-1] + edges[1:]) / 2, edges[1:-1]
    return centres, np.concatenate(([ordered[0] - 1], inner, [ordered[-1] + 1]))
