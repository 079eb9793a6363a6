"""A page as one HTML file that needs nothing else, and as a PDF."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from html import escape
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.errors import MissingExtraError
from lbt_synth.report.draw import Figure, Series, figure_series, house_style
from lbt_synth.report.page.blocks import Chart, Page, creator_name
from lbt_synth.storage.atomic_files import require_ending, require_writable, write_together
from lbt_synth.storage.rows import cell_text
from lbt_synth.storage.tables import Table
from lbt_synth.storage.warning_filters import ignore_warnings

_COLUMNS = 6  # that fit a sheet of paper beside the first one of a table
_MOST_ROWS = 120  # of a table of numbers behind a figure
_DETAILS = re.compile(r"<details>.*?</details>", re.DOTALL)
_FORMAT = ".5g"  # of such a number
_MINUS = "\u2212"  # as long as a plus


def page_html(page: Page) -> bytes:
    """Return a page as one HTML file, UTF-8.

    Every text is escaped. Charts are drawings with their numbers in tables behind them; the page
    has no script.
    """
    from jinja2 import Environment, StrictUndefined

    here = files("lbt_synth.report.page")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals |= {
        "kind_of": lambda block: type(block).__name__.lower(),
        "parts_of": lambda table: list(table.by_columns(_COLUMNS)),
        "printed": print_text,
        "unbroken": unbroken_text,
        "drawing_of": chart_svg,
        "numbers_of": lambda chart: list(number_tables(chart.figure)),
    }
    template = environment.from_string((here / "page.html.jinja").read_text(encoding="utf-8"))
    style = (here / "page.css").read_text(encoding="utf-8")
    return template.render(page=page, creator=creator_name(), style=style).encode()


def print_text(text: str) -> str:
    """Return a text of the terminal with the signs of print; no line ends behind a minus."""
    text = re.sub(r"\binf\b", "∞", text.replace("+-", "±"))
    return re.sub(r"(?<![\w.])-(?=[\d.∞])|(?<=\de)-(?=\d)", _MINUS, text)


def unbroken_text(text: str) -> str:
    """Keep a number, its sign and its error, and the two ends of an interval, in one line."""
    return re.sub(" (±|to) ", "\u00a0\\1\u00a0", print_text(text))


def chart_svg(chart: Chart) -> str:
    """Return a chart as an SVG element to be set into a page, whose size follows its place."""
    import matplotlib as mpl

    buffer = io.BytesIO()
    # texts stay texts; the salt makes the identifiers of each chart its own
    with house_style(), mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": chart.key}):
        chart.figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue().decode()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    attributes = f' role="img" aria-label="{escape(chart.alt)}"'
    svg = re.sub(r' width="[^"]*" height="[^"]*"', lambda _: attributes, svg, count=1)
    svg = svg.replace('<g id="', f'<g id="{chart.key}_')  # the same in every chart
    seen: set[str] = set()

    def name_once(element: re.Match[str]) -> str:
        repeated = element[2] in seen  # the same path, defined again
        seen.add(element[2])
        return element[1] if repeated else element[0]

    return re.sub(r'(<(?:path|image|pattern|clipPath)\b[^>]*?) id="([^"]*)"', name_once, svg)


def number_tables(figure: Figure) -> Iterator[Table]:
    """Yield the numbers that a figure draws: a table for the curves of the same abscissae.

    Of long curves it has rows at equal steps, and the least and the largest value of bands.
    """

    def abscissae(one: Series) -> object:
        return one.panel, one.heading, one.x if isinstance(one.x, tuple) else one.x.tobytes()

    for _, curves in groupby(figure_series(figure), abscissae):
        group = list(curves)
        rows, x = _kept_rows(group), group[0].x
        cells = [
            [x[i] if isinstance(x, tuple) else cell_text(float(x[i]), _FORMAT) for i in rows],
            *([cell_text(float(one.y[i]), _FORMAT) for i in rows] for one in group),
        ]
        count = "" if len(rows) == len(x) else f" ({len(rows)} of {len(x)} rows)"
        yield Table(
            caption=f"{group[0].panel}{count}".strip(),
            headings=(group[0].heading, *(one.name for one in group)),
            rows=tuple(zip(*cells, strict=True)),
        )


def _kept_rows(group: list[Series]) -> list[int]:
    """Return the rows of a table of curves: all, or even ones and the extremes of bands."""
    count = len(group[0].x)
    if count <= _MOST_ROWS:
        return list(range(count))
    kept = {round(place) for place in np.linspace(0, count - 1, _MOST_ROWS // 2)}
    for band in np.array_split(np.arange(count), max(1, _MOST_ROWS // (4 * len(group)))):
        for one in group:
            values = one.y[band]
            if np.any(np.isfinite(values)):
                kept |= {int(band[np.nanargmin(values)]), int(band[np.nanargmax(values)])}
    return sorted(kept)


def require_page_names(
    path: str | os.PathLike[str],
    pdf: str | os.PathLike[str] | None = None,
    *,
    inputs: tuple[str | os.PathLike[str], ...] = (),
) -> None:
    """Refuse names of pages that cannot be written, or would replace an input."""
    pages: list[tuple[str | os.PathLike[str], str]] = [(path, ".html")]
    if pdf is not None:
        pages.append((pdf, ".pdf"))
    for name, ending in pages:
        require_ending(name, "a page", (ending,))
    require_writable(*(name for name, _ in pages), inputs=inputs)
    if pdf is not None:
        require_weasyprint()


def write_page(
    page: Page, path: str | os.PathLike[str], *, pdf: str | os.PathLike[str] | None = None
) -> tuple[Path, ...]:
    """Write a page as one HTML file that opens offline, and as a PDF if that is wanted.

    Parameters
    ----------
    page : Page
        Of designs (:func:`design_page`), or of a study (:func:`study_page`).
    path : path-like
        File to write, that ends in .html.
    pdf : path-like, optional
        File to write, that ends in .pdf.

    Returns
    -------
    tuple of pathlib.Path
        The files; all of them are written, or none.

    Raises
    ------
    OutputError
        If a name ends in something else, or a file cannot be written.

    Examples
    --------
    >>> import lbt_synth as lbt, pathlib, tempfile
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> slow = lbt.design.optimal_integrator(config.hardware, config.truth)
    >>> page = lbt.report.design_page(lbt.report.design_report(config, {"integrator": slow}))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [file.name for file in lbt.report.write_page(page, pathlib.Path(folder) / "a.html")]
    ['a.html']
    """
    require_page_names(path, pdf)
    contents: dict[str | os.PathLike[str], bytes] = {path: page_html(page)}
    if pdf is not None:
        contents[pdf] = print_html(contents[path])
    return write_together(contents)


def print_html(html: bytes) -> bytes:
    """Return a page of HTML on sheets of A4, as PDF, without the numbers behind its figures."""
    text = _DETAILS.sub("", html.decode())
    content: bytes = require_weasyprint().HTML(string=text).write_pdf()
    return content


def require_weasyprint() -> Any:
    """Return the module that prints HTML."""
    try:
        with ignore_warnings(DeprecationWarning):  # of a library that it will need later
            import weasyprint
    except (ImportError, OSError) as error:  # OSError: without the library Pango
        raise MissingExtraError(
            'a page as PDF needs WeasyPrint and Pango: pip install "lbt-synth[pdf]", and on Debian '
            "apt-get install libpango-1.0-0 libpangoft2-1.0-0.",
            extra="pdf",
        ) from error
    return weasyprint
