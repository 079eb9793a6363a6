"""What a page is made of: sections of paragraphs, notices, tables, listings and charts.

The words of charts and paragraphs are data, in ``words.toml``. A page says from which files it was
made, by which programs, and when.
"""

from __future__ import annotations

import hashlib
import os
import platform
import tomllib
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

import lbt_synth
from lbt_synth.errors import FileError, ProblemError
from lbt_synth.loop import LoopMargins
from lbt_synth.report.draw import Figure, figure_series
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.storage.tables import TONES, Table
from lbt_synth.validation import choice

_MOST_NAMED = 8  # curves of a panel whose ranges are told
_DISTRIBUTIONS = ("numpy", "scipy", "matplotlib")
_WRITING_DIRECTIONS = ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")
Source: TypeAlias = tuple[str, str, str]  # a file's name, what it is, and its SHA-256


@dataclass(frozen=True, slots=True, kw_only=True)
class Notice:
    """A paragraph that must not be overlooked."""

    text: str
    # "bad" for what is wrong, "note" for what has to be known, "good" for what was proved
    tone: str = "note"

    def __post_init__(self) -> None:
        choice(self.tone, "tone", TONES)


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
# by their anchors: headings, and what is in them
Sections: TypeAlias = Mapping[str, tuple[str, Sequence[Block]]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Page:
    """A whole page, for the screen or for paper; a section without blocks is left out."""

    title: str  # Its heading
    subtitle: str  # A line below, such as what it is about and when it was made
    sections: Sections

    def __post_init__(self) -> None:
        kept = {key: section for key, section in self.sections.items() if section[1]}
        object.__setattr__(self, "sections", kept)
        keys = [*kept, *(chart.key for chart in self.charts)]
        repeated = sorted({key for key in keys if keys.count(key) > 1})
        if repeated:
            raise ProblemError(f"keys of a page must be unique; got {', '.join(repeated)} twice.")

    @property
    def blocks(self) -> list[Block]:
        """All blocks, in their order."""
        return [block for _, blocks in self.sections.values() for block in blocks]

    @property
    def charts(self) -> list[Chart]:
        """All charts, in their order."""
        return [block for block in self.blocks if isinstance(block, Chart)]


@cache
def words() -> dict[str, dict[str, str]]:
    """Return the texts of ``words.toml`` by group and name, each on one line."""
    path = files("lbt_synth.report.page") / "words.toml"
    texts: dict[str, dict[str, str]] = tomllib.loads(path.read_text(encoding="utf-8"))
    return {
        group: {name: " ".join(text.split()) for name, text in own.items()}
        for group, own in texts.items()
    }


def chart(key: str, figure: Figure, *, group: str = "", **facts: object) -> Chart:
    """Return a chart with the words of its key, or of another group, and facts filled in.

    A key that ends in a number is that of a continuation, with the words of the first one. Its
    words for those who do not see it say from where to where its curves reach.
    """
    name, _, number = key.rpartition("-")
    own = words().get(group or key) or words()[name]
    texts = {name: text.format(**facts) for name, text in own.items()}
    if not group and number.isdigit():
        texts["title"] += " (continued)"
    texts["alt"] += "".join(f" {text}." for text in _ranges(figure))
    return Chart(key=key, figure=figure, **texts)


def _ranges(figure: Figure) -> Iterator[str]:
    """Yield from where to where the curves of each panel reach; many are one."""
    for panel, series in groupby(figure_series(figure), lambda one: one.panel):
        curves = {one.name: one.y[np.isfinite(one.y)] for one in series}
        if len(curves) > _MOST_NAMED:
            curves = {f"all {len(curves)}": np.concatenate(list(curves.values()))}
        texts = [f"{name} {y.min():.3g} to {y.max():.3g}" for name, y in curves.items() if y.size]
        if texts:
            yield f"{panel}: {', '.join(texts)}".removeprefix(": ")


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
    return words()["paragraphs"][name].format(**facts)


def read_source(path: str | os.PathLike[str], role: str) -> tuple[Source, bytes]:
    """Read a file that a page is made from, and return its name, role and digest with its bytes."""
    source = Path(path)
    require_letters(source.name, f"name of the {role}")
    content = read_bytes(source, FileError)
    return (source.name, role, hashlib.sha256(content).hexdigest()), content


def require_letters(text: str, what: str) -> str:
    """Refuse a text that no page can show as it is."""
    for letter in text:
        if (
            unicodedata.category(letter) in ("Cc", "Cs")
            or unicodedata.bidirectional(letter) in _WRITING_DIRECTIONS
            or letter in "\ufffe\uffff"
        ):
            raise ProblemError(
                f"{what} must be of letters that a page can show; got {text!a}. Choose another."
            )
    return text


def creation_time() -> datetime:
    """Return the time, in UTC: that of SOURCE_DATE_EPOCH if it is set, else now."""
    given = os.environ.get("SOURCE_DATE_EPOCH")
    if given is None:
        return datetime.now(UTC).replace(microsecond=0)
    try:
        return datetime.fromtimestamp(int(given), UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise ProblemError(
            f"SOURCE_DATE_EPOCH must be a number of seconds since 1970; got {given!r}."
        ) from error


def time_text(moment: datetime) -> str:
    """Return a time as a text: 2026-11-21 17:05:09 UTC."""
    return moment.strftime("%Y-%m-%d %H:%M:%S UTC")


def creator_name() -> str:
    """Return the name and version of this program."""
    return f"lbt_synth {lbt_synth.__version__}"


def program_versions(extra: Sequence[str] = ()) -> tuple[tuple[str, str], ...]:
    """Return name and version of the programs that make a page, and of ``extra`` ones."""
    installed = [("lbt_synth", lbt_synth.__version__), ("Python", platform.python_version())]
    for name in (*_DISTRIBUTIONS, *extra):
        try:
            installed.append((name, version(name)))
        except PackageNotFoundError:
            installed.append((name, "not installed"))
    return tuple(installed)


def source_section(
    sources: Sequence[Source] = (),
    *,
    versions: Sequence[tuple[str, str]] | None = None,
    texts: Mapping[str, str] = MappingProxyType({}),
    about: Table | None = None,
) -> Sections:
    """Return the last section of a page: what it was made from, and by which programs.

    Texts are listed under their captions.
    """
    headings = ("file", "what it is", "SHA-256")
    read = Table(
        caption="Files that were read", headings=headings, rows=tuple(sources), words=(1, 2)
    )
    programs = tuple(program_versions() if versions is None else versions)
    made = Table(caption="Made with", headings=("program", "version"), rows=programs, words=(1,))
    tables = [*([] if about is None else [about]), *([read] if sources else []), made]
    return {"sources": ("Files and versions", (*tables, *texts.items()))}
