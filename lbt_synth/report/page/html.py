"""Pages: sections of paragraphs, notices, tables, listings and charts, and the file they become.

The words of charts and paragraphs are data, in ``words.toml``. A page says from which files it was
made, by which programs, and when. It is one HTML file that needs nothing else, and a PDF.
"""

from __future__ import annotations

import hashlib
import io
import os
import platform
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from html import escape
from importlib.metadata import version
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import lbt_synth
from lbt_synth.errors import FileError, MissingExtraError, ProblemError
from lbt_synth.loop.margins import LoopMargins
from lbt_synth.report.draw import Figure, Series, figure_series, house_style
from lbt_synth.storage.atomic_files import require_ending, require_writable, write_together
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.storage.rows import cell_text
from lbt_synth.storage.tables import Table
from lbt_synth.storage.warning_filters import ignore_warnings

_PROGRAMS = ("numpy", "scipy", "matplotlib", "cvxpy", "clarabel")
_LISTED = ("configuration", "study")  # what is a text for people


@dataclass(frozen=True, slots=True, kw_only=True)
class Notice:
    """A paragraph that must not be overlooked."""

    text: str
    # "bad" for what is wrong, "note" for what has to be known, "good" for what was proved
    tone: str = "note"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chart:
    """A figure with its words; the page has its numbers, too."""

    key: str  # Its anchor in the page: small letters, digits and hyphens; unique in the page
    title: str  # A short heading
    caption: str  # What is seen and how to read it
    alt: str  # The same for those who do not see it: what is drawn, and what it shows
    figure: Figure


Listing: TypeAlias = tuple[str, str]  # a caption, and a text as it is in a file, line by line
Block: TypeAlias = str | Notice | Listing | Table | Chart  # a text is a paragraph
Sections: TypeAlias = Mapping[str, Sequence[Block]]  # by their headings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Page:
    """A page, for the screen or for paper."""

    title: str  # Its heading
    subtitle: str  # A line below, such as what it is about and when it was made
    sections: Sections
    digests: Mapping[str, str]  # SHA-256 of the files that it was made from, by their names
    made: str  # When

    @property
    def blocks(self) -> list[Block]:
        """All blocks, in their order."""
        return [block for blocks in self.sections.values() for block in blocks]

    @property
    def charts(self) -> list[Chart]:
        """All charts, in their order."""
        return [block for block in self.blocks if isinstance(block, Chart)]


@cache
def words(group: str) -> dict[str, Any]:
    """Return the texts of a group of ``words.toml`` by their names, each on one line."""
    path = files("lbt_synth.report.page") / "words.toml"
    texts: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))[group]
    return {
        name: " ".join(text.split()) if isinstance(text, str) else text
        for name, text in texts.items()
    }


def chart(key: str, figure: Figure, *, group: str = "", **facts: object) -> Chart:
    """Return a chart with the words of its key, or of another group, and facts filled in."""
    texts = {name: text.format(**facts) for name, text in words(group or key).items()}
    return Chart(key=key, figure=figure, **texts)


def survival_blocks(margins: Mapping[str, LoopMargins]) -> list[Block]:
    """Say which errors the loop of each design survives, after warnings of those that it does not.

    An error of the delay below 0.1 frames, or of the gain below 2 dB, is a warning.
    """
    notices = [
        Notice(text=f"{name}: {text}")
        for name, margin in margins.items()
        for text in margin.fragilities
    ]
    return [*notices, *(f"{name} {margin.survival}" for name, margin in margins.items())]


def paragraph(name: str, /, **facts: object) -> str:
    """Return the text of a paragraph with facts filled in."""
    return str(words("paragraphs")[name]).format(**facts)


def new_page(
    title: str,
    about: str,
    sections: Sections,
    *,
    sources: Sequence[tuple[str | os.PathLike[str], str]] = (),
    facts: Sequence[Table] = (),
) -> Page:
    """Return a page; the last section says from which files it was made, and by which programs.

    A section without blocks is left out. Each source is a file and what it is; configurations and
    studies are listed. ``facts`` are tables above them.
    """
    made, rows, listings = creation_time(), [], []
    for path, role in sources:
        name, content = Path(path).name, read_bytes(Path(path), FileError)
        rows.append((name, role, hashlib.sha256(content).hexdigest()))
        if role in _LISTED:
            text = content.decode("utf-8-sig", errors="replace")
            listings.append((f"{role.capitalize()} {name}", text))
    read = Table(
        caption="Files that were read",
        headings=("file", "what it is", "SHA-256"),
        rows=tuple(rows),
        words=(1, 2),
    )
    ours = ("lbt_synth", lbt_synth.__version__), ("Python", platform.python_version())
    programs = Table(
        caption="Made with",
        headings=("program", "version"),
        rows=(*ours, *((name, version(name)) for name in _PROGRAMS)),
        words=(1,),
    )
    files: list[Block] = [*facts, *([read] if rows else []), programs, *listings]
    kept: Sections = {**sections, "Files and versions": files}
    return Page(
        title=title,
        subtitle=f"{about}. Made {made}.",
        sections={heading: blocks for heading, blocks in kept.items() if blocks},
        digests={name: digest for name, _, digest in rows},
        made=made,
    )


def creation_time() -> str:
    """Return the time as 2026-11-21 17:05:09 UTC: that of SOURCE_DATE_EPOCH if it is set."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise ProblemError(
            f"SOURCE_DATE_EPOCH must be a number of seconds since 1970; got {epoch!r}."
        ) from error
    return moment.strftime("%Y-%m-%d %H:%M:%S UTC")


def creator_name() -> str:
    """Return the name and version of this program."""
    return f"lbt_synth {lbt_synth.__version__}"


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
    text = template.render(page=page, creator=creator_name(), style=style)
    return text.encode(errors="backslashreplace")  # of names of files that are no text


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
        return one.panel, one.heading, one.x.tobytes()

    for _, curves in groupby(figure_series(figure), abscissae):
        group = list(curves)
        rows, x = _kept_rows(group), group[0].x
        cells = [
            [cell_text(float(numbers[i]), _FORMAT) for i in rows]
            for numbers in (x, *(one.y for one in group))
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
    >>> slow = lbt.integrator(config.hardware, truth=config.truth)
    >>> page = lbt.report.design_page(config, {"integrator": slow})
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
